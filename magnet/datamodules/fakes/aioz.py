"""A tiny AIOZ-GDANCE: made-up groups of two to seven in its pickles, without shapes."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import FakeMotion, people, rest_joints, with_positions

SPLITS = ("train", "val", "test", "train")
GROUPS = (2, 3, 5, 7)


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by sequence, named after a video, first and last frame, and a list a split; no betas."""
    write_body(out / "body.npz", "smpl")
    (out / "motions_smpl").mkdir(parents=True, exist_ok=True)
    lists: dict[str, list[str]] = {split: [] for split in SPLITS}
    for index, (name, motion) in enumerate(scenes.items()):
        T, P = motion.poses.shape[:2]
        people = [motion.person(p) for p in range(P)]
        hands = np.zeros((T, 6), dtype=np.float32)
        poses = np.stack([np.concatenate([one["orient"], one["body"], hands], axis=1) for one in people])
        trans = np.stack([one["transl"] for one in people])
        held = {"smpl_poses": poses, "root_trans": trans, "meta": {"orig_start": 0, "orig_end": T}}
        (out / "motions_smpl" / f"{name}.pkl").write_bytes(pickle.dumps(held))
        lists[SPLITS[index % len(SPLITS)]].append(name)
    for split, names in lists.items():
        (out / f"{split}_split_sequence_names.txt").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by sequence."""
    made = [people(frames, GROUPS[index % len(GROUPS)], seed=seed + index, kind="smpl") for index in range(takes)]
    return {f"video{index:03}_01_0_{frames}": mean_shape(motion) for index, motion in enumerate(made)}


def mean_shape(motion: FakeMotion) -> FakeMotion:
    """The same rotations and pelvises on bodies of zero shape."""
    betas = np.zeros_like(motion.betas)
    transl = motion.transl + motion.pelvis - rest_joints(betas, motion.kind)[:, 0]
    return with_positions(replace(motion, betas=betas, transl=transl))
