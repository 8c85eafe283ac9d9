"""What has been made is shown to the model a little noisy, what was given is not."""

from __future__ import annotations

import pytest
import torch

from magnet.generation.rollout import generate, stream
from magnet.motion.scene import Scene, cat_time
from magnet.sampling.faint import shown_clean, steps_since
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


@pytest.mark.parametrize("name", ["joint_future", "motion_control"])
def test_a_stream_knows_how_long_ago_somebody_was_given(model, name) -> None:
    """Rows that are let go hold what was given last; frames come as from one call."""
    start = random_scene(1, 80, 2, torch.Generator().manual_seed(4))
    guidance = Guidance(stabilization_level=300, stabilization_after=5)
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
