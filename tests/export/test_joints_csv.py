"""Tables of joint positions: a row a frame and person, as anybody reads them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import torch

from magnet.body import Body
from magnet.body.joints import JOINT_NAMES
from magnet.export.joints_csv import save_csv
from magnet.testing import random_scene


def test_a_table_has_each_persons_joints_at_each_moment_in_metres(body: Body, tmp_path: Path) -> None:
    present = torch.tensor([[True, False, True], [False, True, False]])
    scene = random_scene(2, 7, 3, torch.Generator().manual_seed(3), present).replace(fps=120.0)
    path = save_csv(scene, tmp_path / "two", body)
    assert path.name == "two.csv" and b"\r" not in path.read_bytes()
    rows = list(csv.DictReader(path.open(newline="")))
    told = [(int(row["scene"]), int(row["frame"]), int(row["person"])) for row in rows]
    assert told == [(b, t, p) for b in range(2) for t in range(7) for p in range(3) if present[b, p]]
    joints = body.joints(scene).numpy()
    for row, (b, t, p) in zip(rows, told, strict=True):
        assert abs(float(row["time_s"]) - t / 120) < 1e-6
        there = [[float(row[f"{name}_{axis}_m"]) for axis in "xyz"] for name in JOINT_NAMES]
        assert np.abs(np.array(there) - joints[b, t, p]).max() < 1e-5
