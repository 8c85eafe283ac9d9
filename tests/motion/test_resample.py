import pytest
import torch

from magnet.motion.resample import at_speed, resampled
from magnet.motion.rotations import geodesic
from magnet.testing import random_scene


@pytest.mark.parametrize("speed", [0.5, 0.9, 1.1, 2.0])
def test_the_same_poses_are_met_at_another_time(speed, generator):
    scene = random_scene(1, 61, 2, generator)
    other = at_speed(scene, speed)
    assert other.frames == int(60 / speed) + 1
    for frame in range(0, 61, 10):
        at = frame / speed
        if at == int(at) and at < other.frames:
            assert torch.allclose(other.body_rot[:, int(at)], scene.body_rot[:, frame], atol=1e-5)
            assert torch.allclose(other.T_world_root[:, int(at)], scene.T_world_root[:, frame], atol=1e-5)


def test_between_two_frames_rotations_lie_on_the_shortest_way(generator):
    scene = random_scene(1, 11, 2, generator)
    half = at_speed(scene, 0.5)
    whole = geodesic(scene.body_rot[:, :-1], scene.body_rot[:, 1:])
    first = geodesic(scene.body_rot[:, :-1], half.body_rot[:, 1::2])
    assert torch.allclose(first, whole / 2, atol=1e-3)


def test_a_frame_made_of_a_bad_one_is_bad(generator):
    scene = random_scene(1, 11, 1, generator)
    valid = torch.ones(1, 11, dtype=torch.bool)
    valid[:, 5] = False
    half = at_speed(scene.replace(valid=valid), 0.5)
    assert (~half.valid)[0].nonzero()[:, 0].tolist() == [9, 10, 11]


def test_what_lies_between_frames_that_stay_may_be_anything(generator):
    scene = random_scene(1, 11, 1, generator)
    valid = torch.ones(1, 11, dtype=torch.bool)
    valid[:, 5] = False
    lost = scene.with_poses(~valid[..., None], torch.tensor(torch.nan), torch.tensor(torch.nan))
    half = resampled(lost.replace(valid=valid), 15.0)
    assert torch.equal(half.T_world_root, scene.T_world_root[:, ::2]) and half.valid.all()


def test_a_speed_is_positive(generator):
    with pytest.raises(ValueError, match=r"speed: got -1"):
        at_speed(random_scene(1, 11, 1, generator), -1)
