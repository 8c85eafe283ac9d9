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


def write(out: Path, takes: int = 4, frames: int = 90, seed: int = 0) -> None:
    """Scenes of 2, 3 and 4 people in acting and daylife, each with a cast and a session of its own."""
    write_scenes(out, scenes(takes, frames, seed))


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by capture, whose name says the section and the people."""
    write_body(out / "body.npz")
    listed: dict[str, dict[str, dict[str, Any]]] = {section: {} for section in LABELS}
    for index, (capture, motion) in enumerate(scenes.items()):
        section = section_of(capture)
        ids = ids_of(capture)
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
        path.write_text(json.dumps(subjects, indent=4))


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


def section_of(capture: str) -> str:
    """The section whose label a capture's name has."""
    return next(section for section, label in LABELS.items() if label in capture)


def ids_of(capture: str) -> list[str]:
    """Subjects in a capture's name."""
    return capture.split("--pilot")[0].split("--")[3:]


def _features(motion: FakeMotion, p: int, lost: int) -> dict[str, np.ndarray]:
    T = motion.frames
    betas = np.zeros((T, 300))
    betas[:, :10] = motion.betas[p]
    missing = np.ones(T)
    missing[T - min(lost, T // 4) :] = 0
    arrays = {
        "smplx_mesh_betas": betas,
        "smplx_mesh_body_pose": motion.poses[:, p, 1:].reshape(T, 63),
        "smplx_mesh_global_orient": motion.poses[:, p, 0],
        "smplx_mesh_left_hand_pose": np.zeros((T, 45)),
        "smplx_mesh_right_hand_pose": np.zeros((T, 45)),
        "smplx_mesh_transl": motion.transl[:, p],
        "missing": missing,
    }
    return {feature: array.astype(np.float32) for feature, array in arrays.items()}
