"""Still pictures of scenes: strips of frames."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from magnet.body import Body
from magnet.export.cast import Scenes, casts
from magnet.export.drawing import INK, Camera, Size, Style, drawable, font, plan_views
from magnet.export.video import GENERATED, PAGE, PINK, paint
from magnet.files import whole


def contact_sheet(
    scenes: Scenes,
    path: str | Path,
    columns: int = 8,
    *,
    context_frames: int,
    frames: Sequence[int] | None = None,
    body: Body | None = None,
    style: Style = "body",
    cell: Size = (240, 240),
    title: str | None = None,
    camera: Camera | None = None,
) -> Path:
    """Write a PNG whose rows are scenes (samples, methods, the truth) and whose columns are moments.

    Returns the path written.

    Args:
        scenes: a scene, each of its B a row, or labelled scenes; all of one length and frame rate.
        columns: how many moments, evenly spread from the first frame to the last.
        context_frames: number of first frames given to the model, if the scene does not say; they are pink, and times
            count from the last one.
        frames: the frames to show, in place of `columns`.
        body: the scenes' body model; the packaged one if None.
        cell: pixels of one picture in the sheet.

    Raises:
        ValueError: scenes that cannot be drawn, or a frame outside them.
    """
    labels, people = casts(scenes, context_frames, body, style)
    last, fps = people[0].frames - 1, people[0].scene.fps
    moments = np.linspace(0, last, columns).round().astype(int).tolist() if frames is None else list(frames)
    if not moments or not all(0 <= moment <= last for moment in moments):
        raise ValueError(f"frames {moments}: expected some of 0 to {last}")
    views = plan_views([c.joints for c in people], camera or Camera(), cell, fps)
    unit = cell[1] / 240
    left = round(_label_width(labels, 15 * unit))
    top = round((34 if title else 0) * unit) + round(26 * unit)
    page = Image.new("RGB", (left + len(moments) * cell[0], top + len(people) * cell[1]), PAGE)
    draw = ImageDraw.Draw(page)
    if title:
        draw.text((12 * unit, 22 * unit), drawable(title), fill=INK, font=font(20 * unit), anchor="lm")
    context = people[0].context
    for i, moment in enumerate(moments):
        ink = PINK if moment < context else GENERATED
        place = (left + (i + 0.5) * cell[0], top - 13 * unit)
        seconds = f"{(moment - context + 1) / fps:+.2f} s" if context else f"{moment / fps:.2f} s"
        draw.text(place, seconds, fill=ink, font=font(15 * unit), anchor="mm")
        for row, group in enumerate(people):
            page.paste(paint(group, views[row][moment], moment), (left + i * cell[0], top + row * cell[1]))
    for row, label in enumerate(labels):
        middle = top + (row + 0.5) * cell[1]
        draw.multiline_text((12 * unit, middle), _broken(label), fill=INK, font=font(15 * unit), anchor="lm")
        if row:
            draw.line((0, top + row * cell[1], page.width, top + row * cell[1]), fill=(226, 229, 235))
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path.name}: pictures are written as .png")
    with whole(path) as part:
        page.save(part)
    return path


def _broken(label: str) -> str:
    """A label in lines of at most 16 letters, where its words allow."""
    return textwrap.fill(" ".join(label.split()), 16, break_long_words=False, break_on_hyphens=False)


def _label_width(labels: list[str], size: float) -> float:
    lines = [line for label in labels for line in _broken(label).split("\n")]
    widest = max(font(size).getlength(line) for line in lines)
    return widest + 24 * size / 15 if widest else 0.0
