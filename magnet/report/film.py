"""Films of a table: the same scene as it was recorded and as each row has it, side by side, as figures of lines."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from magnet.body.joints import PARENTS
from magnet.export.drawing import AGENTS, BACKGROUND, INK, TILES, font
from magnet.files import load_npz, write_whole
from magnet.motion.scene import FPS

Joints = NDArray[np.float32]

PANEL, HEAD, ACROSS = 160, 22, 4
"""Pixels of a panel's side and of its title; panels in a line."""
EVERY = 3
"""Frames of the motion for one of the film: ten a second."""
METRES = 3.4
"""What a panel shows; it follows the pair."""
TURNED, RAISED = np.deg2rad(35.0), np.deg2rad(14.0)


def keep(path: Path, shown: Mapping[str, Joints]) -> None:
    """Write one scene by row, to millimetres, whole or not at all. each (T, P, 22, 3)"""
    buffer = io.BytesIO()
    motions = np.stack(list(shown.values())).astype(np.float32).round(3)
    np.savez_compressed(buffer, names=np.array(list(shown)), joints=motions)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path.parent, path.name, buffer.getvalue())


def kept(path: Path) -> dict[str, Joints]:
    """What `keep` wrote; nothing where there is no file."""
    if not path.is_file():
        return {}
    with load_npz(path, ("names", "joints")) as stored:
        return dict(zip(stored["names"].tolist(), stored["joints"], strict=True))


def film(rows: Mapping[str, Joints], fps: float = FPS) -> bytes:
    """An animated WebP: a panel a row, all seen from one side. rows: title -> (T, P, 22, 3) in one world"""
    titles = list(rows)
    flat = {title: _projected(joints) for title, joints in rows.items()}
    frames = min(len(joints) for joints in rows.values())
    lines = -(-len(titles) // ACROSS)
    pages = []
    for t in range(0, frames, EVERY):
        page = Image.new("RGB", (min(len(titles), ACROSS) * PANEL, lines * (PANEL + HEAD)), BACKGROUND)
        for number, title in enumerate(titles):
            place = (number % ACROSS * PANEL, number // ACROSS * (PANEL + HEAD))
            _panel(page, place, title, flat[title], t)
        pages.append(page)
    buffer = io.BytesIO()
    tick = round(1000 * EVERY / fps)
    pages[0].save(buffer, "WEBP", save_all=True, append_images=pages[1:], duration=tick, loop=0, quality=35, method=4)
    return buffer.getvalue()


def _projected(joints: Joints) -> Joints:
    """Metres to the right and up in the picture. (T, P, 22, 3) -> (T, P, 22, 2)"""
    x, y, z = np.moveaxis(joints, -1, 0)
    right = np.cos(TURNED) * x - np.sin(TURNED) * z
    away = np.sin(TURNED) * x + np.cos(TURNED) * z
    return np.stack([right, np.cos(RAISED) * y - np.sin(RAISED) * away], axis=-1).astype(np.float32)


def _panel(page: Image.Image, place: tuple[int, int], title: str, flat: Joints, t: int) -> None:
    """One row's people at frame t, in the middle of the panel where they stand on average."""
    part = Image.new("RGB", (PANEL, PANEL + HEAD), BACKGROUND)
    draw = ImageDraw.Draw(part)
    draw.text((6, HEAD / 2), title[:26], fill=INK, font=font(12), anchor="lm")
    draw.rectangle((0, HEAD, PANEL - 1, PANEL + HEAD - 1), outline=TILES[1])
    scale = PANEL / METRES
    middle = flat[max(0, t - 15) : t + 16, :, 0].mean(axis=(0, 1))  # pelvises, over a second, so that it is calm
    seen = (flat[t] - middle) * [scale, -scale] + [PANEL / 2, HEAD + PANEL / 2]
    for person, points in enumerate(seen):
        colour = AGENTS[person % len(AGENTS)]
        for joint, parent in enumerate(PARENTS):
            if parent >= 0:
                draw.line((*points[parent], *points[joint]), fill=colour, width=3)
        head = points[15]
        draw.ellipse((*(head - 5), *(head + 5)), fill=colour)
    page.paste(part, place)
