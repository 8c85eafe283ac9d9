"""The world of a scene whose rows come and go."""

import pytest
import torch

from magnet.denoiser.canvas import Canvas
from magnet.denoiser.generation import SamplerOptions, scrub
from magnet.denoiser.seams import hold
from magnet.motion.frames import canonical_frame
from magnet.sampling.schedule import Grid
from magnet.tasks.inbetweening import Inbetweening
from magnet.testing import tiny_denoiser

OPTIONS = SamplerOptions(steps=2, stride=2)


@pytest.fixture(scope="module")
def model():
    return tiny_denoiser(max_agents=3, window=8)


def test_rows_taken_in_one_after_the_other_are_those_taken_in_at_once(model, scene):
    schedule = Inbetweening(every=5).schedule(Grid(16, 3, 2, 2, 8, 2))
    whole = Canvas(model, scrub(scene, schedule.known), schedule, OPTIONS, 2)
    grown = Canvas(model, scrub(scene, schedule.known, 0, 0), schedule, OPTIONS, 2)
    for start, stop in ((0, 3), (3, 4), (4, 16)):
        grown.extend(scrub(scene, schedule.known, start, stop), schedule.known[start:stop])
    for name in ("known", "placed", "T_world_can"):
        assert torch.equal(getattr(whole, name), getattr(grown, name))
    assert torch.equal(whole.given.body_rot, grown.given.body_rot)


def test_rows_let_go_are_forgotten_but_for_whether_anybody_was_known_there(model, scene):
    schedule = Inbetweening(keys=(6,)).schedule(Grid(16, 3, 0, 2, 8, 2))
    canvas = Canvas(model, scrub(scene, schedule.known), schedule, OPTIONS, 1)
    canvas.release(6)
    assert not canvas.rooted
    assert torch.equal(canvas.T_world_can[:, :4], canonical_frame(scene.T_world_root)[:, 24:28])
    canvas.release(1)
    assert canvas.rooted
    assert (len(canvas.known), canvas.given.frames) == (9, 36)


def test_settling_changes_nothing_but_what_it_is_told_of(model, scene):
    """And the step into a known token, once the gap in front of it is closed."""
    schedule = Inbetweening(keys=(4,)).schedule(Grid(8, 3, 2, 2, 8, 2))
    canvas = Canvas(model, scrub(scene, schedule.known), schedule, OPTIONS, 1)
    tokens = torch.randn(2, 8, 3, model.layout.width, generator=torch.Generator().manual_seed(0))
    finished = torch.zeros(8, 3, dtype=torch.bool)
    finished[2:4] = True
    settled = canvas.settle(tokens.clone(), finished)
    changed = (settled != tokens).any(dim=0)
    assert changed[2:4].all(dim=-1).all()
    assert not changed[[0, 1, 5, 6, 7]].any()
    step = torch.zeros(model.layout.width, dtype=torch.bool)
    step[model.layout.latent : model.layout.latent + 9] = True
    assert torch.equal(changed[4], step.expand(3, -1) & changed[4]) and changed[4].any()


def test_whoever_has_ended_stands_as_in_the_frame_before(scene):
    there = torch.ones(8, 3, dtype=torch.bool)
    there[3:, 1], there[:, 2] = False, False
    part = scene.cut(20, 28)
    held = hold(part, there, scene.cut(19, 20))
    assert torch.equal(held.T_world_root[:, :, 0], part.T_world_root[:, :, 0])
    assert torch.equal(held.T_world_root[:, 3:, 1], part.T_world_root[:, 2:3, 1].expand(-1, 5, -1, -1))
    assert torch.equal(held.body_rot[:, :, 2], scene.body_rot[:, 19:20, 2].expand(-1, 8, -1, -1, -1))
