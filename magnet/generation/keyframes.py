"""Goals on the floor, keyframes, and scenes with people placed at them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from magnet.body.base import Body
from magnet.body.reach import LIMBS, reach
from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES

FASTEST = 1.6
"""Metres a second that steering may ask of somebody."""
HURRIED = 3.0
"""Metres a second above which a keyframe is reported as too far away."""
LATER = 9000
"""Frames, five minutes, that a keyframe may lie behind the end of a scene, at most: all up to it is made at once."""


@dataclass(frozen=True)
class Goal:
    """A place on the floor in metres and a heading in radians (0 looks along +z)."""

    x: float
    z: float
    heading: float

    @staticmethod
    def of(T_world_can: Tensor) -> Goal:
        """Where a canonical frame (4, 4) stands."""
        yaw, ground = to_planar(T_world_can)
        return Goal(float(ground[0]), float(ground[1]), float(yaw))

    def frame(self) -> Tensor:
        """T_world_can (4, 4)."""
        place = torch.tensor([self.x, self.z, self.heading], dtype=torch.float32)
        return from_planar(place[2], place[:2])


@dataclass(frozen=True)
class Keyframe:
    """A token of motion that an agent must make at a given time and place.

    Attributes:
        agent: slot.
        frame: its first frame, a multiple of 4.
        goal: where that frame's canonical frame stands.
        body_rot: (4, 21, 3, 3).
        T_key_root: (4, 4, 4) pelvis poses seen from the first frame's canonical frame.
    """

    agent: int
    frame: int
    goal: Goal
    body_rot: Tensor
    T_key_root: Tensor

    def T_world_root(self) -> Tensor:
        """(4, 4, 4)"""
        return self.goal.frame() @ self.T_key_root


def keyframe(scene: Scene, agent: int, frame: int, pose: int | None = None, held: bool = False) -> Keyframe:
    """A keyframe from an agent's motion in a scene (B = 1): the token that holds `frame`, at its place there.

    Args:
        pose: the frame that the motion is taken from, brought to the place of `frame`; None: `frame` itself.
        held: one pose for all of the token instead of four frames of motion.

    Raises:
        ValueError: no such agent or frame.
    """
    last = scene.frames - 1
    frame = frame // TOKEN_FRAMES * TOKEN_FRAMES
    pose = frame if pose is None else pose
    if not 0 <= agent < scene.agents:
        raise ValueError(f"person {agent + 1} is not there: the scene has {scene.agents}")
    if frame < 0 or not 0 <= pose <= last:
        raise ValueError(f"keyframe at frame {frame} with the pose of frame {pose}: the scene has frames 0 to {last}")
    own = scene.T_world_root[0, :, agent : agent + 1].cpu()
    T_world_can = canonical_frame(own)[:, 0]
    frames = torch.full((TOKEN_FRAMES,), pose) if held else torch.arange(pose, pose + TOKEN_FRAMES).clamp(max=last)
    return Keyframe(
        agent,
        frame,
        Goal.of(T_world_can[min(frame, last)]),
        scene.body_rot[0, frames, agent].cpu(),
        inverse(T_world_can[pose]) @ own[frames, 0],
    )


def require_soon(frame: float, frames: int) -> None:
    """Refuse a keyframe whose frame lies too far behind the end of a scene of so many frames.

    Raises:
        ValueError: it does.
    """
    if not frame <= frames + LATER:
        raise ValueError(
            f"a keyframe at frame {frame:.0f}: all up to the last keyframe is made at once, so it lies at frame "
            f"{frames + LATER} or earlier, {LATER} after the end of the scene"
        )


def limb_places(key: Keyframe, limb: str, body: Body, betas: Tensor) -> Tensor:
    """Where a hand (the wrist) or a foot (the ankle) is in a keyframe's four frames. -> (4, 3) metres in the world

    Args:
        limb: a name in `magnet.body.reach.LIMBS`.
        betas: the person's shape (10,).
    """
    return body.forward_kinematics(key.body_rot, key.T_world_root(), betas)[:, LIMBS[limb][2]]


def with_limb(key: Keyframe, limb: str, place: Tensor, body: Body, betas: Tensor) -> Keyframe:
    """A keyframe in which a hand or a foot is at a place, in metres in the world, as far as it can be brought there.

    The first of the four frames is there; in the others the limb moves from there as it did before. place (3,)
    """
    places = limb_places(key, limb, body, betas)
    body_rot = reach(body, key.body_rot, key.T_world_root(), betas, limb, places + (place - places[0]))
    return replace(key, body_rot=body_rot)


def with_keyframes(scene: Scene, keys: Iterable[Keyframe]) -> Scene:
    """A scene (B = 1) in which people are as their keyframes say, marked as given there."""
    roots, body_rot = scene.T_world_root.clone(), scene.body_rot.clone()
    given = roots.new_zeros(roots.shape[:3], dtype=torch.bool) if scene.given is None else scene.given.clone()
    for key in keys:
        frames = slice(key.frame, key.frame + TOKEN_FRAMES)
        roots[0, frames, key.agent] = key.T_world_root()
        body_rot[0, frames, key.agent] = key.body_rot
        given[0, frames, key.agent] = True
    return scene.replace(T_world_root=roots, body_rot=body_rot, given=given)


def reached(T_world_can: Tensor, goal: Goal, seconds: float) -> Goal:
    """The goal, or the point on the way to it that can be reached in the given time. T_world_can (4, 4)"""
    here = Goal.of(T_world_can)
    length = math.hypot(goal.x - here.x, goal.z - here.z)
    share = min(1.0, FASTEST * seconds / length) if length > 0 else 1.0
    return Goal(here.x + share * (goal.x - here.x), here.z + share * (goal.z - here.z), goal.heading)


def speeds(keys: Iterable[Keyframe], scene: Scene, start: int) -> dict[tuple[int, int], float]:
    """Metres a second at which each keyframe is reached from its agent's one before, the first from frame `start`.

    -> by (agent, frame)
    """
    at = {a: (start, scene.T_world_root[0, start, a, [0, 2], 3].tolist()) for a in range(scene.agents)}
    found = {}
    for key in sorted(keys, key=lambda key: key.frame):
        before, (x, z) = at[key.agent]
        seconds = max(key.frame - before, 1) / scene.fps
        found[key.agent, key.frame] = math.hypot(key.goal.x - x, key.goal.z - z) / seconds
        at[key.agent] = (key.frame, [key.goal.x, key.goal.z])
    return found


def pace(speed: float) -> str:
    """How fast a keyframe is reached, in words, which say too where that is too fast. speed: m/s"""
    return f"{speed:.1f} m/s from the one before" + (": too far" if speed > HURRIED else "")
