"""On a GPU everything runs as on a CPU, and training waits for nothing; the GPU is a fake that refuses and counts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import Callback

from magnet.api import Model, Motion
from magnet.callbacks import RollOuts
from magnet.cli.main import main
from magnet.denoiser.module import Denoiser
from magnet.evaluation.evaluator import Evaluator
from magnet.generation.rollout import stream
from magnet.motion.scene import Scene, cat_time
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser, tiny_tokenizer
from magnet.tokenizer.module import Tokenizer
from magnet.training.ema import WeightEMA
from tests.cases import few, some_slow
from tests.datamodules.fakes import FakeData, random_clip
from tests.fake_gpu import Seen, WrongPlace, fake_gpu

CLIPS = [
    random_clip(f"{split}{k}", 120, 2 + k % 2, split=split) for split in ("train", "val", "test") for k in range(3)
]
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "packed": {"precision": "float32"},
    "guided": {"guidance": {"kind": "history", "smooth": 0.01}},
    "apart": {"apart": "firm", "body_guidance": "firm"},
    "hold": {"settle": "hold"},
    "compiled": {"precision": "float32", "compile": True},
}
FAR = {"hold": 0.02, "compiled": 1e-4}
"""Metres between a GPU's and a CPU's poses; corrections go on until they are good enough, and factor otherwise."""


def duet(frames: int = 24) -> Scene:
    return random_scene(1, frames, 2, torch.Generator().manual_seed(5))


def model_of(device: str = "cpu", **options: Any) -> Model:
    sampler = SamplerOptions.of({"steps": 2, "precision": "reference", **options})
    return Model(tiny_denoiser(max_agents=3, window=4).to(device), sampler)


def require_same(made: Callable[[str], Scene], far: float = 1e-4) -> None:
    """What is made on a CPU is made on a GPU."""
    expected = made("cpu")
    with fake_gpu():
        got = made("cuda")
    for name, value in expected.tensors().items():
        other = getattr(got, name)
        assert not other.is_cuda and value.dtype == other.dtype
        assert torch.allclose(value.float(), other.float(), atol=far), name


# -- the fake ----------------------------------------------------------------------------------


def test_the_fake_refuses_what_a_gpu_refuses_and_allows_what_it_allows() -> None:
    with fake_gpu() as seen:
        there, here = torch.ones(3, device="cuda"), torch.ones(3)
        assert there.device == torch.device("cuda:0") and there.is_cuda
        refused: list[Callable[[], Any]] = [
            lambda: there + here,
            lambda: torch.cat([there, here]),
            lambda: torch.stack([there.sum(), here.sum()]),
            lambda: here[torch.zeros(1, dtype=torch.long, device="cuda")],
            lambda: there.numpy(),
            lambda: np.asarray(there),
            lambda: torch.rand(3, device="cuda", generator=torch.Generator()),
            lambda: torch.rand(3, generator=torch.Generator("cuda")),
        ]
        for each in refused:
            with pytest.raises(WrongPlace):
                each()
        assert not seen.waits and not seen.sent
        there[torch.tensor([0])] = torch.tensor(2.0)
        assert (there * torch.tensor(2.0))[[0, 2]].tolist() == [4, 2]
        assert there.to(here).device.type == "cpu" and here.to(there).is_cuda and float(there.sum()) == 4


def test_the_fake_counts_waits() -> None:
    with fake_gpu() as seen:
        x = torch.arange(4.0, device="cuda")
        y = torch.zeros(4, device="cuda").where(x > 1, x) + x.clone()[1:3].sum()
        torch.ones(4).to("cuda", non_blocking=True)
        assert not seen.waits and not seen.sent
        assert bool((y > 0).all()) and len(x[x > 1]) == 2 and x.cpu().tolist()
        assert sorted(seen.waits) == ["_local_scalar_dense", "copy to the host", "index"]
        torch.tensor([1.0], device="cuda"), x[[0, 1]]
        assert seen.sent == 2


def test_what_is_saved_behind_the_fake_is_of_the_processor(tmp_path: Path) -> None:
    with fake_gpu():
        torch.save([torch.ones(1000, device="cuda") for _ in range(50)], tmp_path / "there.pt")
        torch.save([torch.ones(1000) for _ in range(50)], tmp_path / "beside.pt")
    torch.save([torch.ones(1000) for _ in range(50)], tmp_path / "behind.pt")
    for name in ("beside", "behind"):
        assert all(not each.is_cuda for each in torch.load(tmp_path / f"{name}.pt"))


# -- sampling ----------------------------------------------------------------------------------


@pytest.mark.parametrize("task", few(registry.names(), 3))
def test_every_task_is_sampled(task: str) -> None:
    context = 0 if task in ("generation", "partner_inpainting") else 8
    require_same(lambda device: model_of(device).predict(duet(), task, context=context, seed=1).plain())


@pytest.mark.parametrize("kind", some_slow(OPTIONS, "guided"))
def test_corrections_guidance_and_recordings(kind: str) -> None:
    made = lambda device: model_of(device, **OPTIONS[kind]).continue_(duet(8), 12, seed=1).plain()  # noqa: E731
    require_same(made, FAR.get(kind, 1e-4))


def test_live_partners_streams_and_crowds() -> None:
    def answered(device: str) -> Scene:
        partner = model_of(device).partner(duet().slice(0, 16), seed=0)
        return cat_time([partner.answer(duet().slice(start, start + 4)).plain() for start in (16, 20)])

    def streamed(device: str) -> Scene:
        model, generator = model_of(device), torch.Generator(device).manual_seed(1)
        chunks = stream(
            model, duet(8), registry.get("joint_future")(), 8, 12, options=model.sampler, generator=generator
        )
        return cat_time(list(chunks)).to("cpu")

    require_same(answered)
    require_same(streamed)
    require_same(lambda device: model_of(device).generate(4, 8, seed=0).plain(), 1e-3)


def test_scenes_on_a_gpu_are_written_shown_and_given(tmp_path: Path) -> None:
    made = Motion.of(duet(8))
    with fake_gpu():
        there = Motion.of(duet(8).to("cuda"))
        for suffix in (".npz", ".bvh", ".glb", ".csv", ".html", ".png"):
            there.save(tmp_path / f"there{suffix}")
        assert torch.allclose(there.on_floor().joints().cpu(), made.on_floor().joints(), atol=1e-5)
        assert len(there.show().data)
        model_of("cuda").continue_(there, 4, seed=0)
        model_of("cpu").continue_(there, 4, seed=0)
    made.save(tmp_path / "here.csv")
    assert (tmp_path / "here.csv").read_text() == (tmp_path / "there.csv").read_text()


# -- training ----------------------------------------------------------------------------------


class Steps(Callback):
    """Waits in training from the ninth step on, when all that is kept has been made, and a roll-out."""

    def __init__(self, seen: Seen) -> None:
        self.seen, self.found, self.before = seen, 0, 0

    def _count(self) -> int:
        return sum(self.seen.waits.values()) + self.seen.sent

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if batch_idx > 8:
            self.found += self._count() - self.before
        self.before = self._count()
        if batch_idx == 8:
            self.seen.where.clear()


def fitted(model: Any, folder: Path, seen: Seen | None = None, ckpt: Path | None = None, **options: Any) -> L.Trainer:
    callbacks: list[Callback] = [WeightEMA(0.9), *([Steps(seen)] if seen is not None else [])]
    if isinstance(model, Denoiser):
        callbacks.append(RollOuts(every=100, scenes=2, steps=2, frames=(8, 16), stretches=8))
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    where: dict[str, Any] = {"accelerator": "gpu", "devices": 1, "default_root_dir": folder, "num_sanity_val_steps": 0}
    options = {"max_steps": 13, "limit_val_batches": 1, **options}
    trainer = L.Trainer(**quiet, **where, callbacks=callbacks, **options)
    trainer.fit(model, FakeData(CLIPS, max_agents=3, batch_size=2), ckpt_path=ckpt)
    return trainer


def learner(**options: Any) -> Denoiser:
    losses = {name: 1.0 for name in ("delta", "near", "shake", "unfused", "joint", "velocity", "partner", "hands")}
    return tiny_denoiser(
        max_agents=3,
        window=16,
        network={"pairwise_posterior": True, "skip": True, "rope": "heads", "dropout": 0.1},
        loss={**losses, "decoded_share": 0.5},
        self_forcing={"share": 0.5, "displaced": 0.5},
        optimizer={"muon": 3.0},
        **options,
    )


def small_tokenizer() -> Tokenizer:
    quantizer = {"codebook_dim": 16, "codebook_size": 32}
    return tiny_tokenizer().__class__(network={"width": 16, "depth": 1}, quantizer=quantizer)


@pytest.fixture
def gpu() -> Iterator[Seen]:
    with fake_gpu(traced=True) as seen:
        yield seen


@pytest.mark.parametrize("make", [lambda: learner(cuda_graph=True), small_tokenizer], ids=["denoiser", "tokenizer"])
def test_a_training_waits_for_nothing_and_is_gone_on_with(make: Callable[[], Any], gpu: Seen, tmp_path: Path) -> None:
    """Nor does it copy anything that is waited for: a GPU would have done its step before the next one is begun."""
    trainer = fitted(make(), tmp_path, gpu, precision="bf16-mixed")
    (steps,) = (each for each in trainer.callbacks if isinstance(each, Steps))
    assert steps.before and not steps.found, "\n".join(f"{n} {w}" for w, n in gpu.where.most_common())
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    longer = fitted(make(), tmp_path, ckpt=tmp_path / "a.ckpt", gradient_clip_val=0.5, max_steps=15)
    assert longer.global_step == 15
    loaded = type(trainer.lightning_module).load(tmp_path / "a.ckpt")
    assert loaded.device.type == "cpu" and loaded.to("cuda").device.type == "cuda"


@pytest.mark.slow
@pytest.mark.parametrize("task", ["joint_future", "motion_control"])
def test_tables_are_those_of_a_cpu(task: str, tmp_path: Path) -> None:
    clips = [random_clip(f"{split}{k}", 120, 2, split=split) for split in ("train", "test") for k in range(3)]
    data = FakeData(clips, max_agents=3)
    held_out = dataclasses.replace(data.test, context_frames=16, horizon_frames=20, batch_size=3)

    def rows(accelerator: str) -> dict[str, dict[str, float]]:
        how = {"sampler": SamplerOptions(steps=2, stride=2), "samples": 3, "baseline_stride": 10}
        evaluator = Evaluator(tiny_denoiser(max_agents=3), task=registry.get(task)(), **how)
        trainer = L.Trainer(accelerator=accelerator, devices=1, logger=False, default_root_dir=tmp_path)
        trainer.test(evaluator, FakeData(clips, max_agents=3, test=held_out), verbose=False)
        return evaluator.results.rows

    expected = rows("cpu")
    with fake_gpu():
        got = rows("gpu")
    assert got.keys() == expected.keys()
    for method, row in expected.items():
        assert got[method] == pytest.approx(row, rel=1e-3, abs=1e-5, nan_ok=True), method


@pytest.mark.slow
def test_the_commands_benchmark_measures(gpu: Seen, tmp_path: Path) -> None:
    words = "bench --quick --task joint_future --frames 8 --steps 2 --rounds 1 --live 0.2 --device cuda"
    for more in ([], ["--compile"]):
        assert main([*words.split(), *more, "--out", str(tmp_path / "a.json")]) == 0
