"""A tiny Embody 3D: made-up people in its folders, names, keys and numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, people

LABELS = {"acting": "ACTING_Adult_Birthday_", "daylife": "DAYLIFE_Going_out"}
ELSEWHERE = "/social_ai/datasets/opensource"
"""dataset.json names files by paths on its authors' machines."""
LOST = 3
"""Frames at the end of every fourth scene whose tracking is marked as bad."""


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by capture, whose name says the section and the people; each has a cast and a session of its own."""
    write_body(out / "body.npz")
    listed: dict[str, dict[str, dict[str, Any]]] = {section: {} for section in LABELS}
    for index, (capture, motion) in enumerate(scenes.items()):
        section = next(section for section, label in LABELS.items() if label in capture)
        ids = capture.split("--pilot")[0].split("--")[3:]
        for p, person in enumerate(ids):
            folder = out / "datasets" / section / capture / person
            for feature, array in _features(motion, p, lost=LOST if index % 4 == 1 and p == 0 else 0).items():
                (folder / feature).mkdir(parents=True)
                np.save(folder / feature / f"{capture}.npy", array)
            place = f"{ELSEWHERE}/{section}/{capture}/{person}"
            listed[section].setdefault(person, {})[capture] = {
                "length": motion.frames,
                "id": sum(map(len, listed[section].values())),
                "text": f"{place}/text_annotations/{capture}.json",
                "multiperson": [other for other in ids if other != person],
                "audio": f"{place}/audio_separated/{capture}.wav",
            }
    for section, subjects in listed.items():
        path = out / "datasets" / section / "dataset.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(subjects, indent=4), encoding="utf-8")


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by capture."""
    written = {}
    for index in range(takes):
        persons = 2 + index % 3
        ids = [
            f"{'ABCD'[p]}{chr(65 + index // 26 % 26)}{chr(65 + index % 26)}{100 + index % 900}" for p in range(persons)
        ]
        session = f"{20250101 + index // 28 % 12 * 100 + index % 28}--{900 + index // 336:04}"
        label = LABELS["daylife" if index % 2 else "acting"]
        span = f"{1000 * index:06}-{1000 * index + frames - 1:06}"
        capture = f"c--{session}--{'--'.join(ids)}--pilot--MotionPrior--{label}--{span}"
        written[capture] = people(frames, persons, seed=seed + index)
    return written


def _features(motion: FakeMotion, p: int, lost: int) -> dict[str, np.ndarray]:
    T, one = motion.frames, motion.person(p)
    hand = np.zeros((T, 45), dtype=np.float32)
    missing = np.ones(T, dtype=np.float32)
    missing[T - min(lost, T // 4) :] = 0
    return {
        "smplx_mesh_betas": np.tile(np.pad(one["betas"], (0, 290)), (T, 1)),
        "smplx_mesh_body_pose": one["body"],
        "smplx_mesh_global_orient": one["orient"],
        "smplx_mesh_left_hand_pose": hand,
        "smplx_mesh_right_hand_pose": hand,
        "smplx_mesh_transl": one["transl"],
        "missing": missing,
    }
