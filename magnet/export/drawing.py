"""Drawing of pictures: camera, floor, shadows, and polygons painted from far to near.

Arrays here are numpy, world metres, y up. Nothing is random.
"""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from magnet.body.joints import L_HIP, PELVIS, R_HIP

Array = NDArray[np.floating]
Size = tuple[int, int]
Colour = tuple[int, int, int]

Style = Literal["body", "light", "capsules", "skeleton"]
STYLES: tuple[Style, ...] = get_args(Style)
"""Looks of people; `light` is the body with a twentieth of its vertices."""
SMALLEST = 16
"""Pixels of a film's panel, at least."""


def require_size(size: Size) -> None:
    """Refuse a film's panel that nothing can be drawn in."""
    if size[0] % 2 or size[1] % 2:
        raise ValueError(f"size {size}: video needs even numbers of pixels")
    if min(size) < SMALLEST:
        raise ValueError(f"size {size}: expected at least {SMALLEST} pixels each way")


BACKGROUND: Colour = (250, 250, 252)
TILES: tuple[Colour, Colour] = ((236, 239, 244), (223, 228, 236))
SHADOW: Colour = (52, 58, 82)
INK: Colour = (46, 52, 64)
PALE: Colour = (150, 157, 170)

AGENTS: tuple[Colour, ...] = (
    (56, 128, 222),
    (240, 145, 30),
    (18, 158, 128),
    (116, 92, 70),
    (70, 178, 226),
    (80, 32, 192),
)
"""One colour per agent slot, distinguishable with common colour blindness; none is pink."""

CONTEXT: tuple[Colour, ...] = (
    (226, 62, 138),
    (248, 158, 198),
    (158, 30, 100),
    (252, 200, 222),
    (236, 112, 172),
    (190, 92, 140),
)
"""Pinks of known motion, one an agent slot (the paper's figures use pink for context)."""

OVERSAMPLING = 2
TILE = 0.5
HEAD_ROOM = 0.16  # metres around joints that a drawn body may fill


@dataclass(frozen=True)
class Camera:
    """The viewpoint; it follows the middle of the group and keeps everybody in the picture."""

    azimuth: float | None = None  # radians about the vertical, 0: from +z; None: where people hide each other least
    elevation: float = 0.30  # radians above the floor
    field: float = 0.55  # vertical angle of view, radians
    distance: float | None = None  # metres; None: as near as everybody fits, changing slowly
    calm: float = 0.7  # seconds over which the camera's way is smoothed


@dataclass(frozen=True)
class View:
    """A camera at one moment, for a picture of `size` pixels."""

    centre: Array  # (3,) world point in the middle of the picture
    axes: Array  # (3, 3) rows: right, up, away
    distance: float
    focal: float  # pixels
    size: Size

    def project(self, points: Array) -> tuple[Array, Array]:
        """World points (..., 3) to pixels (..., 2) and depth (...) in metres."""
        right, up, away = np.moveaxis((points - self.centre) @ self.axes.T, -1, 0)
        depth = away + self.distance
        scale = self.focal / np.maximum(depth, 1e-3)
        return np.stack([self.size[0] / 2 + right * scale, self.size[1] / 2 - up * scale], axis=-1), depth

    @property
    def eye(self) -> Array:
        return self.centre - self.distance * self.axes[2]

    @property
    def light(self) -> Array:
        """Unit vector towards the light: above, from the left, behind the onlooker."""
        direction = -0.50 * self.axes[0] + 0.85 * np.array([0.0, 1.0, 0.0]) - 0.42 * self.axes[2]
        return direction / np.linalg.norm(direction)


# -- the camera's way --------------------------------------------------------------------------


def plan_views(groups: list[Array], camera: Camera, size: Size, fps: float) -> list[list[View]]:
    """Views of recordings of the same length; those that start alike share side and scale, to be compared.

    groups: for each picture (T, M, 22, 3) joints of all who must be seen. size: pixels. -> for each group T views.
    """
    first = groups[0]
    if all(joints.shape == first.shape and np.abs(joints[0] - first[0]).max() < 0.1 for joints in groups):
        return _plan(groups, camera, size, fps)
    return [_plan([joints], camera, size, fps)[0] for joints in groups]


