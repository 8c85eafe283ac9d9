"""Models of half and double precision: the networks change, statistics, codes and geometry do not."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path

import lightning as L
import pytest
import torch
from torch.utils.data import DataLoader

import magnet
from magnet.api import Model, Motion
from magnet.body import load_body
from magnet.denoiser.module import Denoiser
from magnet.export import save_bvh
from magnet.generation.live import Live
from magnet.generation.rollout import generate, stream
from magnet.motion.scene import Scene
from magnet.precision import Float32, accelerator_of, device_of, quick_precision
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser
from tests.cases import few

FAR = {torch.float64: 1e-4, torch.float16: 0.05, torch.bfloat16: 0.5}
"""Metres that a joint may lie from where float32 puts it; an untrained model's codes may flip where they round."""


@functools.cache
def model_of(dtype: torch.dtype) -> Denoiser:
    return tiny_denoiser(3).to(dtype)


@functools.cache
def sampled(dtype: torch.dtype, task: str, guidance: Guidance | None = None) -> Scene:
    context = 0 if task in ("generation", "partner_inpainting") else 16
    scene = random_scene(1, 40, 2, torch.Generator().manual_seed(1))
    generator = torch.Generator().manual_seed(2)
    sampler = SamplerOptions(steps=2, guidance=guidance or Guidance())
    return generate(model_of(dtype), scene, registry.get(task)(), context, 16, options=sampler, generator=generator)


@pytest.mark.parametrize("dtype", FAR, ids=str)
@pytest.mark.parametrize("task", few(registry.names(), 4))
def test_every_task_is_sampled_with_a_model_of_any_precision(task, dtype):
    expected, got = sampled(torch.float32, task), sampled(dtype, task)
    assert got.T_world_root.dtype == got.body_rot.dtype == torch.float32
    joints = [load_body().joints(scene) for scene in (expected, got)]
    assert (joints[0] - joints[1]).norm(dim=-1).max() < FAR[dtype]
    assert got.given is not None
    assert torch.equal(got.T_world_root[got.given], expected.T_world_root[got.given])


@pytest.mark.parametrize("kind", ["history", "none"])
def test_guidance_and_smoothing_take_a_double_model(kind):
    guidance = Guidance(kind=kind, smooth=0.01)
    expected, got = (sampled(dtype, "joint_future", guidance) for dtype in (torch.float32, torch.float64))
    assert torch.allclose(got.T_world_root, expected.T_world_root, atol=1e-4)


@pytest.mark.parametrize("dtype", FAR, ids=str)
def test_statistics_and_codes_keep_every_bit(dtype):
    model, other = tiny_denoiser(2), tiny_denoiser(2).to(dtype)
    kept = [name for name, module in model.named_modules() if isinstance(module, Float32)]
    assert {name.split(".")[-1] for name in kept} == {"pose", "deltas", "betas", "quantizer", "normalizer"}
    for name in kept:
        theirs = other.get_submodule(name).state_dict()
        for key, value in model.get_submodule(name).state_dict().items():
            assert theirs[key].dtype == value.dtype and torch.equal(theirs[key], value)
    assert {parameter.dtype for parameter in other.parameters()} == {dtype}
    assert torch.equal(other.float().normalizer.mean, model.normalizer.mean)


def test_what_keeps_its_precision_moves_with_its_model():
    model = tiny_denoiser(2).to("meta", torch.bfloat16)
    assert {(buffer.device.type, buffer.dtype) for buffer in model.normalizer.buffers()} == {
        ("meta", torch.float32),
        ("meta", torch.bool),
    }


@pytest.mark.parametrize("precision", ["64-true", "bf16-true", "16-true"])
@pytest.mark.parametrize("part", ["denoiser", "tokenizer"])
def test_a_trainer_that_would_convert_scenes_is_refused(part, precision, tmp_path):
    """Networks may be converted, scenes may not; Lightning would do both."""
    model = tiny_denoiser(2)
    trainer = L.Trainer(
        precision=precision, logger=False, enable_checkpointing=False, default_root_dir=tmp_path, accelerator="cpu"
    )
    loader = DataLoader([random_scene(1, 64, 2, torch.Generator().manual_seed(0))], batch_size=None)
    with pytest.raises(ValueError, match=f"^trainer.precision {precision} would convert scenes too"):
        trainer.validate(model if part == "denoiser" else model.tokenizer, loader, verbose=False)


