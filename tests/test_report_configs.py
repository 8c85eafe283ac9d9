"""The trainings of the report: each row changes only what it is about, and each trains and samples."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer

from magnet.denoiser.module import Denoiser
from magnet.generation.rollout import generate
from magnet.sampling.options import SamplerOptions
from magnet.tasks.joint import JointFuture
from magnet.testing import random_scene, tiny_tokenizer
from magnet.tokenizer.raw import RawPose
from tests.cases import few
from tests.datamodules.fakes import FakeData, random_clip
from tests.test_configs import PAPER, ROOT, TINY, leaves, said

REPORT = ROOT / "report"
NETWORK = "model.init_args.network"
ROWS: dict[str, dict[str, Any]] = {
    "base": {},
    "no_vqvae": {"model.init_args.tokenizer": "raw"},
    "no_pairwise": {f"{NETWORK}.pairwise": False},
    "no_agent_encoding": {f"{NETWORK}.agent_embedding": False},
    "no_time_encoding": {f"{NETWORK}.rope": "none"},
    "no_encodings": {f"{NETWORK}.agent_embedding": False, f"{NETWORK}.rope": "none"},
    "per_timestep_noise": {"model.init_args.noise.distribution": "per_timestep"},
    "per_sequence_noise": {"model.init_args.noise.distribution": "per_sequence"},
    "pairwise_token_noise": {"model.init_args.noise.pairwise": "token"},
    "skip": {f"{NETWORK}.skip": True},
    "mixture": {"model.init_args.noise.distribution": "mixture"},
    "self_forcing": {
        "model.init_args.noise.distribution": "mixture",
        "model.init_args.self_forcing.share": 0.3,
    },
    "causal": {f"{NETWORK}.causal_block": 1},
}
"""Rows that are trainings, and all that each changes of the base."""

SAMPLED = {"independent_noise": {"sampler.noise_sampling": "independent"}}
"""Rows that are a way of sampling the base (paper Table A.6)."""


def shrunk(init_args: dict[str, Any]) -> dict[str, Any]:
    """The options of a model with a tiny network."""
    sizes: dict[str, Any] = {}
    for key, value in TINY["Denoiser"].items():
        group, _, name = key.partition(".")
        sizes[group] = {**sizes.get(group, {}), name: value}
    groups = {key: {**init_args.get(key, {}), **value} for key, value in sizes.items()}
    return {**init_args, **groups, "window": 4, "tokenizer": None}


@pytest.mark.parametrize("row", few(ROWS, 4))
def test_a_row_of_the_report_changes_what_it_says_trains_and_samples(row: str) -> None:
    options = said(REPORT / f"{row}.yaml")
    base = dict(leaves(said(REPORT / "base.yaml")))
    assert {place: value for place, value in leaves(options) if value != base.get(place)} == ROWS[row]
    model = Denoiser(**shrunk(options["model"]["init_args"]))
    model.build(RawPose() if options["model"]["init_args"]["tokenizer"] == "raw" else tiny_tokenizer())
    before = {name: value.clone() for name, value in model.transformer.state_dict().items()}
    data = FakeData([random_clip("a", 60), random_clip("b", 60)], window_frames=16, batch_size=2, epoch_size=4)
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = Trainer(max_steps=2, accelerator="cpu", enable_checkpointing=False, limit_val_batches=0, **quiet)
    trainer.fit(model, datamodule=data)
    after = model.transformer.state_dict()
    assert any(not torch.equal(value, after[name]) for name, value in before.items())
    scene = random_scene(1, 8, 2, torch.Generator().manual_seed(0))
    for sampler in ({}, said(REPORT / "independent_noise.yaml")["sampler"]) if row == "base" else ({},):
        options = SamplerOptions(steps=2, **sampler)
        made = generate(model.eval(), scene, JointFuture(), 8, 8, 1, options, torch.Generator().manual_seed(0))
        assert made.frames == 16 and made.T_world_root.isfinite().all() and made.body_rot.isfinite().all()


@pytest.mark.parametrize("row", few(ROWS, 4))
def test_a_row_of_the_report_at_the_papers_size_changes_the_same(row: str) -> None:
    options = said(PAPER / "ablations" / f"{row}.yaml")
    base = dict(leaves(said(PAPER / "duobox_denoiser.yaml")))
    assert {place: value for place, value in leaves(options) if value != base.get(place)} == ROWS[row]


def test_peers_at_the_papers_size_are_the_peers_as_wide_and_for_as_long_as_the_papers_model() -> None:
    full = said(PAPER / "duobox_denoiser.yaml")
    peers = sorted(REPORT.glob("peer_*.yaml"))
    assert len(peers) == 3
    for path in peers:
        small, large = said(path), said(PAPER / "ablations" / path.name)
        assert large["model"]["class_path"] == small["model"]["class_path"]
        assert large["trainer"] == full["trainer"]
        sizes = large["model"]["init_args"]["network"]
        assert sizes == {name: full["model"]["init_args"]["network"][name] for name in sizes}
        windows = [options["data"]["init_args"].get("window_frames") for options in (small, large)]
        assert windows[0] in (None, windows[1])


def test_every_file_of_the_report_is_a_row_a_peer_or_their_data() -> None:
    peers = {path.stem for path in REPORT.glob("*.yaml") if "peers" in str(said(path).get("model", {}))}
    assert {path.stem for path in REPORT.glob("*.yaml")} == {*ROWS, *SAMPLED, *peers, "data"}
    for row, changes in SAMPLED.items():
        assert dict(leaves(said(REPORT / f"{row}.yaml"))) == changes
