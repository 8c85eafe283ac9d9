"""Off a CPU a training step has fixed shapes and looks at no number, so that a CUDA graph can hold it."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from magnet.denoiser.module import Denoiser
from magnet.denoiser.options import SelfForcing
from magnet.denoiser.self_forcing import MadePasts, displaced_at_first, with_made_pasts, with_self_forcing
from magnet.motion.scene import Scene
from magnet.testing import random_scene, tiny_denoiser
from magnet.waiting import as_off_cpu
from tests.counting import Counting

N = 8
ALL_LOSSES = {
    **{name: 1.0 for name in ("delta", "near", "shake", "unfused", "joint", "velocity", "partner", "hands")},
    "decoded_share": 0.5,
}
KINDS: dict[str, dict[str, Any]] = {
    "duet": {
        "network": {"pairwise_posterior": True, "skip": True, "rope": "heads"},
        "noise": {"distribution": "mixture", "shift": 3.0, "faint_past": 0.5, "live": 0.3},
        "loss": ALL_LOSSES,
    },
    "paper": {},
    "continuous": {"target": "continuous", "loss": ALL_LOSSES},
    "alone": {"max_agents": 1, "network": {"pairwise": False}},
    "causal": {"network": {"causal_block": 2}, "loss": {"weighting": "min_snr"}},
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Scenes of one, two and three people, one of them with frames that do not count."""
    present = torch.arange(3) < torch.tensor([[1], [2], [3], [2], [3], [1]])
    made = random_scene(6, 4 * N, 3, torch.Generator().manual_seed(5), present)
    valid = torch.ones(6, 4 * N, dtype=torch.bool)
    valid[2, 20:] = False
    return made.replace(valid=valid, names=tuple("abcdef"))


def taught(kind: str, **more: Any) -> Denoiser:
    return tiny_denoiser(**{"max_agents": 3, "window": N, **KINDS[kind], **more}).train()


def shown(kind: str, scene: Scene) -> Scene:
    return scene if kind != "alone" else scene.permute_agents(torch.tensor([0])).replace(names=())


@pytest.mark.parametrize("kind", KINDS)
def test_a_training_step_looks_at_nothing_and_sends_nothing_off_a_cpu(
    kind: str, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Denoiser, "global_step", 1)
    model, batch = taught(kind, self_forcing={"share": 0.5, "displaced": 0.5}), shown(kind, scene)
    past = MadePasts(batch.select([0, 1]), 3, 0.5)
    assert (batch.names and past.scenes.names) or kind == "alone"

    def step() -> None:
        generator = torch.Generator().manual_seed(0)
        moved, made = with_made_pasts(displaced_at_first(batch, 0.5, generator), past, generator)
        model.losses(moved, generator, made)["loss"].backward()

    with as_off_cpu():
        step()  # what is kept from step to step is made
        with Counting() as counted:
            step()
    assert (counted.waits, counted.sent) == ([], 0)
    assert all(each.grad is not None and bool(each.grad.isfinite().all()) for each in model.trained())


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_same_step(kind: str, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Denoiser, "global_step", 1)
    model, batch = taught(kind, network={**KINDS[kind].get("network", {}), "dropout": 0.0}), shown(kind, scene)

    def step() -> tuple[dict[str, float], list[torch.Tensor]]:
        losses = model.losses(batch, torch.Generator().manual_seed(4))
        grads = torch.autograd.grad(losses["loss"], model.trained(), allow_unused=True)
        return {name: float(value.detach()) for name, value in losses.items()}, [g for g in grads if g is not None]

    here, grads = step()
    with as_off_cpu():
        off, other = step()
    assert off == pytest.approx(here, rel=1e-4, abs=1e-6)
    for a, b in zip(grads, other, strict=True):
        assert torch.allclose(a, b, rtol=1e-3, atol=1e-4 * float(a.abs().max()) + 1e-8)


def test_off_a_cpu_the_first_scenes_live_on_pasts_of_the_models_own(scene: Scene) -> None:
    model = taught("duet").eval()
    truth = model.normalizer.normalize(model.tokenize(scene)[0])
    levels = torch.full((6, N, 3), 500)
    levels[:, :3] = 0
    levels[1] = 500  # no past
    with as_off_cpu():
        generator = torch.Generator().manual_seed(0)
        changed = with_self_forcing(model, truth, levels, scene, SelfForcing(0.5), generator) != truth
    assert changed.flatten(1).any(dim=1).tolist() == [True, False, True, False, False, False]
    assert not changed[:, 4:, :, : model.layout.latent].any()  # a transform into the next token moves with its past
