"""Keyframes out of files, looked at before anything is sampled: whether they can be reached, and whether they move."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from magnet.export.upright import WARNING
from magnet.generation.keyframes import HURRIED, keyframe, pace, speeds
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES

STILL = 1e-4
"""Metres, or numbers of a rotation, that frames of one pose differ by at most: rounding."""


def said_of_keys(recorded: Scene, known: Tensor, past: int) -> list[str]:
    """Warnings of keyframes that are too far from the one before, and of those in which somebody holds one pose.

    recorded: B scenes of the files; known: (N, P) bool, token steps that are read; past: token steps that are given of
    everybody at the start.
    """
    reached: dict[tuple[int, int], float] = {}
    held: set[tuple[int, int]] = set()
    for b in range(recorded.scenes):
        scene = recorded.select([b])
        for person in scene.present[0].nonzero()[:, 0].tolist():
            steps = known[:, person]
            for frame, speed in speeds_of(scene, person, steps, past).items():
                reached[frame, person] = max(speed, reached.get((frame, person), 0.0))
            held |= {(frame, person) for frame in held_in(scene, person, steps, past)}
    far = sorted(key for key, speed in reached.items() if speed > HURRIED)
    lines = []
    if far:
        worst = max(far, key=lambda key: reached[key])
        said = f"{_named(worst, recorded.fps)}: {pace(reached[worst])}"
        lines.append(f"{WARNING}{said}{_also(far)}; give keyframes more time, or less way between them")
    if held:
        said = f"{_named(min(held), recorded.fps)}: its frames are all one pose, and people stop there"
        advice = "for keys of a blocking pass see docs/tasks.md#in-betweening"
        lines.append(f"{WARNING}{said}{_also(sorted(held))}; {advice}")
    return lines


def speeds_of(scene: Scene, person: int, steps: Tensor, past: int) -> dict[int, float]:
    """Metres a second at which each keyframe behind a gap is reached from what is known before it.

    scene: B = 1; steps (N,) bool, known of that person -> by first frame
    """
    there = [step for step in steps.nonzero()[:, 0].tolist() if step >= past and step * TOKEN_FRAMES < scene.frames]
    if not there or bool(steps.all()):
        return {}
    keys = [keyframe(scene, person, step * TOKEN_FRAMES) for step in there]
    needed = speeds(keys, scene, past * TOKEN_FRAMES - 1 if past else keys[0].frame)
    behind = [step for step in there if step and not steps[step - 1] and bool(steps[:step].any())]
    return {step * TOKEN_FRAMES: needed[person, step * TOKEN_FRAMES] for step in behind}


def held_in(scene: Scene, person: int, steps: Tensor, past: int) -> list[int]:
    """First frames of keyframes beside a gap in which nothing moves.

    scene: B = 1; steps (N,) bool, known of that person
    """
    found = []
    for step in (past + steps[past:].nonzero()[:, 0]).tolist():
        frames = slice(step * TOKEN_FRAMES, min((step + 1) * TOKEN_FRAMES, scene.frames))
        around = steps[max(step - 1, 0) : step + 2]
        if bool(around.all()) or frames.stop - frames.start < 2:  # of one frame nobody can tell
            continue
        poses = scene.body_rot[0, frames, person], scene.T_world_root[0, frames, person]
        if all(bool(((pose - pose[:1]).abs() < STILL).all()) for pose in poses):
            found.append(frames.start)
    return found


def _named(key: tuple[int, int], fps: float) -> str:
    frame, person = key
    return f"keyframe of person {person} at frame {frame} ({frame / fps:.1f} s)"


def _also(keys: Sequence[tuple[int, int]]) -> str:
    return f" (and {len(keys) - 1} more such keyframes)" if len(keys) > 1 else ""
