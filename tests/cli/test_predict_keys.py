"""Keyframes out of files: what cannot be reached, and what holds one pose, is said before anything is sampled."""

from __future__ import annotations

import pytest
import torch

from magnet.body import load_body
from magnet.cli.predict_keys import said_of_keys
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize


@pytest.fixture(scope="module")
def walk() -> Scene:
    return synthesize("follow", 2, 120, torch.Generator().manual_seed(0), load_body()).scene.slice(0, 64)


def keys(*steps: int, tokens: int = 16, past: int = 0, person: int = 1) -> torch.Tensor:
    known = torch.zeros(tokens, 2, dtype=torch.bool)
    known[list(steps), person] = True
    known[:past] = True
    return known


def away(scene: Scene, first: int, metres: float, person: int = 1) -> Scene:
    roots = scene.T_world_root.clone()
    roots[:, first:, person, 0, 3] += metres
    return scene.replace(T_world_root=roots)


def stepped(scene: Scene, frames: int = 24) -> Scene:
    """As blocked with stepped curves: each pose is held until the next."""
    return scene.frames_at(torch.arange(scene.frames) // frames * frames)


@pytest.mark.parametrize("past", [0, 2])
def test_a_key_that_nobody_reaches_is_warned_of_once(past: int, walk: Scene) -> None:
    far = away(walk, 40, 9.0)
    (line,) = said_of_keys(far, keys(0, 5, 10, past=past), past)
    assert line.startswith("warning: keyframe of person 1 at frame 40 (1.3 s): ")
    assert " m/s from the one before: too far; give keyframes more time" in line
    assert not said_of_keys(walk, keys(0, 5, 10, past=past), past)


def test_what_is_recorded_without_a_gap_may_be_as_fast_as_it_is(walk: Scene) -> None:
    far = away(walk, 40, 9.0)
    assert not said_of_keys(far, keys(*range(16)), 0), "all of a person is given"
    assert not said_of_keys(far, keys(0, 9, 10, 15), 0), "no gap lies where it jumps"
    assert not said_of_keys(far, keys(10, 11), 0), "nothing is known before them"
    assert not said_of_keys(far, keys(past=4), 4), "no keyframes"
    assert not said_of_keys(far, keys(5, 20, tokens=30), 0), "beyond the recording nothing is a keyframe"


def test_the_speed_is_that_of_the_live_panel(walk: Scene) -> None:
    from magnet.generation.keyframes import keyframe, pace, speeds

    far = away(walk, 40, 9.0)
    needed = speeds([keyframe(far, 1, frame) for frame in (20, 40)], far, 7)
    assert pace(needed[1, 40]) in said_of_keys(far, keys(5, 10, past=2), 2)[0]


def test_keys_that_hold_one_pose_are_warned_of(walk: Scene) -> None:
    lines = said_of_keys(stepped(walk), keys(0, 6, 12), 0)
    assert lines[-1].startswith("warning: keyframe of person 1 at frame 0 (0.0 s): its frames are all one pose")
    assert "(and 2 more such keyframes)" in lines[-1] and "blocking pass" in lines[-1]
    assert not said_of_keys(walk.slice(0, 61), keys(0, 15), 0), "a single frame is no held pose"
    assert not said_of_keys(stepped(walk), keys(*range(16)), 0), "nothing is generated beside it"
