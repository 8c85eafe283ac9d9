"""A tiny InterHuman: made-up couples in its pickles, 59.94 fps and z up."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, people, turned
from magnet.motion.scene import FPS

RATE = 59.94
SPLITS = ("train", "val", "test", "train")


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by take, with split lists and a line of text each."""
    write_body(out / "body.npz", "smpl")
    for folder in ("motions", "annots", "split"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    lists: dict[str, list[str]] = {split: [] for split in SPLITS}
    for index, (name, motion) in enumerate(scenes.items()):
        held: dict[str, Any] = {"mocap_framerate": RATE, "frames": motion.frames}
        held |= {f"person{p + 1}": _person(motion, p) for p in range(2)}
        (out / "motions" / f"{name}.pkl").write_bytes(pickle.dumps(held))
        (out / "annots" / f"{name}.txt").write_text("one person walks behind the other\n", encoding="utf-8")
        lists[SPLITS[index % len(SPLITS)]].append(name)
    for split, names in lists.items():
        (out / "split" / f"{split}.txt").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    (out / "split" / "ignore_list.txt").write_text("", encoding="utf-8")


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by take."""
    long = round(frames * RATE / FPS)
    return {str(index + 1): turned(people(long, 2, RATE, seed + index, kind="smpl"), "+z") for index in range(takes)}


def _person(motion: FakeMotion, p: int) -> dict[str, np.ndarray | str]:
    names = {"transl": "trans", "orient": "root_orient", "body": "pose_body", "betas": "betas"}
    return {names[key]: array for key, array in motion.person(p).items()} | {"gender": "male"}
