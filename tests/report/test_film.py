"""Films of a table."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageSequence

from magnet.body import load_body
from magnet.export.drawing import AGENTS, font
from magnet.report.film import film, keep, kept, wrapped
from magnet.testing import random_scene


def test_a_film_has_a_frame_for_every_third_of_the_motion_and_people_in_every_panel(tmp_path: Path) -> None:
    joints = load_body().joints(random_scene(2, 30, 2, torch.Generator().manual_seed(0))).numpy()
    keep(tmp_path / "scene.npz", {"ground truth": joints[0], "ours": joints[1]})
    again = kept(tmp_path / "scene.npz")
    assert list(again) == ["ground truth", "ours"]
    assert abs(again["ours"] - joints[1]).max() <= 0.0006  # millimetres
    assert kept(tmp_path / "nothing.npz") == {}
    (tmp_path / "film.webp").write_bytes(film(again))
    with Image.open(tmp_path / "film.webp") as moving:
        assert moving.n_frames == 10  # type: ignore[attr-defined]
        frames = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(moving)]
    for panel in np.split(frames[0], 2, axis=1):
        assert (np.ptp(panel, axis=-1) > 60).sum() > 50  # coloured strokes
    assert abs(frames[0] - frames[-1]).max() > 60


def test_people_who_walk_apart_stay_in_the_panel() -> None:
    """Each a metre a second, away from the other: 6 m apart at the end, where a panel shows 3.4 m of who stay."""
    joints = load_body().joints(random_scene(1, 90, 2, torch.Generator().manual_seed(0)))[0].numpy()
    joints = joints - joints[:, :, :1] + [0.0, 1.0, 0.0]
    joints[:, :, :, 0] += np.linspace(0.0, 3.0, 90)[:, None, None] * [[[-1.0], [1.0]]]
    with Image.open(io.BytesIO(film({"apart": joints.astype(np.float32)}))) as moving:
        last = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(moving)][-1]
    for colour in AGENTS[:2]:
        near = np.abs(last - np.array(colour)).max(axis=-1) < 60
        assert near.sum() > 20 and not near[:, :2].any() and not near[:, -2:].any(), colour


def test_a_title_is_whole_in_lines_no_wider_than_its_panel() -> None:
    title = "trained and sampled so: pairs as clean as their token"
    lines = wrapped(title, 148)
    assert " ".join(lines) == title and len(lines) > 1
    assert max(font(12).getlength(line) for line in lines) <= 148
