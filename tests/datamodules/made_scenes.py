"""Random motion for any data set's fake, and where its joints must be after `canonicalize`, worked out by scipy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from magnet.datamodules import registry
from magnet.datamodules.duobox import DuoBoxReader
from magnet.datamodules.fakes.body import Kind
from magnet.datamodules.fakes.motion import UP, FakeMotion, people, rest_joints, turned
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import PrepareJob
from magnet.datamodules.reading.recording import Axis, Reader, Recording
from tests.datamodules.readers import fake_of, world_joints
from tests.datamodules.remocap_fits import write_fitted_scenes

MILLIMETRE = 0.001
FITTED = 0.04
"""Metres: the bound of joints that are read, and of those that a body is fitted to, above which readers refuse."""
FORMS: dict[str, tuple[str, dict[str, Any], float]] = {
    **{
        name: (name, {}, FITTED if registry.reader(name).family == "positions" else MILLIMETRE)
        for name in registry.readers()
        if name != "cmu"  # its fake sways as it likes; test_cmu.py holds it to an independent reader
    },
    "remocap, ready fits": ("remocap", {"fits": "fits"}, MILLIMETRE),
    "duobox, bare skeleton": ("duobox", {"form": "skeleton", "phases": 1}, FITTED),
}
"""Data set, options of its reader, bound."""


def wild(motion: FakeMotion, seed: int) -> FakeMotion:
    """Walkers, y up, of other shapes, swaying in every joint, anywhere and in any heading."""
    random = np.random.default_rng(seed)
    T, P = motion.poses.shape[:2]
    time = np.arange(T)[:, None, None, None] / motion.fps
    size, pace, phase = (random.uniform(0.0, most, (P, 22, 3)) for most in (0.3, 1.5, 2 * math.pi))
    size[:, 0] *= 0.3
    sway = size * np.sin(2 * math.pi * pace * time + phase)
    poses = (turns(motion.poses) * turns(sway)).as_rotvec().reshape(T, P, 22, 3)
    heading = Rotation.from_rotvec([0.0, random.uniform(-math.pi, math.pi), 0.0])
    poses[:, :, 0] = (heading * turns(poses[:, :, 0])).as_rotvec().reshape(T, P, 3)
    pelvis = heading.apply((motion.transl + motion.pelvis).reshape(-1, 3)).reshape(T, P, 3)
    pelvis += random.uniform([-8.0, -1.5, -8.0], [8.0, 1.5, 8.0])
    betas = random.normal(0.0, 1.2, (P, 10)) if motion.betas.any() else motion.betas
    return with_positions(
        replace(motion, poses=poses, betas=betas, transl=pelvis - rest_joints(betas, motion.kind)[:, 0])
    )


def random_scene(like: FakeMotion, seconds: float, seed: int, rate: float = 1.0) -> FakeMotion:
    """People as in `like`: as many, of its frame rate, up axis and kind of body.

    Args:
        like: of a fake.
        seconds: at the declared frame rate.
        seed: of all but their steps.
        rate: true frame rate over the declared one; unless 1 they only walk.
    """
    persons, frames = like.poses.shape[1], round(seconds * like.fps)
    return moving(frames, persons, like.fps, like.up, like.kind, bool(like.betas.any()), seed, rate)


@lru_cache(maxsize=64)
def moving(
    frames: int, persons: int, fps: float, up: Axis, kind: Kind, shaped: bool, seed: int, rate: float
) -> FakeMotion:
    """`random_scene` of numbers alone; whoever is not `shaped` has zero shape. Nobody may write into its arrays."""
    walking = people(frames, persons, rate * fps, kind=kind)
    if not shaped:
        betas = np.zeros((persons, 10))
        transl = walking.transl + walking.pelvis - rest_joints(betas, kind)[:, 0]
        walking = replace(walking, betas=betas, transl=transl)
    walking = wild(walking, seed) if rate == 1.0 else with_positions(walking)
    return turned(replace(walking, fps=fps), up)


def turns(vectors: NDArray) -> Rotation:
    return Rotation.from_rotvec(vectors.reshape(-1, 3))


def with_positions(motion: FakeMotion) -> FakeMotion:
    recording = Recording(motion.fps, motion.up, poses=motion.poses, transl=motion.transl, betas=motion.betas)
    return replace(motion, positions=world_joints(recording, motion.kind))


def scene_of(reader: Reader, take: str, scenes: dict[str, FakeMotion]) -> FakeMotion:
    """What a take shows: a written scene, or a part of one."""
    if not isinstance(reader, DuoBoxReader):
        return scenes[take]
    key, _, part = take.rpartition("_")
    whole = scenes[key]
    shown = reader.frames(take, whole.frames, part)
    return replace(whole, poses=whole.poses[shown], transl=whole.transl[shown], positions=whole.positions[shown])


def joints_at_30_fps(motion: FakeMotion) -> NDArray:
    """Joints at times i / 30 in a world with y up: rotations by slerp, the pelvis by straight lines. (T, P, 22, 3)"""
    last = (motion.frames - 1) / motion.fps
    old, new = np.arange(motion.frames) / motion.fps, np.arange(math.floor(last * 30 + 1e-6) + 1) / 30
    new = np.minimum(new, last)
    T, P = len(new), motion.poses.shape[1]
    poses, transl = np.zeros((T, P, 22, 3)), np.zeros((T, P, 3))
    for p in range(P):
        for axis in range(3):
            transl[:, p, axis] = np.interp(new, old, motion.transl[:, p, axis])
        for j in range(22):
            poses[:, p, j] = Slerp(old, Rotation.from_rotvec(motion.poses[:, p, j]))(new).as_rotvec()
    shown = with_positions(replace(motion, poses=poses, transl=transl))
    return shown.positions @ UP[motion.up]


def placed(joints: NDArray, like: NDArray) -> NDArray:
    """Moved as `canonicalize` must: pelvises of the first frame about the origin, and one height for the floor."""
    joints = joints - joints[0, :, 0].mean(axis=0) * [1.0, 0.0, 1.0]
    return joints + np.array([0.0, np.median(like[..., 1] - joints[..., 1]), 0.0])


def written(form: str, root: Path, scenes: Mapping[str, FakeMotion], steps: CanonicalizeOptions) -> PrepareJob:
    """The order to prepare scenes that now lie under `root` in a data set's layout."""
    name, options, _ = FORMS[form]
    fake_of(name).write_scenes(root, scenes)
    if "fits" in options:
        write_fitted_scenes(root / "fits", scenes)
        options = {"fits": root / "fits"}
    return PrepareJob(name, str(root), options, str(root / "body.npz"), steps)
