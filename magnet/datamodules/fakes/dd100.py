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


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by take; the first trains, the second validates, the next two test."""
    folder = out / "data/motion/smplx/all"
    folder.mkdir(parents=True, exist_ok=True)
    write_body(out / "body.npz")
    generator = np.random.default_rng(0)
    for name, shown in scenes.items():
        for person, gender in enumerate(GENDERS):
            one = shown.person(person)
            face, hands = np.zeros((shown.frames, 9)), generator.normal(0.0, 0.1, (shown.frames, 90))
            held = {
                "poses": np.concatenate([one["orient"], one["body"], face, hands], axis=1).astype(np.float32),
                "global_orient": one["orient"],
                "transl": one["transl"],
                "betas": np.tile(one["betas"], (shown.frames, 1)),
                "meta": {"gender": gender},
            }
            np.save(folder / f"{name}_{person:02}.npy", held, allow_pickle=True)  # type: ignore[arg-type]