def _plan(groups: list[Array], camera: Camera, size: Size, fps: float) -> list[list[View]]:
    azimuth = _clearest_side(np.concatenate(groups)) if camera.azimuth is None else camera.azimuth
    axes = _axes(azimuth, camera.elevation)
    half = max(1, round(camera.calm * fps / 2))
    tan_up = np.tan(camera.field / 2)
    tangent = 0.86 * np.array([tan_up * size[0] / size[1], tan_up * 0.92])
    centres, needed = [], []
    for joints in groups:
        ground = (joints.min(axis=(1, 2)) + joints.max(axis=(1, 2))) / 2
        ground[:, 1] = 0.80
        for _ in range(2):
            ground = _window(ground, half).mean(axis=-1)
        away = (joints - ground[:, None, None]) @ axes.T
        room = (np.abs(away[..., :2]) + HEAD_ROOM) / tangent - away[..., 2:]
        centres.append(ground)
        needed.append(room.max(axis=(1, 2, 3)))
    distance = np.maximum.reduce(needed)
    # The mean over a window of the maxima over as wide a window is never below the value itself.
    distance = _window(_window(distance, half).max(axis=-1), half).mean(axis=-1)
    if camera.distance is not None:
        distance = np.full_like(distance, camera.distance)
    focal = size[1] / 2 / tan_up
    return [[View(c, axes, float(d), focal, size) for c, d in zip(way, distance, strict=True)] for way in centres]


def _axes(azimuth: float, elevation: float) -> Array:
    back = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )  # from the scene towards the eye
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    return np.stack([right, np.cross(back, right), -back])


def _window(series: Array, half: int) -> Array:
    """The 2 half + 1 values around each frame, ends repeated. (T, ...) -> (T, ..., 2 half + 1)"""
    edges = [(half, half)] + [(0, 0)] * (series.ndim - 1)
    return np.lib.stride_tricks.sliding_window_view(np.pad(series, edges, mode="edge"), 2 * half + 1, axis=0)


def _clearest_side(joints: Array) -> float:
    """Azimuth from which people stand side by side and show their faces rather than their backs. (T, P, 22, 3)"""
    pelvis = joints[:, :, PELVIS, [0, 2]]
    apart = pelvis[:, :, None] - pelvis[:, None, :]
    left = joints[:, :, L_HIP] - joints[:, :, R_HIP]
    facing = np.stack([-left[..., 2], left[..., 0]], axis=-1)  # (x, z) of left cross up
    facing = facing / np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-6)
    best, best_score = 0.0, -np.inf
    for azimuth in np.arange(36) * (2 * np.pi / 36):
        right = np.array([np.cos(azimuth), -np.sin(azimuth)])
        back = np.array([np.sin(azimuth), np.cos(azimuth)])
        beside = np.abs(apart @ right) / (np.linalg.norm(apart, axis=-1) + 0.3)
        toward = facing @ back
        # Straight faces and straight profiles read worse than something between.
        score = 1.4 * beside.mean() + 0.3 * toward.mean() - 0.25 * np.abs(np.abs(toward) - 0.6).mean()
        if score > best_score + 1e-9:
            best, best_score = float(azimuth), score
    return best


# -- polygons ----------------------------------------------------------------------------------


