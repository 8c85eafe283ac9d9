"""A tiny CHI3D: made-up pairs as rotation matrices in json, 50 fps and z up."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch

from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, people, turned
from magnet.datamodules.reading.arrays import hashed_split
from magnet.motion.scene import FPS

RATE = 50.0
ACTIONS = ("Grab", "Handshake", "Hit", "HoldingHands", "Hug", "Kick", "Posing", "Push")
HANDS = {"left_hand_pose": 15, "right_hand_pose": 15, "jaw_pose": 1, "leye_pose": 1, "reye_pose": 1}


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by pair and action; of the test pair s01 only the folder, as its motion is not given out."""
    write_body(out / "body.npz")
    (out / "chi3d" / "test" / "s01").mkdir(parents=True, exist_ok=True)
    for name, motion in scenes.items():
        pair, action = name.split("_")
        path = out / "chi3d" / "train" / pair / "smplx" / f"{action}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(_held(motion)), encoding="utf-8")


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by pair and action: train, val, test, train and so on."""
    written: dict[str, FakeMotion] = {}
    for index in range(takes):
        pair = ("s02", "s04", "s03", "s04")[index % 4]
        names = (f"{pair}_{action} {number}" for number in range(1, 100 + takes) for action in ACTIONS)
        split = "val" if index % 4 == 1 else "train"
        name = next(name for name in names if name not in written and hashed_split(name, test=0.0) == split)
        written[name] = turned(people(round(frames * RATE / FPS), 2, RATE, seed + index), "+z")
    return written


def _held(motion: FakeMotion) -> dict[str, Any]:
    T = motion.frames
    matrices = roma.rotvec_to_rotmat(torch.from_numpy(motion.poses)).numpy().transpose(1, 0, 2, 3, 4)
    still = np.broadcast_to(np.eye(3), (2, T, 1, 3, 3))
    arrays = {
        "transl": motion.transl.transpose(1, 0, 2),
        "global_orient": matrices[:, :, :1],
        "body_pose": matrices[:, :, 1:],
        "betas": np.repeat(motion.betas[:, None], T, axis=1),
        "expression": np.zeros((2, T, 10)),
        **{key: np.repeat(still, joints, axis=2) for key, joints in HANDS.items()},
    }
    return {key: np.round(array, 9).tolist() for key, array in arrays.items()}
