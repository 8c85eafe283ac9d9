"""What has been made is shown to the model a little noisy, what was given is not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from magnet.generation import places
from magnet.generation.rollout import generate, stream
from magnet.motion.scene import Scene, cat_time, concatenate
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.faint import faint_levels, shown_clean, steps_since
from magnet.sampling.grid import Grid
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tasks.joint import JointFuture
from magnet.testing import random_scene


def test_a_recorded_past_is_shown_clean_and_only_what_is_made_is_not(model) -> None:
    """Blocks of 4 token steps after two that are given; decoded frames depend on a few behind them as well."""
    short = random_scene(1, 8, 2, torch.Generator().manual_seed(3))

    def made(level: int | None) -> Scene:
        options = SamplerOptions(3, 4, pyramid_offset=0, guidance=Guidance(stabilization_level=level))
        return generate(model, short, JointFuture(), 8, 32, 1, options, torch.Generator().manual_seed(0))

    clean, shaken = made(0), made(300)
    same = (clean.T_world_root == shaken.T_world_root).flatten(3).all(dim=-1)[0].all(dim=-1)
    assert bool(same[:16].all()) and not bool(same[28:].any())
    assert torch.equal(made(None).T_world_root, clean.T_world_root)


def test_for_a_while_after_what_was_given_all_is_shown_clean(model) -> None:
    """Six token steps after the given ones are the first block and half of the next: only what comes later differs."""
    short = random_scene(1, 8, 2, torch.Generator().manual_seed(3))

    def made(after: int, level: int = 300) -> Scene:
        guidance = Guidance(stabilization_level=level, stabilization_after=after)
        options = SamplerOptions(3, 4, pyramid_offset=0, guidance=guidance)
        return generate(model, short, JointFuture(), 8, 56, 1, options, torch.Generator().manual_seed(0))

    clean, late, never = made(0, 0), made(8), made(99)
    same = (clean.T_world_root == late.T_world_root).flatten(3).all(dim=-1)[0].all(dim=-1)
    assert bool(same[:32].all()) and not bool(same[60:].any())
    assert torch.equal(clean.T_world_root, never.T_world_root)


@pytest.mark.parametrize("level", [0, 300])
@pytest.mark.parametrize("name", ["joint_future", "partner_inpainting", "motion_control"])
def test_after_what_was_shown_faintly_people_take_up_the_speed_they_had(model, name, level, monkeypatch) -> None:
    """Of those who are made, from the second stride on, where the past was shown noisily; live tokens do otherwise."""
    start, task = random_scene(1, 64, 2, torch.Generator().manual_seed(4)), registry.get(name)()
    guidance = Guidance(stabilization_level=level, stabilization_beside=level)
    options = SamplerOptions(3, 4, pyramid_offset=0, guidance=guidance, settle="off", smooth_path=True)

    def made() -> torch.Tensor:
        return generate(model, start, task, 8, 48, 1, options, torch.Generator().manual_seed(0)).T_world_root

    plain = made()
    sideways = torch.eye(4)
    sideways[0, 3] = 5.0
    monkeypatch.setattr(places, "taken_up", lambda before, path: sideways @ path)
    moved = (made() - plain)[0, ..., 0, 3] > 2
    if not level or name == "motion_control":
        assert not bool(moved.any())
    else:
        assert not bool(moved[:30].any()) and bool(moved[33:, 0].all())
        assert bool(moved[33:, 1].all()) == (name == "joint_future")


@pytest.mark.parametrize("name", registry.names())
def test_beside_somebody_given_what_was_made_is_shown_faintly_but_not_live(model, name) -> None:
    """Of all tasks partner inpainting alone changes, and nothing before its second block does."""
    start, task = random_scene(1, 64, 2, torch.Generator().manual_seed(4)), registry.get(name)()

    def made(level: int | None) -> Scene:
        options = SamplerOptions(3, 4, pyramid_offset=0, guidance=Guidance(stabilization_beside=level))
        return generate(model, start, task, 8, 48, 1, options, torch.Generator().manual_seed(0))

    clean, shaken = made(None), made(700)
    if name != "partner_inpainting":
        assert torch.equal(clean.T_world_root, shaken.T_world_root)
        return
    same = (clean.T_world_root == shaken.T_world_root).flatten(3).all(dim=-1)[0]
    assert bool(same[:, 1].all()), "who is given stays"
    assert bool(same[:12, 0].all()) and not bool(same[28:, 0].any())


@pytest.mark.parametrize("name", registry.names())
def test_who_does_not_see_the_others_sees_the_own_past_faintly(model, name) -> None:
    """In step alone, from the third token on: the first sees what was given, the second one token that was made."""
    start, task = random_scene(1, 64, 2, torch.Generator().manual_seed(4)), registry.get(name)()

    def made(level: int | None) -> Scene:
        guidance = Guidance(stabilization_unseen=level)
        options = SamplerOptions(3, 4, pyramid_offset=0, turn=1, guidance=guidance, settle="off")
        return generate(model, start, task, 8, 48, 1, options, torch.Generator().manual_seed(0))

    clean, shaken = made(None), made(300)
    same = (clean.T_world_root == shaken.T_world_root).flatten(3).all(dim=-1)[0].all(dim=-1)
    if name != "agentic_sync":
        assert bool(same.all())
        return
    assert bool(same[: 8 + TOKEN_FRAMES].all()), "what is decoded of the second depends on the third"
    assert not bool(same[8 + 5 * TOKEN_FRAMES :].any())


def test_one_person_in_step_is_sampled_as_beside_a_couple(model) -> None:
    """Nobody else is there to be unseen, but what is made of a scene must not depend on what else is in its batch."""
    couple = random_scene(1, 40, 2, torch.Generator().manual_seed(4))
    alone = couple.replace(present=torch.tensor([[True, False]]))
    options = SamplerOptions(3, 4, guidance=Guidance(stabilization_unseen=300), settle="off")

    def made(scene: Scene, *seeds: int) -> Scene:
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        return generate(model, scene, registry.get("agentic_sync")(), 8, 32, 1, options, generators)

    both, one = made(concatenate([couple, alone]), 1, 2).select([1]), made(alone, 2)
    assert torch.allclose(both.T_world_root[:, :, 0], one.T_world_root[:, :, 0], atol=1e-4)


def test_of_two_levels_the_higher_one_counts() -> None:
    """Five token steps, one given: that of long scenes begins later."""
    known = torch.tensor([[True], [False], [False], [False], [False]]).expand(5, 2)
    stage = registry.get("agentic_sync")().schedule(Grid(tokens=5, agents=2, context=1)).stages[-1]
    guidance = Guidance(stabilization_level=450, stabilization_after=2, stabilization_unseen=100)

    def shown(guidance: Guidance) -> list[int]:
        levels = faint_levels(guidance, known, stage, live=True)
        assert levels is not None
        return levels[:, 0].tolist()

    assert shown(guidance) == [0, 0, 100, 450, 450]
    assert shown(replace(guidance, stabilization_level=50)) == [0, 0, 100, 100, 100]
    assert shown(replace(guidance, stabilization_unseen=0)) == [0, 0, 0, 450, 450]


def test_beside_somebody_given_nothing_is_shown_less_faintly_than_alone() -> None:
    known = torch.tensor([[True, True], [False, True], [False, True]])
    stage = registry.get("partner_inpainting")().schedule(Grid(tokens=3, agents=2, context=1)).stages[-1]

    def shown(level: int | None, beside: int) -> list[int]:
        guidance = Guidance(stabilization_level=level, stabilization_after=1, stabilization_beside=beside)
        levels = faint_levels(guidance, known, stage)
        assert levels is not None and not levels[:, 1].any()
        return levels[:, 0].tolist()

    assert shown(None, 300) == [0, 300, 300]
    assert shown(450, 300) == [0, 450, 450]
    assert shown(450, 700) == [0, 700, 700]


@pytest.mark.parametrize("name", ["joint_future", "motion_control", "agentic_sync"])
def test_a_stream_knows_how_long_ago_somebody_was_given(model, name) -> None:
    """Rows that are let go hold what was given last; frames come as from one call."""
    start = random_scene(1, 80, 2, torch.Generator().manual_seed(4))
    guidance = Guidance(stabilization_level=300, stabilization_after=5, stabilization_unseen=100)
    options = SamplerOptions(2, 2, pyramid_offset=0, guidance=guidance, settle="off")
    task = registry.get(name)()
    whole = generate(model, start, task, 8, 72, 1, options, torch.Generator().manual_seed(0))
    parts = list(
        stream(model, start, task, 8, 72, options=options, generator=torch.Generator().manual_seed(0), chunk=3)
    )
    assert len(parts) > 5
    assert torch.allclose(cat_time(parts).T_world_root, whole.T_world_root, atol=1e-5)


def test_what_is_shown_clean_is_counted_across_rows_that_were_let_go() -> None:
    known = torch.zeros(12, 2, dtype=torch.bool)
    known[:2, 0] = known[5, 0] = True
    whole = shown_clean(known, 2)
    assert (
        whole[:, 0].tolist() == [True] * 4 + [False] + [True] * 3 + [False] * 4
        and whole[:, 1].tolist() == [True] * 2 + [False] * 10
    )
    for rows in (1, 4, 6, 9):
        since = steps_since(known[:rows])
        assert torch.equal(shown_clean(known[rows:], 2, since), whole[rows:])
        assert torch.equal(steps_since(known[rows:], since), steps_since(known))
