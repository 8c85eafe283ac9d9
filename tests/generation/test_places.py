"""Where people stand, in a scene whose rows come and go."""

import torch

from magnet.generation.conditioning import mask_unknown
from magnet.generation.places import Places
from magnet.motion.frames import canonical_frame
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid
from magnet.tasks.inbetweening import Inbetweening

OPTIONS = SamplerOptions(steps=2, stride=2)


def test_rows_taken_in_one_after_the_other_are_those_taken_in_at_once(model, scene):
    schedule = Inbetweening(every=5).schedule(Grid(16, 3, 2, 2, 8, 2))
    whole = Places(model, mask_unknown(scene, schedule.known), schedule, OPTIONS, 2)
    grown = Places(model, mask_unknown(scene, schedule.known, 0, 0), schedule, OPTIONS, 2)
    for start, stop in ((0, 3), (3, 4), (4, 16)):
        grown.extend(mask_unknown(scene, schedule.known, start, stop), schedule.known[start:stop])
    for name in ("known", "placed", "T_world_can"):
        assert torch.equal(getattr(whole, name), getattr(grown, name))
    assert torch.equal(whole.given.body_rot, grown.given.body_rot)


def test_rows_let_go_are_forgotten_but_for_whether_anybody_was_known_there(model, scene):
    schedule = Inbetweening(keys=(6,)).schedule(Grid(16, 3, 0, 2, 8, 2))
    world = Places(model, mask_unknown(scene, schedule.known), schedule, OPTIONS, 1)
    world.release(6)
    assert not world.rooted
    assert torch.equal(world.T_world_can[:, :4], canonical_frame(scene.T_world_root)[:, 24:28])
    world.release(1)
    assert world.rooted
    assert (len(world.known), world.given.frames) == (9, 36)
