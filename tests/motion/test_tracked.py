"""Poses at any times become frames of one rate, and whoever was lost is led back."""

from __future__ import annotations

import math

import pytest
import torch

from magnet.motion.required import require_rate
from magnet.motion.resample import resampled
from magnet.motion.rotations import about_y, geodesic
from magnet.motion.scene import Scene, cat_time, empty_scene
from magnet.motion.tracked import PACE, LiveFrames, bridged
from magnet.testing import random_scene


def standing(x: float, turn: float = 0.0, frames: int = 1) -> Scene:
    """Two people who stand beside each other, turned about the vertical in every joint."""
    scene = empty_scene(1, frames, 2, like=torch.zeros((), dtype=torch.float64))
    T_world_root, body_rot = scene.T_world_root.clone(), scene.body_rot.clone()
    T_world_root[..., 0, 3], T_world_root[..., 1, 3] = x, 0.9
    T_world_root[..., :3, :3] = body_rot[:] = about_y(torch.tensor(turn))
    return scene.replace(body_rot=body_rot, T_world_root=T_world_root, present=torch.ones(1, 2, dtype=torch.bool))


def moving(seconds: float) -> Scene:
    """Where people are at a time: their speed changes all the time, as people's does."""
    return standing(math.sin(seconds), 0.5 * math.sin(seconds))


def xs(scene: Scene) -> torch.Tensor:
    return scene.T_world_root[0, :, 1, 0, 3]


def fed(times: list[float], clock: float = 0.0) -> tuple[Scene, list[int]]:
    """All frames that come of poses at these times, and how many came at once."""
    live = LiveFrames()
    got = [part for at in times if (part := live.add(moving(at), clock + at)) is not None]
    return cat_time(got), [part.frames for part in got]


@pytest.mark.parametrize("rate", [24, 30, 50, 59.94, 60, 72, 90, 100, 120])
@pytest.mark.parametrize("clock", [0.0, 1.8e9])
def test_frames_of_any_rate_do_not_drift(rate: float, clock: float) -> None:
    """After ten seconds they are where people were at that time, to what a straight line leaves."""
    got, sizes = fed([n / rate for n in range(int(10 * rate) + 2)], clock)
    assert got.frames == 300 and got.fps == 30 and set(sizes) == {4}
    wanted = torch.sin(torch.arange(300, dtype=torch.float64) / 30)
    assert (xs(got) - wanted).abs().max() < 3e-4


def test_frames_are_those_of_a_whole_recording_resampled(generator) -> None:
    recording = random_scene(1, 145, 2, generator).replace(fps=72.0)
    live = LiveFrames()
    got = [part for n in range(145) if (part := live.add(recording.slice(n, n + 1), n / 72)) is not None]
    ours, theirs = cat_time(got), resampled(recording, 30.0)
    assert ours.frames == 60
    assert torch.allclose(ours.T_world_root, theirs.T_world_root[:, :60], atol=1e-5)
    assert torch.allclose(ours.body_rot, theirs.body_rot[:, :60], atol=1e-5)


def test_frames_at_their_own_times_are_handed_on_as_they_are(generator) -> None:
    recording = random_scene(1, 12, 2, generator)
    live = LiveFrames()
    for n in range(12):
        got = live.add(recording.slice(n, n + 1), 5 + n / 30)
        assert (got is not None) == (n % 4 == 3)
        if got is not None:
            assert torch.allclose(got.T_world_root, recording.T_world_root[:, n - 3 : n + 1], atol=1e-5)


def test_late_missing_and_doubled_poses_change_no_clock() -> None:
    """Those that come late or twice are passed over, those that are missing lie on the line between."""
    times = [n / 72 for n in range(721)]
    whole, _ = fed(times)
    live, got = LiveFrames(), []
    for n, at in enumerate(times):
        if n % 7 == 3:
            continue
        pose = moving(at)
        parts = [live.add(pose, at), live.add(pose, at) if n % 3 == 0 else None]
        if n % 7 == 4:
            parts.append(live.add(moving(times[n - 1]), times[n - 1]))
        got += [part for part in parts if part is not None]
    ours = cat_time(got)
    assert live.passed_over > 200
    assert abs(ours.frames - whole.frames) <= 4
    least = min(ours.frames, whole.frames)
    assert (xs(ours)[:least] - xs(whole)[:least]).abs().max() < 1e-3


def test_a_pose_may_be_written_over_by_the_next() -> None:
    times = [n / 50 for n in range(51)]
    expected, _ = fed(times)
    live, pose, got = LiveFrames(), moving(0.0), []
    for at in times:
        for name, value in moving(at).tensors().items():
            getattr(pose, name).copy_(value)
        got.append(live.add(pose, at))
    assert torch.equal(xs(cat_time([part for part in got if part is not None])), xs(expected))


def test_poses_that_are_not_finite_or_not_valid_count_as_missing() -> None:
    live = LiveFrames()
    live.add(moving(0.0), 0.0)
    assert live.add(standing(math.nan), 0.1) is None
    assert live.add(standing(9.0).replace(valid=torch.zeros(1, 1, dtype=torch.bool)), 0.15) is None
    got = live.add(moving(0.2), 0.2)
    assert live.passed_over == 2 and got is not None
    assert (xs(got) - torch.sin(torch.arange(4, dtype=torch.float64) / 30)).abs().max() < 1e-2


