"""A tiny DuoBox: fbx_fit_smpl/*.npy and fbx_export_joints/*.npy, pickled dicts by person, z up, 120 fps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from magnet.body.joints import HEAD, NECK, PELVIS, SPINE1, SPINE3
from magnet.datamodules.duobox import FITS, PARENTS, RATE, SKELETONS, SKIPPED
from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import ARM, LEG, FakeMotion, local_rotations, people, turned, world_rotations
from magnet.motion.scene import FPS

NAMES = (
    "000_ma_jab_liu_defense", "001_liu_hook_ma_defense", "002_tian_jab_ma_defense", "003_liu_free_tian_free",
    "004_ma_hook_tian_defense", "005_tian_free_ma_free",
)  # fmt: skip
SHARE = 5
"""A take's test part is a fifth of it."""
SOURCE = (
    PELVIS, SPINE1, SPINE3, NECK, HEAD, *(pair[0] for pair in ARM), *(pair[1] for pair in ARM),
    *(pair[0] for pair in LEG), *(pair[1] for pair in LEG),
)  # fmt: skip
"""Our joint that stands in for each of MOTIVE's."""


def name(number: int) -> str:
    """Of take `number`."""
    return f"{number:03}{NAMES[number % len(NAMES)][3:]}"


def subjects(name: str) -> tuple[str, str]:
    """The two people of a take, in the order of its files."""
    words = name.split("_")
    return words[1], words[3]


def length(frames: int) -> int:
    """Frames at 120 fps of a file whose test part has `frames` at 30 fps."""
    return SKIPPED + SHARE * frames * round(RATE / FPS)


def motion(number: int, frames: int, seed: int = 0) -> FakeMotion:
    """What take `number` shows, z up at 120 fps."""
    return turned(people(length(frames), 2, RATE, seed + number), "+z")


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by take."""
    return {name(number): motion(number, frames, seed) for number in range(takes)}


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by take; every take has all three splits."""
    for folder in (FITS, SKELETONS):
        (out / folder).mkdir(parents=True, exist_ok=True)
    write_body(out / "body.npz")
    for name, shown in scenes.items():
        fits, skeletons = {}, {}
        for person, subject in enumerate(subjects(name)):
            one = shown.person(person)
            fits[subject] = {
                "transl": one["transl"],
                "global_orient": one["orient"],
                "body_pose": one["body"],
                "betas": np.tile(one["betas"], (shown.frames, 1)),
            }
            skeletons[f"{subject}_position"] = shown.positions[:, person, list(SOURCE)].astype(np.float32)
            world = world_rotations(shown.poses[:, person])[:, list(SOURCE)]
            skeletons[f"{subject}_rotation"] = local_rotations(world, PARENTS).astype(np.float32)
        np.save(out / FITS / f"{name}.npy", fits, allow_pickle=True)  # type: ignore[arg-type]
        np.save(out / SKELETONS / f"{name}.npy", skeletons, allow_pickle=True)  # type: ignore[arg-type]
