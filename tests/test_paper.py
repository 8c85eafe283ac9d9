"""The paper's trainings have nothing of what came later, and the page on the paper says what is there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from magnet.denoiser.levels import draw_levels
from magnet.denoiser.options import NoiseOptions, TransformerOptions
from magnet.denoiser.self_forcing import past_of
from magnet.denoiser.transformer import Transformer
from magnet.motion.tokens import TokenLayout
from tests.cases import some_quick
from tests.test_configs import PAPER, SETS, printed

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
RUN = {"start_from": None, "compile": False, "seed": 1111}
ADAMW = {"learning_rate": 2e-4, "weight_decay": 1e-4, "muon": 0.0}
DENOISER: dict[str, Any] = {
    "target": "quantized",
    "network": {"width": 512, "layers": 6, "heads": 8, "mlp_ratio": 4, "dropout": 0.05, "level_width": 256}
    | {"agent_width": 256, "slot_width": 32, "rope": "hidden", "agent_embedding": True, "pairwise": True}
    | {"causal_block": 0, "pairwise_posterior": False, "skip": False, "cond_dim": 0, "cond_dropout": 0.1},
    "noise": {"distribution": "per_token", "shift": 1.0, "pairwise": "noisier_end", "pairwise_metres": 0.0}
    | {"faint_past": 0.0, "live": 0.0, "from_nothing": 0.2, "to_end": 0.0, "at_once": 0.05},
    "loss": {"latent": 1.0, "delta": 1.0, "pairwise": 1.0, "huber": 1.0, "consistency": 0.1}
    | {"consistency_warmup": 1000, "near": 0.0, "shake": 0.0, "unfused": 0.5, "joint": 0.0, "velocity": 0.0}
    | {"partner": 0.0, "hands": 0.0, "decoded_share": 0.25, "weighting": "uniform", "snr_gamma": 5.0},
    "self_forcing": {"share": 0.0, "placement": "fuse", "pairwise_weight": 0.02, "displaced": 0.0, "far": 0.0},
    "optimizer": {**ADAMW, "warmup_steps": 1000},
    "sampling": dict.fromkeys(("stride", "pyramid_offset", "turn", "opening", "settle", "settle_groups"))
    | dict.fromkeys(("smooth_path", "together", "pairwise_weight", "noise_scale"))
    | dict.fromkeys(("stabilization_level", "stabilization_beside", "stabilization_unseen"))
    | {"stabilization_after": 0},
    "cuda_graph": False,
    **RUN,
}
"""Every option of the paper's denoisers: what a new one, or another default, is in them has to be decided here."""

TOKENIZER: dict[str, Any] = {
    "network": {"width": 512, "depth": 3, "causal": False, "lookahead": 0, "embed_dim": 0},
    "quantizer": {"kind": "residual_vq", "codebook_size": 1024, "codebook_dim": 512, "num_quantizers": 1}
    | {"ema_decay": 0.99, "dead_code_threshold": 1.0, "continuous_steps": 0, "levels": [8, 8, 8, 5, 5, 5]},
    "loss": {"joint_rotation": 1.0, "root_rotation": 0.5, "root_translation": 0.5, "commitment": 0.3, "joint": 0.0}
    | {"hand": 0.0, "velocity": 0.0, "foot_velocity": 0.0, "foot_contact": 0.0},
    "augment": {"limb_swap_prob": 0.0, "joint_noise": 0.0, "root_noise": 0.0},
    "optimizer": {**ADAMW, "warmup_steps": 15000},
    "decoder_only": False,
    **RUN,
}
AUGMENT = {"mirror": True, "shuffle": True, "compose": 0.0, "compose_apart": [1.6, 3.5], "compose_clearance": 0.9}


@pytest.mark.parametrize("name", some_quick(SETS, "embody3d"))
def test_nothing_that_came_later_is_in_the_papers_trainings(name: str) -> None:
    many = name == "embody3d"
    for what, options in (("tokenizer", TOKENIZER), ("denoiser", DENOISER)):
        run = printed(PAPER / f"{name}_{what}.yaml")
        model, data, trainer = run["model"]["init_args"], run["data"]["init_args"], run["trainer"]
        given = ("tokenizer", "max_agents", "window")  # of this run and its data
        assert {key: value for key, value in model.items() if key not in given} == options
        masked = {"drop": 0.1, "drop_at_most": 2} if many else {"drop": 0.0, "drop_at_most": 1}
        assert data["augment"] == AUGMENT | masked
        assert data["weights"] is None and data["epoch_size"] == 1000 * data["batch_size"]
        assert trainer["gradient_clip_val"] == 0.5 and trainer["gradient_clip_algorithm"] is None
        assert not trainer["callbacks"] and not trainer["precision"] and trainer["accumulate_grad_batches"] == 1
        assert not run.get("optimizer") and not run.get("lr_scheduler")


@pytest.mark.parametrize("people", [2, 4])
def test_the_papers_network_is_that_of_its_table_and_the_levels_of_pairs(people: int) -> None:
    network = Transformer(TokenLayout(agents=people), TransformerOptions(**DENOISER["network"]))
    token = 512 + 36 * people  # D_m of Table A.2
    assert network.in_proj[0].in_features == token + 2 * 256 + 32 * (people - 1)
    assert network.out_proj.out_features == token
    assert sum(each.numel() for each in network.parameters()) // 10**6 == 20
    assert "32 more numbers than Table A.2" in PAGE


def test_independent_levels_hardly_show_a_past_and_a_mixture_does() -> None:
    """As docs/peers.md says of self-forcing, which goes on from pasts."""
    generator = torch.Generator().manual_seed(0)
    shares = {}
    for distribution in ("per_token", "mixture"):
        levels = draw_levels(NoiseOptions(distribution=distribution), (50_000, 16, 2), generator)
        shares[distribution] = past_of(levels, 0).flatten(1).any(dim=1).float().mean().item()
    assert shares["per_token"] == pytest.approx(1 / 500, rel=0.3)
    assert shares["mixture"] == pytest.approx(1 / 3, rel=0.3)


def test_files_and_folders_that_the_page_on_the_paper_names_are_there() -> None:
    named = set(re.findall(r"`((?:magnet|configs)/[\w/.]+)`", PAGE))
    assert len(named) > 15
    assert not [path for path in sorted(named) if not (ROOT / path).exists()]