@pytest.mark.parametrize(
    "capability, knows, taken",
    [
        ("AVX2", False, "32-true"),
        ("DEFAULT", False, "32-true"),
        ("AVX512", False, "32-true"),
        ("AVX512", True, "bf16-mixed"),
    ],
)
def test_a_processor_that_emulates_bfloat16_trains_in_float32(
    capability: str, knows: bool, taken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: knows)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)
    assert quick_precision("bf16-mixed", "cpu") == taken


@pytest.mark.parametrize("precision, accelerator", [("16-mixed", "cpu"), ("bf16-mixed", "gpu"), (None, "auto")])
def test_what_else_was_asked_for_stays(
    precision: str | None, accelerator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    assert quick_precision(precision, accelerator) == precision


@pytest.fixture
def double() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def made_by(model: Model, duet: Scene, bvh: list[Path]) -> list[Scene]:
    read = magnet.read(*bvh).plain()
    answer = model.partner(duet.slice(0, 16), seed=0).answer(duet.slice(16, 24))
    return [
        read,
        model.generate(2, 12, seed=0).plain(),
        model.generate(4, 8, seed=0).plain(),
        model.continue_(duet.slice(0, 16), 8, seed=0).plain(),
        answer.plain(),
    ]


def test_another_default_dtype_of_torch_changes_nothing(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    model = Model(tiny_denoiser(max_agents=3), SamplerOptions(steps=2, settle="hold"))
    duet = random_scene(1, 24, 2, torch.Generator().manual_seed(5))
    bvh = save_bvh(duet, tmp_path / "a.bvh", load_body())
    before = made_by(model, duet, bvh)
    request.getfixturevalue("double")
    loaded = magnet.load("duet", steps=1).denoiser
    assert {p.dtype for p in (*loaded.parameters(), *loaded.buffers()) if p.is_floating_point()} == {torch.float32}
    for was, now in zip(before, made_by(model, duet, bvh), strict=True):
        for name, value in now.tensors().items():
            assert value.dtype == getattr(was, name).dtype and torch.equal(value, getattr(was, name)), name


@pytest.fixture
def elsewhere() -> Iterator[None]:
    torch.set_default_device("meta")  # of which nobody can read a number
    yield
    torch.set_default_device(None)


def test_another_default_device_of_torch_changes_nothing(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    model = Model(tiny_denoiser(max_agents=3), SamplerOptions(steps=2, settle="hold"))
    duet = random_scene(1, 24, 2, torch.Generator().manual_seed(5))
    bvh = save_bvh(duet, tmp_path / "a.bvh", load_body())
    before = made_by(model, duet, bvh)
    request.getfixturevalue("elsewhere")
    loaded = magnet.load("duet", steps=1).denoiser
    assert {value.device.type for value in (*loaded.parameters(), *loaded.buffers())} == {"cpu"}
    live = Live(model, people=2)
    live.settings.steps = 2
    assert live.advance().frames and live.scene.device.type == "cpu"
    for was, now in zip(before, made_by(model, duet, bvh), strict=True):
        assert all(torch.equal(value, getattr(was, name)) for name, value in now.tensors().items())
        assert torch.equal(Motion.of(now).on_floor().joints(), Motion.of(was).on_floor().joints())
    for suffix in (".npz", ".bvh", ".glb", ".csv", ".html"):
        assert Motion.of(duet).save(tmp_path / f"b{suffix}").exists()


def test_between_two_chunks_the_default_device_is_the_callers(elsewhere: None) -> None:
    with torch.device("cpu"):
        model, duet = tiny_denoiser(), random_scene(1, 16, 2, torch.Generator().manual_seed(5))
    chunks = stream(model, duet, registry.get("joint_future")(), 16, 16, options=SamplerOptions(steps=1), chunk=2)
    made = []
    for chunk in chunks:
        assert torch.zeros(1).device.type == "meta"
        made.append(chunk.T_world_root.device.type)
    assert len(made) > 1 and set(made) == {"cpu"}


def test_apples_gpu_which_has_no_float64_is_not_taken_by_itself_and_refused_if_asked_for(monkeypatch) -> None:
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert [accelerator_of(asked) for asked in (None, "auto", "cpu")] == ["cpu"] * 3
    for asked in ("mps", "gpu"):
        with pytest.raises(ValueError, match=f"accelerator {asked}: torch has no float64 on Apple's GPUs"):
            accelerator_of(asked)
    with pytest.raises(ValueError, match="device mps: torch has no float64 on Apple's GPUs"):
        device_of("mps")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert [accelerator_of(asked) for asked in ("auto", "gpu")] == ["auto", "gpu"]
