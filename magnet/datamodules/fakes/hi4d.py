"""A tiny Hi4D: made-up pairs, one npz a frame; the scans' vertices and contacts, which nothing reads, are left out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, people

PAIRS = ("00", "23", "28", "01")  # train, val, test, train
ACTIONS = ("dance", "hug", "talk")
START = 11


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by pair and action, each with meta.npz and smpl/000XXX.npz."""
    write_body(out / "body.npz", "smpl")
    for name, motion in scenes.items():
        folder = out / Path(*name.split("_"))
        (folder / "smpl").mkdir(parents=True)
        np.savez(
            folder / "meta.npz",
            start=START,
            end=START + motion.frames - 1,
            num_persons=2,
            genders=np.array(["male", "female"]),
            betas=motion.betas.astype(np.float32),
            contact_ids=np.array([START]),
            mono_cam=4,
        )
        for t in range(motion.frames):
            np.savez(folder / "smpl" / f"{START + t:06}.npz", **_frame(motion, t))  # type: ignore[arg-type]


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by pair and action."""
    return {
        f"pair{PAIRS[index % len(PAIRS)]}_{ACTIONS[index // len(PAIRS) % len(ACTIONS)]}{index // 12:02}": people(
            frames, 2, seed=seed + index, kind="smpl"
        )
        for index in range(takes)
    }


def _frame(motion: FakeMotion, t: int) -> dict[str, np.ndarray]:
    body = np.zeros((2, 69))
    body[:, :63] = motion.poses[t, :, 1:].reshape(2, 63)
    arrays = {
        "betas": motion.betas,
        "body_pose": body,
        "global_orient": motion.poses[t, :, 0],
        "transl": motion.transl[t],
        "joints_3d": motion.positions[t][:, [*range(22), 20, 21]],
    }
    return {key: array.astype(np.float32) for key, array in arrays.items()}
