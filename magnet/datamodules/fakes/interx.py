"""A tiny Inter-X: motions/G001T000A000R000/{P1,P2}.npz, splits/*.txt, annots/, y up, 120 fps."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, people
from magnet.datamodules.interx import RATE
from magnet.motion.scene import FPS

SPLITS = ("train", "val", "test")
GENDERS = ("female", "male")


def name(number: int) -> str:
    """Of clip `number`."""
    return f"G{1 + number // 8:03}T000A{number % 8:03}R{number:03}"


def length(frames: int) -> int:
    """Frames of a file at 120 fps."""
    return frames * round(RATE / FPS)


def motion(number: int, frames: int, seed: int = 0) -> FakeMotion:
    """What clip `number` shows, y up at 120 fps."""
    return people(length(frames), 2, RATE, seed + number)


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by clip."""
    return {name(number): motion(number, frames, seed) for number in range(takes)}


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by clip, in training, validation and test in turn."""
    write_body(out / "body.npz")
    for part in ("splits", "annots"):
        (out / part).mkdir(parents=True, exist_ok=True)
    listed = list(scenes)
    for k, split in enumerate(SPLITS):
        (out / "splits" / f"{split}.txt").write_text("".join(f"{clip}\n" for clip in listed[k::3]), encoding="utf-8")
    (out / "splits" / "all.txt").write_text("".join(f"{clip}\n" for clip in listed), encoding="utf-8")
    (out / "annots" / "interaction_order.pkl").write_bytes(pickle.dumps({c: k % 2 for k, c in enumerate(listed)}))
    generator = np.random.default_rng(0)
    for clip, shown in scenes.items():
        folder = out / "motions" / clip
        folder.mkdir(parents=True, exist_ok=True)
        for person, gender in enumerate(GENDERS):
            one, hands = shown.person(person), generator.normal(0.0, 0.1, (2, shown.frames, 15, 3)).astype(np.float32)
            np.savez(
                folder / f"P{person + 1}.npz",
                pose_body=one["body"].reshape(-1, 21, 3),
                pose_lhand=hands[0],
                pose_rhand=hands[1],
                root_orient=one["orient"],
                trans=one["transl"],
                betas=one["betas"][None],
                gender=np.array(gender),
            )
