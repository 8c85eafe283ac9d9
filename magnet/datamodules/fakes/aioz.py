"""A tiny AIOZ-GDANCE: made-up groups of two to seven in its pickles, without shapes."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import roma
import torch

from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, made_up_body, people, rest_joints

SPLITS = ("train", "val", "test", "train")
GROUPS = (2, 3, 5, 7)


def write(out: Path, takes: int = 4, frames: int = 90, seed: int = 0) -> None:
    """Sequences named after a video, first and last frame, and a list a split."""
    write_scenes(out, scenes(takes, frames, seed))


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by sequence; betas are not written."""
    write_body(out / "body.npz", "smpl")
    (out / "motions_smpl").mkdir(parents=True, exist_ok=True)
    lists: dict[str, list[str]] = {split: [] for split in SPLITS}
    for index, (name, motion) in enumerate(scenes.items()):
        T, P = motion.poses.shape[:2]
        poses = np.zeros((P, T, 72), dtype=np.float32)
        poses[..., :66] = motion.poses.transpose(1, 0, 2, 3).reshape(P, T, 66)
        held = {
            "smpl_poses": poses,
            "root_trans": motion.transl.transpose(1, 0, 2).astype(np.float32),
            "meta": {"orig_start": 0, "orig_end": T},
        }
        (out / "motions_smpl" / f"{name}.pkl").write_bytes(pickle.dumps(held))
        lists[SPLITS[index % len(SPLITS)]].append(name)
    for split, names in lists.items():
        (out / f"{split}_split_sequence_names.txt").write_text("".join(f"{name}\n" for name in names))


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by sequence."""
    return {
        f"video{index:03}_01_0_{frames}": mean_shape(
            people(frames, GROUPS[index % len(GROUPS)], seed=seed + index, kind="smpl")
        )
        for index in range(takes)
    }


def mean_shape(motion: FakeMotion) -> FakeMotion:
    """The same rotations and pelvises on bodies of zero shape."""
    betas = np.zeros_like(motion.betas)
    transl = motion.transl + motion.pelvis - rest_joints(betas, motion.kind)[:, 0]
    rotations = roma.rotvec_to_rotmat(torch.from_numpy(motion.poses))
    T_world_root = torch.eye(4, dtype=torch.float64).repeat(*motion.poses.shape[:2], 1, 1)
    T_world_root[..., :3, :3] = rotations[:, :, 0]
    T_world_root[..., :3, 3] = torch.from_numpy(motion.transl + motion.pelvis)
    body = made_up_body(motion.kind)
    positions = body.forward_kinematics(rotations[:, :, 1:], T_world_root, torch.from_numpy(betas)).numpy()
    return replace(motion, betas=betas, transl=transl, positions=positions)