class Canvas:
    """Collects polygons with their depths and paints them from far to near, at twice the size for smooth edges."""

    def __init__(self, view: View, background: Colour = BACKGROUND) -> None:
        self.view = view  # its size is the enlarged one
        self.image = Image.new("RGB", view.size, background)
        self._draw = ImageDraw.Draw(self.image)
        self._outlines: list[list[float]] = []
        self._inks: list[NDArray[np.int64]] = []
        self._depths: list[Array] = []

    @staticmethod
    def of(view: View) -> Canvas:
        """A canvas for a picture of the view's size, oversampled."""
        width, height = view.size
        large = (width * OVERSAMPLING, height * OVERSAMPLING)
        return Canvas(View(view.centre, view.axes, view.distance, view.focal * OVERSAMPLING, large))

    def add(self, outlines: Array, colours: Array, depths: Array) -> None:
        """Keep polygons for `paint`. (F, V, 2) pixels, (F, 3) 0 to 255, (F,) metres"""
        self._outlines.extend(outlines.reshape(len(outlines), -1).tolist())
        self._inks.append(packed(colours))
        self._depths.append(depths)

    def paint(self) -> None:
        """Draw what was kept, far ones first, and forget it."""
        if not self._depths:
            return
        inks = np.concatenate(self._inks).tolist()
        polygon = self._draw.polygon
        for i in np.argsort(-np.concatenate(self._depths), kind="stable").tolist():
            polygon(self._outlines[i], fill=inks[i])
        self._outlines, self._inks, self._depths = [], [], []

    def floor(self) -> None:
        """A chequered floor of half-metre tiles that fades out around the group."""
        view = self.view
        reach = max(3.0, 0.75 * view.distance)
        step = TILE if reach < 7 else 2 * TILE
        low = np.floor((view.centre[[0, 2]] - reach) / step).astype(int)
        count = int(np.ceil(2 * reach / step)) + 1
        i, k = (low[:, None, None] + np.indices((count, count))).reshape(2, -1)
        corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        ground = (np.stack([i, k], axis=-1)[:, None] + corner) * step  # (tiles, 4, 2)
        points = np.stack([ground[..., 0], np.zeros(ground.shape[:-1]), ground[..., 1]], axis=-1)
        pixels, depth = view.project(points)
        away = np.linalg.norm(ground.mean(axis=1) - view.centre[[0, 2]], axis=-1) / reach
        fade = np.clip(1.15 - away**1.6, 0.0, 1.0)[:, None]
        colours = fade * np.array(TILES)[(i + k) % 2] + (1 - fade) * np.array(BACKGROUND)
        seen = (depth.min(axis=-1) > 0.3) & (fade[:, 0] > 0.01)
        self.add(pixels[seen], colours[seen], depth[seen].mean(axis=-1))
        self.paint()

    def shadows(self, start: Array, end: Array, radius: Array, feet: Array) -> None:
        """Soft shadows of limbs, and darker ones where feet touch the floor.

        start, end (M, 3), radius (M,) metres: limbs; feet (F, 2, 3): heel and toe of each foot.
        """
        view = self.view
        light = view.light
        small = View(view.centre, view.axes, view.distance, view.focal / 4, (view.size[0] // 4, view.size[1] // 4))

        def cast(ends: Array, radius: Array, inks: Array, blur: float) -> NDArray[np.uint8]:
            """Blurred strokes between both ends on the floor (M, 2, 3). radius (M, 1), inks (M,)"""
            image = Image.new("L", small.size, 0)
            draw = ImageDraw.Draw(image)
            pixels, depth = small.project(ends)
            widths = radius * small.focal / np.maximum(depth, 0.3)
            outlines = strokes(pixels[:, 0], pixels[:, 1], widths[:, 0], widths[:, 1], squash=0.6)
            for outline, ink in zip(outlines.reshape(len(ends), -1).tolist(), inks.astype(int).tolist(), strict=True):
                draw.polygon(outline, fill=ink)
            return np.asarray(image.filter(ImageFilter.BoxBlur(blur * small.size[1] / 240)))

        ends = np.stack([start, end], axis=1)
        limbs = cast(ends - light * (ends[..., 1:2] / light[1]), radius[:, None], np.full(len(ends), 66), 1.6)
        near = np.clip(1.0 - (feet[..., 1].min(axis=-1) - 0.03) / 0.15, 0.0, 1.0) * 125
        touch = cast(feet * np.array([1.0, 0.0, 1.0]), np.full((len(feet), 1), 0.055), near, 0.9)
        mask = Image.fromarray(np.maximum(limbs, touch))
        box = mask.getbbox()
        if box is None:
            return
        large = (box[0] * 4, box[1] * 4, box[2] * 4, box[3] * 4)
        soft = mask.crop(box).resize((large[2] - large[0], large[3] - large[1]), Image.Resampling.BILINEAR)
        self.image.paste(SHADOW, large, soft)

    def trail(self, ground: Array, colours: Array, width: float = 0.018) -> None:
        """A line on the floor, each piece in its own colour. (M, 3) points, (M - 1, 3) colours"""
        if len(ground) < 2:
            return
        pixels, depth = self.view.project(ground * np.array([1.0, 0.0, 1.0]))
        widths = width * self.view.focal / np.maximum(depth, 0.3)
        later_on_top = -np.arange(len(colours), dtype=float)
        self.add(strokes(pixels[:-1], pixels[1:], widths[:-1], widths[1:]), colours, later_on_top)
        self.paint()

    def finished(self) -> Image.Image:
        """The picture at its true size."""
        self.paint()
        return self.image.reduce(OVERSAMPLING)


def packed(colours: Array) -> NDArray[np.int64]:
    """Colours as the single integers that Pillow takes fastest. (F, 3) 0 to 255 -> (F,)"""
    red, green, blue = np.moveaxis(np.clip(colours, 0, 255).astype(np.int64), -1, 0)
    return red | green << 8 | blue << 16


def strokes(
    start: Array, end: Array, from_radius: Array, to_radius: Array, squash: float = 1.0, corners: int = 7
) -> Array:
    """Outlines of thick strokes with round ends: the hull of two circles. (M, 2) x 2, (M,) x 2 -> (M, 2 corners, 2)"""
    along = end - start
    length = np.maximum(np.linalg.norm(along, axis=-1), 1e-6)
    heading = np.arctan2(along[:, 1], along[:, 0])
    tangent = np.arccos(np.clip((from_radius - to_radius) / length, -1.0, 1.0))[:, None]
    turn = np.linspace(0.0, 1.0, corners)
    far = heading[:, None] - tangent + 2 * tangent * turn
    near = heading[:, None] + tangent + 2 * (np.pi - tangent) * turn
    flat = np.array([1.0, squash])

    def arc(centre: Array, radius: Array, angle: Array) -> Array:
        return centre[:, None] + radius[:, None, None] * flat * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    return np.concatenate([arc(end, to_radius, far), arc(start, from_radius, near)], axis=1)


SPELLED = {
    **{"ß": "ss", "æ": "ae", "Æ": "AE", "œ": "oe", "Œ": "OE", "ø": "o", "Ø": "O", "ł": "l", "Ł": "L"},
    **{"đ": "d", "Đ": "D", "ð": "d", "Ð": "D", "þ": "th", "Þ": "Th", "\u0131": "i", "ħ": "h", "Ħ": "H"},
    **dict.fromkeys("\u2010\u2011\u2012\u2013—\u2015\u2212", "-"),
    **{"•": "·", "\u00d7": "x", "÷": "/", "€": "EUR"},
}
HELD = frozenset("©«°±\u00b4·»\u2018\u2019“”…\u2039\u203a\u2044")
"""Characters beyond ASCII that `font` has."""


def drawable(text: str) -> str:
    """Text in characters that `font` has: letters without their accents, plain dashes, `?` for what is left."""
    spelled = "".join(SPELLED.get(letter, letter) for letter in text)
    parts = (part if part in HELD else unicodedata.normalize("NFKD", part) for part in spelled)
    plain = (part for part in "".join(parts) if not unicodedata.combining(part))
    return "".join(part if part.isascii() or part in HELD else SPELLED.get(part, "?") for part in plain)


def font(pixels: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font, so that pictures look the same everywhere. It has no accents: draw `drawable` text."""
    return ImageFont.load_default(size=pixels)
