"""A tiny DD100: data/motion/smplx/all/*_00.npy and _01.npy, pickled dicts, z up, 30 fps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, people, turned

NAMES = (
    "Waltz_001_001", "Jive_004_002", "Tango_005_022", "Ballet_009_001", "Ballet_001_003", "Samba_003_002",
    "Foxtrot_010_000", "Quickstep_002_037", "PasoDable_006_004", "Qiaqiaqia_007_005", "Lumba_008_001",
)  # fmt: skip
GENDERS = ("female", "male")


def motion(number: int, frames: int, seed: int = 0) -> FakeMotion:
    """What take `number` shows, z up: the follower, then the leader."""
    return turned(people(frames, 2, 30.0, seed + number), "+z")


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by take."""
    return {name(number): motion(number, frames, seed) for number in range(takes)}


def name(number: int) -> str:
    """Of take `number`, without the role."""
    genre, choreography, take = NAMES[number % len(NAMES)].split("_")
    return f"{genre}_{choreography}_{int(take) + 100 * (number // len(NAMES)):03}"


def write(out: Path, takes: int = 4, frames: int = 90, seed: int = 0) -> None:
    """Write the fake, and out/body.npz: the first take trains, the second validates, the next two test."""
    write_scenes(out, scenes(takes, frames, seed), seed)


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion], seed: int = 0) -> None:
    """Any motions by take; the seed is of the fingers."""
    folder = out / "data/motion/smplx/all"
    folder.mkdir(parents=True, exist_ok=True)
    write_body(out / "body.npz")
    generator = np.random.default_rng(seed)
    for name, shown in scenes.items():
        frames = shown.frames
        for person, gender in enumerate(GENDERS):
            face = np.zeros((frames, 9))
            hands = generator.normal(0.0, 0.1, (frames, 90))
            poses = np.concatenate([shown.poses[:, person].reshape(frames, 66), face, hands], axis=1)
            held = {
                "poses": poses.astype(np.float32),
                "global_orient": poses[:, :3].astype(np.float32),
                "transl": shown.transl[:, person].astype(np.float32),
                "betas": np.tile(shown.betas[person], (frames, 1)).astype(np.float32),
                "meta": {"gender": gender},
            }
            np.save(folder / f"{name}_{person:02}.npy", held, allow_pickle=True)  # type: ignore[arg-type]
