"""Made-up scenes of somebody's own: in turn two npz as AMASS has them, a pickle of two people, a scene of magnet's."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import roma
import torch

from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, made_up_body, people, turned
from magnet.datamodules.reading.recording import Axis
from magnet.motion.frames import rigid
from magnet.motion.scene import FPS, Scene

FORMS: tuple[tuple[str, float, Axis], ...] = (("amass", 60.0, "+z"), ("pickle", 25.0, "+y"), ("magnet", 30.0, "+y"))
"""In turn: what is written, its frame rate and its up axis."""


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by take."""
    found = {}
    for number in range(takes):
        form, fps, up = FORMS[number % len(FORMS)]
        long = int(np.ceil((frames - 1) * fps / FPS - 1e-9)) + 1
        found[f"{form}{number + 1}"] = turned(people(long, 2, fps, seed + number), up)
    return found


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by take, whose name says in which form, and body.npz, whose the shape numbers are."""
    write_body(out / "body.npz")
    for name, shown in scenes.items():
        form = next(form for form, _, _ in FORMS if name.startswith(form))
        {"amass": _amass, "pickle": _pickle, "magnet": _scene}[form](out, name, shown)


def _amass(out: Path, name: str, shown: FakeMotion) -> None:
    for person in range(shown.poses.shape[1]):
        poses = np.concatenate([shown.poses[:, person].reshape(-1, 66), np.zeros((shown.frames, 99))], axis=1)
        np.savez(
            out / f"{name}_{chr(ord('A') + person)}.npz",
            poses=poses,
            trans=shown.transl[:, person],
            betas=np.concatenate([shown.betas[person], np.zeros(6)]),
            mocap_frame_rate=np.array(shown.fps),
            surface_model_type=np.array("smplx"),
        )


def _pickle(out: Path, name: str, shown: FakeMotion) -> None:
    held: dict[str, object] = {"fps": shown.fps}
    for person in range(shown.poses.shape[1]):
        held[f"person{person + 1}"] = {
            "global_orient": shown.poses[:, person, 0],
            "body_pose": shown.poses[:, person, 1:],
            "transl": shown.transl[:, person],
            "betas": shown.betas[person],
        }
    (out / f"{name}.pkl").write_bytes(pickle.dumps(held))


def _scene(out: Path, name: str, shown: FakeMotion) -> None:
    rotations = roma.rotvec_to_rotmat(torch.from_numpy(shown.poses))
    pelvis = torch.from_numpy(shown.transl + shown.pelvis)
    Scene(
        body_rot=rotations[None, :, :, 1:],
        T_world_root=rigid(rotations[:, :, 0], pelvis)[None],
        betas=torch.from_numpy(shown.betas)[None],
        present=torch.ones(1, shown.poses.shape[1], dtype=torch.bool),
        fps=shown.fps,
        body=made_up_body(shown.kind).id,
    ).save(out / f"{name}.npz")