def test_who_is_held_stands_still_and_is_led_back_while_they_walk_on() -> None:
    live, got = LiveFrames(), []
    got += [live.add(standing(0.0), n / 30) for n in range(8)]
    got += [live.hold(n / 10) for n in range(4, 11)]
    got += [live.add(standing(1.5 + 0.02 * n, 1.0), 1.1 + n / 30) for n in range(100)]
    path = xs(cat_time([part for part in got if part is not None]))
    assert (path[:31] == 0).all()
    assert path.diff().min() >= 0 and path.diff().max() < PACE / 30 + 1.7 * 0.02 + 1e-6
    assert path[-1] == pytest.approx(1.5 + 0.02 * (len(path) - 1 - 33), abs=1e-6)


def test_slots_of_those_who_answer_delay_nobody_who_comes_back_where_they_hold_one_pose() -> None:
    """Far away as they may be."""
    live, got = LiveFrames(), []
    for seconds, x in ((0.0, 0.0), (1.0, None), *((1.0 + n / 30, 0.5) for n in range(1, 50))):
        pose = standing(0.0 if x is None else x)
        pose.T_world_root[:, :, 0, :3, 3] = 1000.0
        got.append(live.hold(seconds) if x is None else live.add(pose, seconds))
    assert xs(cat_time([part for part in got if part is not None]))[-1] == 0.5


def test_who_is_lost_again_on_the_way_back_stays_where_they_are() -> None:
    live = LiveFrames()
    got = [live.add(standing(0.0), 0.0), live.hold(1.0)]
    got += [live.add(standing(1.5), 1.0 + n / 30) for n in range(1, 20)]
    got += [live.hold(2.6)]
    got += [live.add(standing(-1.0), 2.6 + n / 30) for n in range(1, 90)]
    path = xs(cat_time([part for part in got if part is not None]))
    assert path.diff().abs().max() < PACE / 30 + 1e-6
    assert 0.1 < path[60:78].min() == path[60:78].max() < 1.4 and path[-1] == -1.0


@pytest.mark.parametrize(
    ("told", "act"),
    [
        ("nothing was added", lambda live: LiveFrames().hold(1.0)),
        ("pose: got 2 frames, expected 1", lambda live: live.add(standing(0.0, frames=2), 1.0)),
        ("pose: got 1 agents, expected 2", lambda live: live.add(standing(0.0).permute_agents(torch.tensor([0])), 1.0)),
        (r"seconds: got 33, \+33 from .*at most 10 apart", lambda live: live.add(standing(0.0), 33.0)),
        ("seconds: got -20", lambda live: live.add(standing(0.0), -20.0)),
        ("seconds: got 1000", lambda live: live.hold(1000.0)),
        ("seconds: got nan", lambda live: live.add(standing(0.0), math.nan)),
        ("pace: got 0", lambda live: LiveFrames(0.0)),
    ],
)
def test_what_makes_no_sense_live_is_refused(told: str, act) -> None:
    live = LiveFrames()
    live.add(standing(0.0), 0.0)
    with pytest.raises(ValueError, match=told):
        act(live)


@pytest.mark.parametrize("chunk", [4, 8, 40])
def test_a_bridge_leads_smoothly_from_the_last_pose_into_what_is_tracked(chunk: int) -> None:
    last, coming = standing(0.0, 0.0, 3), standing(1.5, 2.0, 40)
    parts = [bridged(last, coming.slice(first, first + chunk), 32, first) for first in range(0, 40, chunk)]
    led = cat_time(parts)
    path = torch.cat([torch.zeros(1).double(), xs(led)])
    assert path.diff().min() >= 0 and path.diff().max() < 1.5 * 1.5 / 32 + 1e-6
    assert path.diff().diff().abs().max() < 0.01, "it neither starts nor stops at once"
    turned = geodesic(last.body_rot[:, :1, 1, 4], led.body_rot[:, :, 1, 4])[0]
    assert torch.allclose(turned, 2.0 * path[1:] / 1.5, atol=1e-4)
    assert torch.equal(led.T_world_root[:, 31:], coming.T_world_root[:, 31:])
    assert torch.equal(led.body_rot[:, 31:], coming.body_rot[:, 31:])


@pytest.mark.parametrize(
    ("told", "how"),
    [
        ("last: got Scene of 1 x 0 frames", {"last": standing(0.0, frames=0)}),
        ("expected a frame or more of 1 scenes and 2 agents", {"last": standing(0.0).pad_agents(3)}),
        ("frames: got 0", {"frames": 0}),
        ("since: got -1", {"since": -1}),
    ],
)
def test_a_bridge_from_nowhere_is_refused(told: str, how) -> None:
    with pytest.raises(ValueError, match=told):
        bridged(**{"last": standing(0.0), "coming": standing(1.0), **how})


def test_who_has_another_rate_is_told_what_brings_it_there_live() -> None:
    with pytest.raises(ValueError, match=r"resampled\(scene, 30\) or, live, pose by pose, magnet\.export\.LiveFrames$"):
        require_rate(standing(0.0).replace(fps=60.0))


def test_a_clock_in_nanoseconds_is_refused() -> None:
    live, pose = LiveFrames(), empty_scene(1, 1, 2, like=torch.zeros(()))
    with pytest.raises(ValueError, match="expected seconds, not nanoseconds"):
        live.add(pose, 1.7e18)
    assert live.add(pose, 1.7e9) is None  # seconds since 1970
