"""Still pictures: every cell holds its people in the colours of what is known and what is generated."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from magnet.body import Body
from magnet.export import contact_sheet
from magnet.export.drawing import AGENTS, CONTEXT, STYLES, Style
from magnet.export.figures import bulged
from magnet.motion.scene import Scene
from tests.cases import few

Count = Callable[[Image.Image, tuple[int, int, int]], int]


@pytest.mark.parametrize("style", few(STYLES))
def test_every_cell_of_a_sheet_shows_its_people(
    style: Style, duet: Scene, body: Body, tmp_path: Path, pixels_like: Count
) -> None:
    rows = {"sample": duet, "truth": duet}
    path = contact_sheet(
        rows, tmp_path / "a.png", context_frames=4, frames=[0, 3, 4, 11], body=body, style=style, cell=(120, 120)
    )
    with Image.open(path) as page:
        left, top = page.width - 4 * 120, page.height - 2 * 120
        for row in range(2):
            for column in range(4):
                x, y = left + 120 * column, top + 120 * row
                cell = page.crop((x, y, x + 120, y + 120))
                pink, blue = pixels_like(cell, CONTEXT[0]), pixels_like(cell, AGENTS[0])
                assert (pink > 60 and blue == 0) if column < 2 else (pink == 0 and blue > 60)
        assert np.asarray(page.crop((0, 0, left, page.height)).convert("L")).min() < 128  # labels


def test_columns_spread_from_first_to_last_frame(duet: Scene, body: Body, tmp_path: Path) -> None:
    every = contact_sheet(duet, tmp_path / "a.png", 3, context_frames=0, body=body, style="skeleton", cell=(80, 80))
    named = contact_sheet(
        duet, tmp_path / "b.png", context_frames=0, frames=[0, 6, 11], body=body, style="skeleton", cell=(80, 80)
    )
    assert every.read_bytes() == named.read_bytes()


def test_times_count_from_what_the_scene_says_was_given(duet: Scene, body: Body, tmp_path: Path) -> None:
    given = (torch.arange(12) < 4)[None, :, None].expand(1, 12, 2)
    pages = [
        contact_sheet(duet.replace(given=given), tmp_path / f"{n}.png", context_frames=n, body=body, style="skeleton")
        for n in (0, 4, 8)
    ]
    assert len({page.read_bytes() for page in pages}) == 1


def test_bad_frames_and_suffixes_are_named(duet: Scene, body: Body, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"frames \[12\]: expected some of 0 to 11"):
        contact_sheet(duet, tmp_path / "a.png", context_frames=4, frames=[12], body=body)
    with pytest.raises(ValueError, match=r"a\.jpg.*\.png"):
        contact_sheet(duet, tmp_path / "a.jpg", context_frames=4, body=body)


def test_rounding_a_mesh_of_a_sphere_comes_nearer_the_sphere() -> None:
    corners = np.array([[[x, 0, 0], [0, y, 0], [0, 0, z]] for x in (1.0, -1) for y in (1.0, -1) for z in (1.0, -1)])
    rounded, normals = bulged(corners, corners)
    assert rounded.shape == (32, 3, 3)
    assert np.allclose(np.linalg.norm(normals, axis=-1), 1)
    flat = 1 - np.linalg.norm((corners + np.roll(corners, -1, axis=1)) / 2, axis=-1).min()
    assert np.abs(1 - np.linalg.norm(rounded, axis=-1)).max() < 0.7 * flat
