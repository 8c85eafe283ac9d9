"""Couples stay together in scenes that go on for long; nobody else is led."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from magnet.denoiser.options import Sampling
from magnet.generation.couples import BACK, COUPLE, LONG, Couples
from magnet.generation.rollout import generate, stream
from magnet.motion.scene import FPS, Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tasks.joint import JointFuture
from magnet.testing import random_scene

REACH, TINY = 2.0, 1.0


def walked(couples: Couples, speed: float, blocks: int, apart: float = 1.0, people: int = 2, block: int = 48) -> Tensor:
    """Distances of the first two, who walk away from each other from where they were led to; others stand far away."""
    ground = torch.zeros(1, 1, people, 2)
    ground[..., 1, 0] = apart
    ground[..., 2:, 1] = 9.0
    found = []
    for _ in range(blocks):
        way = torch.zeros(1, block, people, 2)
        way[..., 0, 0], way[..., 1, 0] = -speed / 2 / FPS, speed / 2 / FPS
        new = torch.cat([ground, ground + way.cumsum(dim=1)], dim=1)
        moved = couples.led(new, torch.ones(block, people, dtype=torch.bool), torch.ones(1, people, dtype=torch.bool))
        assert torch.allclose(moved[..., 0, :], -moved[..., 1, :]) and not bool(moved[..., 2:, :].any())
        made = new[:, 1:] + moved
        found.append((made[0, :, 0] - made[0, :, 1]).norm(dim=-1))
        ground = made[:, -1:]
    return torch.cat(found)


@pytest.mark.parametrize("people", [2, 3])
@pytest.mark.parametrize("speed", [0.1, 1.0, 3.0])
def test_a_couple_that_walks_apart_stays_within_reach(speed: float, people: int) -> None:
    couples = Couples(REACH)
    walked(couples, 0.0, 3, people=people)
    assert float(walked(couples, speed, 12, people=people).max()) <= REACH


def test_who_pass_each_other_part() -> None:
    """Within reach for less than three seconds."""
    apart = walked(Couples(REACH), 2.0, 6, apart=0.5)
    assert float(apart[-1]) == pytest.approx(0.5 + 2.0 * 6 * 48 / FPS, abs=1e-3)


def test_who_is_near_is_not_led() -> None:
    couples = Couples(REACH)
    assert torch.allclose(walked(couples, 0.0, 4), torch.ones(192)) and int(couples.together.min()) == 192
    ground = torch.rand(1, 49, 2, 2, generator=torch.Generator().manual_seed(1))  # anywhere within 1.4 m
    free, present = torch.ones(48, 2, dtype=torch.bool), torch.ones(1, 2, dtype=torch.bool)
    assert not bool(couples.led(ground, free, present).any())


def test_who_is_far_apart_comes_slowly_back() -> None:
    couples = Couples(REACH)
    walked(couples, 0.0, 3)
    apart = walked(couples, 0.0, 6, apart=REACH)
    speed = apart.diff() * FPS
    assert float(speed.min()) >= -BACK * 1.01 and float(apart[-1]) < 0.9 * REACH and bool((speed <= 1e-4).all())


@pytest.mark.parametrize("which", ["given", "absent", "not new"])
def test_only_couples_who_may_both_be_moved_are_led(which: str) -> None:
    couples = Couples(REACH)
    walked(couples, 0.0, 3)
    ground = torch.zeros(1, 49, 2, 2)
    ground[0, :, 1, 0] = torch.linspace(1.0, 4.0, 49)
    free, present = torch.ones(48, 2, dtype=torch.bool), torch.ones(1, 2, dtype=torch.bool)
    if which == "given":
        free[:, 1] = False
    elif which == "absent":
        present[0, 1] = False
    else:
        free[:] = False
    assert not bool(couples.led(ground, free, present).any())


def test_scenes_are_counted_by_themselves() -> None:
    """One couple stays, the other parts while nobody is led; then both walk apart."""
    couples = Couples(REACH)
    ground = torch.zeros(2, 1 + COUPLE, 2, 2)
    ground[0, :, 1, 0] = 1.0
    ground[1, :, 1, 0] = torch.linspace(1.0, 5.0, 1 + COUPLE)
    present = torch.ones(2, 2, dtype=torch.bool)
    couples.led(ground, torch.zeros(COUPLE, 2, dtype=torch.bool), present)
    assert couples.together[:, 0, 1].tolist() == [COUPLE, 0]
    away = torch.zeros(2, 49, 2, 2)
    away[..., 1, 0] = torch.linspace(1.9, 3.0, 49)
    moved = couples.led(away, torch.ones(48, 2, dtype=torch.bool), present)
    assert bool(moved[0].any()) and not bool(moved[1].any())


# -- in samples --------------------------------------------------------------------------------


def options(together: float | None, **more: object) -> SamplerOptions:
    """With pairwise transforms that keep the tiny model's people .9 m apart."""
    how = {"pairwise_weight": 0.05, "settle": "off", **more}
    return SamplerOptions(2, 4, pyramid_offset=0, together=together, **how)  # type: ignore[arg-type]


