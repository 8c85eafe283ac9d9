"""Still pictures of scenes: strips of frames to judge bodies, feet and partners by, and ways seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from magnet.body.joints import L_HIP, PELVIS, R_HIP
from magnet.export.cast import Cast, Posable, Scenes, Style, cast, default_body, known_frames, panels
from magnet.export.drawing import BACKGROUND, INK, PALE, TILE, Array, Camera, Size, font, plan_views
from magnet.export.video import GENERATED, PAGE, PINK, paint


def contact_sheet(
    scenes: Scenes,
    path: str | Path,
    columns: int = 8,
    *,
    context_frames: int,
    frames: Sequence[int] | None = None,
    body: Posable | None = None,
    style: Style = "body",
    cell: Size = (240, 240),
    title: str | None = None,
    camera: Camera | None = None,
) -> Path:
    """Write a PNG whose rows are scenes (samples, methods, the truth) and whose columns are moments.

    Args:
        scenes: a scene, each of its B a row, or labelled scenes; all of one length.
        columns: how many moments, evenly spread from the first frame to the last.
        context_frames: how many first frames were given to the model, where the scene does not say; they are pink, and
            times count from the last.
        frames: which frames instead, in place of `columns`.
        body: the scenes' body model; the packaged one if None.
        cell: pixels of one picture in the sheet.

    Returns:
        The path written.

    Raises:
        ValueError: scenes that cannot be drawn, or a frame outside them.
    """
    rows = panels(scenes)
    first = rows[0][1]
    body = body or default_body(first)
    people = [cast(s, body, style, known_frames(s, context_frames)) for _, s in rows]
    moments = np.linspace(0, first.frames - 1, columns).round().astype(int).tolist() if frames is None else list(frames)
    if not moments or not all(0 <= moment < first.frames for moment in moments):
        raise ValueError(f"frames {moments}: expected some of 0 to {first.frames - 1}")
    views = plan_views([c.joints for c in people], camera or Camera(), cell, first.fps)
    unit = cell[1] / 240
    left = round(_label_width([label for label, _ in rows], 15 * unit))
    top = round((34 if title else 0) * unit) + round(26 * unit)
    page = Image.new("RGB", (left + len(moments) * cell[0], top + len(rows) * cell[1]), PAGE)
    draw = ImageDraw.Draw(page)
    if title:
        draw.text((12 * unit, 22 * unit), title, fill=INK, font=font(20 * unit), anchor="lm")
    context = context_frames or people[0].context
    for i, moment in enumerate(moments):
        ink = PINK if moment < context else GENERATED
        place = (left + (i + 0.5) * cell[0], top - 13 * unit)
        draw.text(place, _time(moment, context, first.fps), fill=ink, font=font(15 * unit), anchor="mm")
        for row, group in enumerate(people):
            page.paste(paint(group, views[row][moment], moment), (left + i * cell[0], top + row * cell[1]))
    for row, (label, _) in enumerate(rows):
        middle = top + (row + 0.5) * cell[1]
        draw.multiline_text((12 * unit, middle), _broken(label), fill=INK, font=font(15 * unit), anchor="lm")
        if row:
            draw.line((0, top + row * cell[1], page.width, top + row * cell[1]), fill=(226, 229, 235))
    return _save(page, path)


def topview(
    scenes: Scenes,
    path: str | Path,
    *,
    context_frames: int,
    body: Posable | None = None,
    cell: Size = (420, 420),
    columns: int = 4,
    title: str | None = None,
) -> Path:
    """Write a PNG of everybody's way over the floor, seen from above, +x to the right and +z down.

    A wedge each second shows where the pelvis faces; a ring marks the start, a disc the end. All panels share one
    scale. Arguments as in `contact_sheet`; `columns` is the number of panels in a row.
    """
    rows = panels(scenes)
    body = body or default_body(rows[0][1])
    people = [cast(s, body, "skeleton", known_frames(s, context_frames)) for _, s in rows]
    columns = min(columns, len(rows))
    unit = cell[1] / 420
    top = round((40 if title else 0) * unit)
    page = Image.new("RGB", (columns * cell[0], top + -(-len(rows) // columns) * cell[1]), PAGE)
    spans = [c.joints[:, :, PELVIS, [0, 2]].reshape(-1, 2) for c in people]
    reach = max(1.5, max(float((span.max(0) - span.min(0)).max()) for span in spans) / 2 + 0.5)
    for i, ((label, scene), group) in enumerate(zip(rows, people, strict=True)):
        panel = _from_above(group, (spans[i].max(0) + spans[i].min(0)) / 2, reach, cell, scene.fps)
        ImageDraw.Draw(panel).text((14 * unit, 12 * unit), label, fill=INK, font=font(17 * unit))
        page.paste(panel, (i % columns * cell[0], top + i // columns * cell[1]))
    if title:
        ImageDraw.Draw(page).text((14 * unit, top / 2), title, fill=INK, font=font(20 * unit), anchor="lm")
    return _save(page, path)


def _from_above(people: Cast, centre: Array, reach: float, cell: Size, fps: float) -> Image.Image:
    scale = min(cell) / reach  # pixels a metre, at twice the size
    size = (2 * cell[0], 2 * cell[1])
    panel = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(panel)

    def pixels(ground: Array) -> Array:
        return (ground - centre) * scale + np.array(size) / 2

    step = TILE if reach < 4 else 2 * TILE
    for axis in range(2):
        for line in np.arange(np.floor((centre[axis] - 2 * reach) / step), (centre[axis] + 2 * reach) / step) * step:
            at = float((line - centre[axis]) * scale + size[axis] / 2)
            draw.line((at, 0, at, size[1]) if axis == 0 else (0, at, size[0], at), fill=(229, 233, 239), width=2)
    width = max(4, round(0.014 * min(size)))
    left = people.joints[:, :, L_HIP] - people.joints[:, :, R_HIP]
    facing = np.stack([-left[..., 2], left[..., 0]], axis=-1)
    facing = facing / np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-6)
    for p in range(people.joints.shape[1]):
        way = pixels(people.joints[:, p, PELVIS, :][:, [0, 2]])
        for t in range(len(way) - 1):
            colour = tuple(people.colours[t + 1, p].astype(int).tolist())
            draw.line((*way[t], *way[t + 1]), fill=colour, width=width)
            draw.ellipse((*(way[t + 1] - width / 2), *(way[t + 1] + width / 2)), fill=colour)
        for t in range(0, len(way), max(1, round(fps))):
            colour = tuple(people.colours[t, p].astype(int).tolist())
            ahead, aside = facing[t, p], np.array([-facing[t, p, 1], facing[t, p, 0]])
            wedge = [way[t] + 2.6 * width * ahead, way[t] + 1.1 * width * aside, way[t] - 1.1 * width * aside]
            draw.polygon([tuple(corner) for corner in wedge], fill=colour)
        for at, colour, filled in ((way[0], people.colours[0, p], False), (way[-1], people.colours[-1, p], True)):
            ink = tuple(colour.astype(int).tolist())
            box = (*(at - 1.2 * width), *(at + 1.2 * width))
            draw.ellipse(box, fill=ink if filled else PAGE, outline=ink, width=max(2, width // 2))
    panel = panel.reduce(2)
    draw = ImageDraw.Draw(panel)
    bar = scale / 2  # one metre
    right, low = cell[0] - 16, cell[1] - 16
    draw.line((right - bar, low, right, low), fill=PALE, width=2)
    draw.text((right - bar / 2, low - 4), "1 m", fill=PALE, font=font(0.032 * cell[1]), anchor="ms")
    return panel


def _time(frame: int, context_frames: int, fps: float) -> str:
    return f"{(frame - context_frames + 1) / fps:+.2f} s" if context_frames else f"{frame / fps:.2f} s"


def _broken(label: str, wide: int = 16) -> str:
    """A label in lines of at most `wide` letters, where its words allow."""
    lines: list[str] = [""]
    for word in label.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > wide:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


def _label_width(labels: list[str], size: float) -> float:
    lines = [line for label in labels for line in _broken(label).split("\n")]
    widest = max(font(size).getlength(line) for line in lines)
    return widest + 24 * size / 15 if widest else 0.0


def _save(page: Image.Image, path: str | Path) -> Path:
    path = Path(path)
    if path.suffix != ".png":
        raise ValueError(f"{path.name}: pictures are written as .png")
    path.parent.mkdir(parents=True, exist_ok=True)
    page.save(path)
    return path
