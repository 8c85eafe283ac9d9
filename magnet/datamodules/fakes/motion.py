"""People who walk, as the numbers that data sets' files hold: what every fake writes in its own layout."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import roma
import torch
from numpy.typing import NDArray

from magnet.body import Body, load_body
from magnet.body.joints import ANKLES, COLLARS, ELBOWS, HIPS, KNEES, PARENTS, SHOULDERS, TOES, WRISTS
from magnet.datamodules.fakes.body import Kind, write_body
from magnet.datamodules.reading.recording import Axis
from magnet.motion.frames import rigid
from magnet.motion.resample import slerp_quat
from magnet.motion.scene import FPS, Scene
from magnet.synthesis import synthesize
from magnet.synthesis.generate import FEWEST_FRAMES

Array = NDArray[np.float64]
LEG, ARM = (HIPS, KNEES, ANKLES, TOES), (COLLARS, SHOULDERS, ELBOWS, WRISTS)

UP: dict[Axis, Array] = {
    "+y": np.eye(3),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "+z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "+x": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "-x": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}
"""Rotation that takes +y to each axis: R_file_world of a file whose up axis it is."""


@dataclass(frozen=True)
class FakeMotion:
    """T frames of P people: y up unless turned, metres, radians, float64; of the made-up body of `kind`."""

    fps: float
    up: Axis
    poses: Array  # (T, P, 22, 3) axis-angle, pelvis first
    transl: Array  # (T, P, 3) SMPL's transl, not the pelvis
    betas: Array  # (P, 10)
    positions: Array  # (T, P, 22, 3) world joints
    kind: Kind = "smplx"

    @property
    def frames(self) -> int:
        return len(self.poses)

    @property
    def pelvis(self) -> Array:
        """(P, 3) rest pelvis J0(beta)."""
        return rest_joints(self.betas, self.kind)[:, 0]

    def person(self, p: int) -> dict[str, NDArray[np.float32]]:
        """What files hold of a person: orient (T, 3), body (T, 63), transl (T, 3), betas (10,)."""
        poses = self.poses[:, p].reshape(self.frames, 66)
        arrays = {"orient": poses[:, :3], "body": poses[:, 3:], "transl": self.transl[:, p], "betas": self.betas[p]}
        return {key: array.astype(np.float32) for key, array in arrays.items()}


@lru_cache(maxsize=2)
def made_up_body(kind: Kind = "smplx") -> Body:
    """The body that `write_body` writes."""
    with tempfile.TemporaryDirectory() as folder:
        return load_body(write_body(Path(folder) / "body.npz", kind))


def rest_joints(betas: Array, kind: Kind = "smplx") -> Array:
    """Rest joints of the made-up body. (P, 10) -> (P, 22, 3) metres"""
    return made_up_body(kind).rest_joints(torch.from_numpy(betas)).numpy()


def world_rotations(poses: Array) -> Array:
    """World rotations of our joints. (T, 22, 3) axis-angle -> (T, 22, 3, 3)"""
    world: Array = roma.rotvec_to_rotmat(torch.from_numpy(poses)).numpy()
    for k, parent in enumerate(PARENTS):
        if parent >= 0:
            world[:, k] = world[:, parent] @ world[:, k]
    return world


def local_rotations(world: Array, parents: Sequence[int]) -> Array:
    """World rotations (T, K, 3, 3) relative to each joint's parent; those of a root stay."""
    local = world.copy()
    for k, parent in enumerate(parents):
        if parent >= 0:
            local[:, k] = np.swapaxes(world[:, parent], -1, -2) @ world[:, k]
    return local


def people(frames: int, persons: int, fps: float = FPS, seed: int = 0, kind: Kind = "smplx") -> FakeMotion:
    """People walking one behind the other or round in a circle, feet on the floor at height 0.

    Args:
        frames: T, at least 1.
        persons: P, 1 to 8.
        fps: frame rate; frame t shows time t / fps whatever the rate.
        seed: the same seed, the same motion.
        kind: whose body.

    Raises:
        ValueError: no frames, or more people than a circle holds.
    """
    if frames < 1 or not 1 <= persons <= 8:
        raise ValueError(f"got {frames} frames of {persons} people, expected at least 1 frame and 1 to 8 people")
    needed = max(FEWEST_FRAMES, math.ceil(frames * FPS / fps) + 2)
    scene = _scene(needed, persons, seed, kind)
    time = torch.arange(frames, dtype=torch.float64) * (FPS / fps)
    before = time.long()
    share = time - before
    world = torch.cat([scene.T_world_root[0, :, :, None, :3, :3], scene.body_rot[0]], dim=2).double()
    quat = roma.rotmat_to_unitquat(world)
    between = slerp_quat(quat[before], quat[before + 1], share[:, None, None])
    root = scene.T_world_root[0, :, :, :3, 3].double()
    pelvis = torch.lerp(root[before], root[before + 1], share[:, None, None])
    betas = scene.betas[0].double().numpy()
    poses, transl = roma.unitquat_to_rotvec(between).numpy(), pelvis.numpy() - rest_joints(betas, kind)[:, 0]
    return with_positions(FakeMotion(float(fps), "+y", poses, transl, betas, np.zeros((frames, persons, 22, 3)), kind))


def turned(motion: FakeMotion, up: Axis) -> FakeMotion:
    """The same motion in a world whose up axis is another.

    The body turns about its pelvis J0, not about the origin: transl' = R (transl + J0) - J0.
    """
    R_new_old = UP[up] @ UP[motion.up].T
    first = roma.rotvec_to_rotmat(torch.from_numpy(motion.poses[:, :, 0]))
    poses = motion.poses.copy()
    poses[:, :, 0] = roma.rotmat_to_rotvec(torch.from_numpy(R_new_old) @ first).numpy()
    transl = (motion.transl + motion.pelvis) @ R_new_old.T - motion.pelvis
    return replace(motion, up=up, poses=poses, transl=transl, positions=motion.positions @ R_new_old.T)


@lru_cache(maxsize=128)
def _scene(frames: int, persons: int, seed: int, kind: Kind) -> Scene:
    coupling = "follow" if persons <= 6 else "circle"
    generator = torch.Generator().manual_seed(seed)
    return synthesize(coupling, persons, frames, generator, made_up_body(kind)).scene


def with_positions(motion: FakeMotion) -> FakeMotion:
    """The motion with the world joints of its poses and shapes."""
    rotations = roma.rotvec_to_rotmat(torch.from_numpy(motion.poses))
    T_world_root = rigid(rotations[:, :, 0], torch.from_numpy(motion.transl + motion.pelvis))
    body, betas = made_up_body(motion.kind), torch.from_numpy(motion.betas)
    return replace(motion, positions=body.forward_kinematics(rotations[:, :, 1:], T_world_root, betas).numpy())