def made(model, start: Scene, together: float | None, tokens: int = LONG + 24, task=None, seed: int = 0) -> Scene:
    generators = [torch.Generator().manual_seed(seed + b) for b in range(start.scenes)]
    frames = tokens * TOKEN_FRAMES
    return generate(model, start, task or JointFuture(), 8, frames, 1, options(together), generators)


def apart(scene: Scene) -> Tensor:
    """(B, T) metres between the first two people's canonical frames over the ground, about."""
    ground = scene.T_world_root[..., [0, 2], 3]
    return (ground[:, :, 0] - ground[:, :, 1]).norm(dim=-1)


@pytest.fixture(scope="module")
def start() -> Scene:
    return random_scene(1, 8, 2, torch.Generator().manual_seed(3))


def test_what_is_made_long_after_what_was_given_is_led_and_nothing_before(model, start) -> None:
    """The tiny model's people are some .9 m apart: nearer to their reach than nobody is led at."""
    plain, led = made(model, start, None), made(model, start, TINY)
    same = (plain.T_world_root == led.T_world_root).flatten(2).all(dim=-1)[0]
    assert bool(same[: 8 + (LONG - 4) * TOKEN_FRAMES].all()) and not bool(same[-1])
    assert float(apart(led)[0, -48:].mean()) < 0.95 * float(apart(plain)[0, -48:].mean())
    assert torch.equal(made(model, start, 0.0).T_world_root, plain.T_world_root)


def test_a_model_says_how_far_its_couples_go(model, start, monkeypatch) -> None:
    led = made(model, start, TINY)
    monkeypatch.setattr(model, "sampling", Sampling(together=TINY))
    assert torch.equal(made(model, start, None).T_world_root, led.T_world_root)


def test_a_stream_is_led_as_a_whole_scene_is(model, start) -> None:
    frames = (LONG + 24) * TOKEN_FRAMES
    how = options(TINY), [torch.Generator().manual_seed(0)]
    streamed = cat_time(list(stream(model, start, JointFuture(), 8, frames, 1, *how)))
    assert torch.allclose(streamed.T_world_root, made(model, start, TINY).T_world_root, atol=1e-5)


@pytest.mark.parametrize("name", [name for name in registry.names() if registry.get(name) is not JointFuture])
def test_nobody_is_led_beside_somebody_given_nor_live(model, name) -> None:
    recording = random_scene(1, 8 + (LONG + 8) * TOKEN_FRAMES, 2, torch.Generator().manual_seed(3))
    task = registry.get(name)()
    plain, led = (made(model, recording, together, LONG + 8, task) for together in (None, TINY))
    if name != "generation":
        assert torch.equal(plain.T_world_root, led.T_world_root)
