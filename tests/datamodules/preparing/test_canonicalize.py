"""Canonical clips: exact times, any up axis, one floor, and what cannot be people."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from magnet.body import load_body
from magnet.datamodules.fakes.motion import UP, made_up_body, people, turned
from magnet.datamodules.preparing import check_motion
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions, canonicalize
from magnet.datamodules.reading.asf_amc import read_amc, read_asf
from magnet.datamodules.reading.recording import DataError
from magnet.motion.resample import resample_rotations, resample_valid, times
from magnet.motion.runs import true_runs
from magnet.synthesis import synthesize
from tests.cases import few
from tests.datamodules.made import SPOILED, in_degrees, recorded, tracked

BODY = made_up_body()


def clip_of(recording, **steps):
    (clip,) = canonicalize(recording, BODY, "take", "made", "train", options=CanonicalizeOptions(**steps)).clips
    return clip


def joints_of(recording, **steps):
    return BODY.joints(clip_of(recording, **steps).scene)[0]


@pytest.mark.parametrize("fps", [30.0, 120.0, 50.0, 59.94, 25.0, 20.0])
def test_frame_i_shows_time_i_over_30(fps):
    motion = people(int(3 * fps) + 2, 2, fps, seed=3)
    before, after, share = times(motion.frames, fps)
    before, after, share = before[:91], after[:91], share[:91]
    assert len(before) == 91
    shown = (before + share * (after - before)) / fps
    assert torch.allclose(shown, torch.arange(91).double() / 30, atol=1e-9)
    true = torch.from_numpy(people(91, 2, 30.0, seed=3).positions).float()
    found = joints_of(recorded(motion))[:91]
    moved = (found - true)[..., [0, 2]]
    # the fake itself interpolates, and so do we between its frames: 25 fps bends the fastest foot by a centimetre
    assert (moved - moved[0, 0, 0]).abs().mean() < 0.004
    if fps in (30.0, 120.0):
        assert torch.allclose(moved, moved[0, 0, 0].expand_as(moved), atol=1e-4)


def test_slerp_agrees_with_scipy():
    turns = Rotation.random(12, random_state=4)
    quat = torch.from_numpy(turns.as_quat())
    new = resample_rotations(quat, 50.0)
    want = Slerp(np.arange(12) / 50, turns)(np.arange(len(new)) / 30)
    assert (Rotation.from_quat(new.numpy()) * want.inv()).magnitude().max() < 1e-9


def test_a_frame_is_valid_when_all_it_is_made_of_is():
    valid = np.ones((50, 1), dtype=bool)
    valid[10] = False
    shared = resample_valid(valid, 50.0)[:, 0]  # 30 fps: frame 6 is frame 10, frames 5 and 7 lie elsewhere
    assert np.flatnonzero(~shared).tolist() == [6]
    valid[:] = True
    valid[9] = False  # between frames 8.33 and 10: only frame 5 is made of it
    assert np.flatnonzero(~resample_valid(valid, 50.0)[:, 0]).tolist() == [5]


@pytest.mark.parametrize("kind", few([recorded, tracked], 1))
def test_what_frames_hold_that_are_not_valid_makes_no_difference(kind):
    """Also of somebody who is away most of the time, and then as far off as some trackers say."""
    motion = people(90, 2, seed=5)
    valid = np.ones((90, 2), dtype=bool)
    valid[:55, 1] = False
    recording = replace(kind(motion), valid=valid)
    (clip,) = canonicalize(recording, BODY, "take", "made", "train").clips
    assert clip.name == "take [55:90]"
    for filler in (np.nan, 0.0, 1e12):
        arrays = {
            name: np.array(getattr(recording, name))
            for name in ("poses", "transl", "positions")
            if getattr(recording, name) is not None
        }
        for array in arrays.values():
            array[~valid] = filler
        outcome = canonicalize(replace(recording, **arrays), BODY, "take", "made", "train")
        assert torch.equal(outcome.clips[0].scene.T_world_root, clip.scene.T_world_root)
        assert torch.equal(outcome.clips[0].scene.body_rot, clip.scene.body_rot)


@pytest.mark.parametrize(("up", "kind"), few([*((up, recorded) for up in UP), ("-z", tracked)]))
def test_the_same_motion_comes_out_whatever_axis_is_up(up, kind):
    motion = people(60, 2, seed=5) if kind is recorded else people(30, 1, seed=5)  # a fit takes its time
    outcome = canonicalize(kind(turned(motion, up)), BODY, "take", "made", "train")
    assert [note for note in outcome.notes if "mean residual" in note] if kind is tracked else not outcome.notes
    found = BODY.joints(outcome.clips[0].scene)[0]
    true = torch.from_numpy(motion.positions).float()

    def shape(joints):  # what does not depend on heading: heights, and distances over all people and joints
        points = joints.double().flatten(1, 2)
        return joints[..., 1], (points[:, :, None] - points[:, None]).norm(dim=-1)

    (height, distance), (true_height, true_distance) = shape(found), shape(true)
    room = 0.02 if kind is tracked else 1e-5
    assert (distance - true_distance).abs().mean() < room
    assert (height - true_height - (height - true_height).mean()).abs().mean() < room
    hips = found[:, :, 1] - found[:, :, 2]  # nobody was mirrored: left, forward and up are still right-handed
    assert (torch.linalg.cross(hips, found[:, :, 10] - found[:, :, 7])[..., 1] < 0).float().mean() > 0.9


def test_soles_stand_at_height_0_and_the_first_frame_is_centred():
    motion = people(120, 3, seed=1)
    raised = replace(recorded(motion), transl=motion.transl + np.array([3.0, 0.7, -2.0]))
    clip = clip_of(raised)
    balls = BODY.joints(clip.scene)[0][:, :, [10, 11], 1]
    assert abs(float(balls.amin(dim=-1).median()) - 0.028) < 0.01  # the balls' joints are 2.8 cm over the soles
    assert clip.scene.T_world_root[0, 0, :, [0, 2], 3].mean(dim=0).abs().max() < 1e-5


@pytest.mark.parametrize("kind", [recorded, tracked])
@pytest.mark.parametrize("wrong", SPOILED)
def test_a_wrong_axis_unit_or_rate_is_named(kind, wrong):
    spoil, message = SPOILED[wrong]
    fps = 120.0 if wrong == "30 for 120 fps" else 30.0
    recording = kind(people(int(8 * fps), 2, fps, seed=2))
    if wrong == "30 for 120 fps":
        recording = kind(replace_frames(recording))
        spoil = lambda r: r  # noqa: E731
    with pytest.raises(DataError, match=message):
        canonicalize(spoil(recording), BODY, "take", "made", "train")


def replace_frames(recording):
    """30 frames a second that are called 120."""
    return replace(people(240, 2, 30.0, seed=2), fps=recording.fps)


def test_degrees_are_named():
    with pytest.raises(DataError, match=r"radians.*look like degrees"):
        canonicalize(in_degrees(recorded(people(60, 2))), BODY, "take", "made", "train")


def test_whoever_has_neither_head_nor_neck_stands_by_the_shoulders():
    scene = synthesize("mirror", 2, 300, torch.Generator().manual_seed(6), BODY).scene
    joints = BODY.joints(scene)[0].numpy()
    joints[:, :, [check_motion.HEAD, check_motion.NECK]] = np.nan
    valid = np.ones(joints.shape[:2], dtype=bool)
    check_motion.check_up("+y", joints, valid)
    with pytest.raises(DataError, match=r"people stand along \+y \(shoulders minus ankles is on average"):
        check_motion.check_up("+z", joints, valid)


def test_nothing_that_people_do_is_refused():
    for coupling, persons in (("mirror", 2), ("handshake", 2), ("circle", 4), ("patty_cake", 2), ("follow", 1)):
        scene = synthesize(coupling, persons, 300, torch.Generator().manual_seed(6), BODY).scene
        joints = BODY.joints(scene)[0].numpy()
        valid = np.ones(joints.shape[:2], dtype=bool)
        check_motion.check_up("+y", joints, valid)
        check_motion.check_lengths(joints, joints[:, :, 0], valid)
        check_motion.check_rate(joints[:, :, check_motion.WALKING], valid, 30.0, 30.0)
        assert not len(check_motion.jumps(joints[:, :, 0], valid, 30.0))


def recorded_at(cmu_root, take: str, rate: float):
    """Joints of `check_motion.WALKING` at 30 fps, of a recording called `rate` times as fast as it is."""
    skeleton = read_asf(cmu_root / f"singles/{take[:2]}.asf")
    recording = read_amc(cmu_root / f"singles/{take}.amc", skeleton, rate * 120.0)
    recording = recording.resampled(30.0)
    end = recording.world()[1]
    feet = [end[:, skeleton.names.index(bone)] for bone in ("ltibia", "lfoot", "rtibia", "rfoot")]
    return np.stack([recording.root, *feet], axis=1)[:, None]


@pytest.mark.parametrize("take", ["02_04", "05_08", "05_16", "05_20"])
def test_leaps_are_no_faster_than_falling_at_their_true_rate_alone(cmu_root, take):
    joints = recorded_at(cmu_root, take, 1.0)
    check_motion.check_rate(joints, np.ones(joints.shape[:2], dtype=bool), 120.0, 30.0)
    joints = recorded_at(cmu_root, take, 2.0)
    with pytest.raises(DataError, match="faster than falling: too fast for people"):
        check_motion.check_rate(joints, np.ones(joints.shape[:2], dtype=bool), 240.0, 30.0)


@pytest.mark.parametrize("take", ["02_01", "05_10", "55_12"])
def test_the_rate_of_calm_recordings_is_not_refused(cmu_root, take):
    joints = recorded_at(cmu_root, take, 1.0)
    check_motion.check_rate(joints, np.ones(joints.shape[:2], dtype=bool), 120.0, 30.0)


def test_people_who_lie_are_refused_unless_the_axis_is_confirmed():
    motion = people(60, 2)
    lying = replace(recorded(turned(motion, "+z")), up="+z")
    tilt = Rotation.from_rotvec([0.9, 0.0, 0.0])
    poses = lying.poses.copy()
    poses[:, :, 0] = (tilt * Rotation.from_rotvec(poses[:, :, 0].reshape(-1, 3))).as_rotvec().reshape(60, 2, 3)
    lying = replace(lying, poses=poses)
    with pytest.raises(DataError, match=r"no up axis stands out.*--up=\+z"):
        clip_of(lying)
    assert clip_of(lying, up="+z").frames == 60


def test_lost_tracking_and_jumps_cut_a_take():
    motion = people(200, 2)
    valid = np.ones((200, 2), dtype=bool)
    valid[50:55, 1] = False
    valid[140:160, 0] = False
    poses = motion.poses.copy()
    poses[52, 1] = np.nan  # what is not valid may be anything
    transl = motion.transl.copy()
    transl[100:] += [2.0, 0.0, 0.0]
    outcome = canonicalize(
        replace(recorded(motion), poses=poses, transl=transl, valid=valid), BODY, "take", "made", "train",
        options=CanonicalizeOptions(min_frames=41),
    )  # fmt: skip
    assert [clip.name for clip in outcome.clips] == ["take [0:50]", "take [55:100]"]
    assert any("1 jumps" in note for note in outcome.notes)
    with pytest.raises(DataError, match="no stretch of 60 frames"):
        canonicalize(
            replace(recorded(motion), transl=transl, valid=valid),
            BODY,
            "t",
            "m",
            "train",
            options=CanonicalizeOptions(60),
        )


@pytest.mark.parametrize("field", ["poses", "transl", "pelvis", "betas"])
def test_nan_is_named(field):
    motion = recorded(people(40, 2))
    if field == "pelvis":
        motion = replace(motion, transl=None, pelvis=motion.transl)
    array = getattr(motion, field).copy()
    array[1, 1] = np.nan
    with pytest.raises(DataError, match=f"{field} holds? NaN"):
        clip_of(replace(motion, **{field: array}))


def test_a_mask_that_means_the_opposite_and_a_frozen_take_are_named():
    motion = people(100, 2)
    with pytest.raises(DataError, match=r"people \[1\] are valid in none"):
        clip_of(replace(recorded(motion), valid=np.repeat([[True, False]], 100, axis=0)))
    still = {name: np.repeat(getattr(motion, name)[:1], 100, axis=0) for name in ("poses", "transl")}
    with pytest.raises(DataError, match="nothing moves"):
        clip_of(replace(recorded(motion), **still))


def test_positions_that_no_body_fits_are_refused_with_the_residual():
    motion = people(30, 1)
    moved = motion.positions.copy()
    moved[:, :, [3, 4, 5, 12, 15, 18, 19, 20, 21]] += [[0.0, 0.0, 0.5]]
    with pytest.raises(DataError, match=r"mean error of .* cm"):
        clip_of(replace(tracked(motion), positions=moved))


@given(st.lists(st.booleans(), min_size=1, max_size=40), st.integers(1, 5))
@settings(max_examples=50, deadline=None)
def test_stretches_are_all_the_runs_and_nothing_else(good, least):
    found = true_runs(np.array(good), least)
    inside = {i for a, b in found for i in range(a, b)}
    for a, b in found:
        assert b - a >= least and all(good[a:b]) and (a == 0 or not good[a - 1]) and (b == len(good) or not good[b])
    for i in set(range(len(good))) - inside:  # whatever is left out is bad, or in a run that is too short
        a = b = i
        while a > 0 and good[a - 1] and good[i]:
            a -= 1
        while b < len(good) and good[b] and good[i]:
            b += 1
        assert b - a < least


def test_rotations_are_not_put_on_a_body_that_they_do_not_belong_to():
    with pytest.raises(DataError, match="belong to SMPL-X's body, not to open-1: give --body"):
        canonicalize(recorded(people(60, 2, 30.0, seed=3)), load_body(), "take", "made", "train")
