"""Films of a table: the same scene as it was recorded and as each row has it, side by side, as figures of lines."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from magnet.body.joints import PARENTS
from magnet.export.drawing import AGENTS, BACKGROUND, INK, TILES, drawable, font
from magnet.files import load_npz, write_whole
from magnet.motion.scene import FPS

Joints = NDArray[np.float32]

PANEL, LINE, ACROSS = 160, 15, 4
"""Pixels of a panel's side and of a line of its title; panels in a line."""
EVERY = 3
"""Frames of the motion for one of the film: ten a second."""
METRES = 3.4
"""What a panel shows; it follows the people, and shows more where they stand farther apart."""
CALM = 15
"""Frames before and after, over which what a panel shows is smoothed."""
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
    names = [wrapped(title, PANEL - 12) for title in rows]
    flat = [_projected(joints) for joints in rows.values()]
    head = 7 + LINE * max(map(len, names))
    frames = min(map(len, flat))
    lines = -(-len(names) // ACROSS)
    pages = []
    for t in range(0, frames, EVERY):
        page = Image.new("RGB", (min(len(names), ACROSS) * PANEL, lines * (PANEL + head)), BACKGROUND)
        for number, (name, motion) in enumerate(zip(names, flat, strict=True)):
            place = (number % ACROSS * PANEL, number // ACROSS * (PANEL + head))
            _panel(page, place, head, name, motion, t)
        pages.append(page)
    buffer = io.BytesIO()
    tick = round(1000 * EVERY / fps)
    pages[0].save(buffer, "WEBP", save_all=True, append_images=pages[1:], duration=tick, loop=0, quality=35, method=4)
    return buffer.getvalue()


def wrapped(text: str, width: float) -> list[str]:
    """Lines of a title that are no wider than so many pixels, words whole."""
    lines: list[str] = []
    for word in drawable(text).split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font(12).getlength(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _projected(joints: Joints) -> Joints:
    """Metres to the right and up in the picture. (T, P, 22, 3) -> (T, P, 22, 2)"""
    x, y, z = np.moveaxis(joints, -1, 0)
    right = np.cos(TURNED) * x - np.sin(TURNED) * z
    away = np.sin(TURNED) * x + np.cos(TURNED) * z
    return np.stack([right, np.cos(RAISED) * y - np.sin(RAISED) * away], axis=-1).astype(np.float32)


def _panel(page: Image.Image, place: tuple[int, int], head: int, name: Sequence[str], flat: Joints, t: int) -> None:
    """One row's people at frame t, in the middle of the panel where they stand on average. flat: (T, P, 22, 2)"""
    part = Image.new("RGB", (PANEL, PANEL + head), BACKGROUND)
    draw = ImageDraw.Draw(part)
    for number, line in enumerate(name):
        draw.text((6, 4 + LINE * (number + 0.5)), line, fill=INK, font=font(12), anchor="lm")
    draw.rectangle((0, head, PANEL - 1, PANEL + head - 1), outline=TILES[1])
    middle, metres = _around(flat, t)
    scale = PANEL / metres
    seen = (flat[t] - middle) * [scale, -scale] + [PANEL / 2, head + PANEL / 2]
    thick, round_ = max(1, round(3 * METRES / metres)), 5 * METRES / metres
    for person, points in enumerate(seen):
        colour = AGENTS[person % len(AGENTS)]
        for joint, parent in enumerate(PARENTS):
            if parent >= 0:
                draw.line((*points[parent], *points[joint]), fill=colour, width=thick)
        skull = points[15]
        draw.ellipse((*(skull - round_), *(skull + round_)), fill=colour)
    if metres > METRES:
        draw.text((PANEL - 6, PANEL + head - 10), f"{metres:.0f} m", fill=INK, font=font(12), anchor="rm")
    page.paste(part, place)


def _around(flat: Joints, t: int) -> tuple[NDArray[np.float64], float]:
    """Where the middle of a panel is at frame t, and how many metres it shows: calm, and nobody is cut off."""
    first, last = max(0, t - CALM), min(len(flat), t + CALM + 1)
    middles = [
        flat[max(0, k - CALM) : k + CALM + 1, :, 0].mean(axis=(0, 1), dtype=np.float64) for k in range(first, last)
    ]
    reach = max(float(np.abs(flat[k] - middle).max()) for k, middle in zip(range(first, last), middles, strict=True))
    return middles[t - first], max(METRES, 2.1 * reach)
