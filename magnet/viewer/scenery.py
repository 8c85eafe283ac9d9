"""Floor, trails, shadows and marks around the people in viser's scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from magnet.body.joints import PELVIS, TOES
from magnet.export.drawing import SHADOW, Array
from magnet.export.page.marks import BALL, DISC, HAND, MOST, depth_colours, penetrations, standing, touching
from magnet.export.page.palette import FLOOR, LINES, SLIDES, STANDS, TOUCHES, Colours, for_batches
from magnet.export.page.rig import Index, capsule

AWAY, NO_SIZE = -50.0, 1e-6
"""Height in metres and size of unused marks, which keep them invisible."""


class Floor:
    """A tiled floor that follows people in whole tiles."""

    def __init__(self, server: Any, parent: str) -> None:
        self.grid = server.scene.add_grid(
            f"{parent}/floor",
            width=40.0,
            height=40.0,
            plane="xz",
            cell_size=0.5,
            cell_color=LINES,
            cell_thickness=0.8,
            section_size=2.0,
            section_color=(190, 197, 210),
            section_thickness=1.0,
            fade_distance=30.0,
            fade_from="camera",
            plane_color=FLOOR,
            plane_opacity=0.9,
            shadow_opacity=0.32,
        )

    def under(self, centre: Array) -> None:
        """centre: (3,) middle of the group."""
        x, z = (float(round(c / 2.0) * 2.0) for c in (centre[0], centre[2]))
        self.grid.position = (x, 0.0, z)


class Trails:
    """Paths of all pelvises on the floor over the last seconds, as one set of lines."""

    def __init__(self, server: Any, name: str, colours: Colours, pieces: int = 24) -> None:
        self.pieces = pieces
        P = len(colours)
        age = np.linspace(0.0, 0.75, pieces + 1)[:, None]
        shade = 225 * (1 - age) + age * colours[:, None]  # (P, pieces + 1, 3), the last one is now
        ends = np.stack([shade[:, :-1], shade[:, 1:]], axis=2).reshape(-1, 2, 3)
        self.lines = server.scene.add_line_segments(
            name, np.zeros((P * pieces, 2, 3)), ends.round().astype(np.uint8), thickness=0.022
        )

    def show(self, ways: Array) -> None:
        """ways: (pieces + 1, P, 3) points of the paths, the last one now."""
        ground = ways.transpose(1, 0, 2) * np.array([1.0, 0.0, 1.0]) + np.array([0.0, 0.006, 0.0])
        pairs = np.stack([ground[:, :-1], ground[:, 1:]], axis=2)
        self.lines.points = pairs.reshape(-1, 2, 3).astype(np.float32)

    def remove(self) -> None:
        self.lines.remove()


class Spots:
    """A fixed number of equal marks, of which the needed ones are shown."""

    def __init__(self, server: Any, name: str, mesh: tuple[Array, Index], most: int, opacity: float | None) -> None:
        self.most, self.shown = most, 0
        upright = np.tile(np.float32([1, 0, 0, 0]), (most, 1))  # type: ignore[arg-type]
        self.batch = server.scene.add_batched_meshes_simple(
            name,
            *mesh,
            upright,
            self._away(),
            batched_scales=np.full(most, NO_SIZE, dtype=np.float32),
            batched_colors=np.zeros((most, 3), dtype=np.uint8),
            opacity=opacity,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def show(self, places: Array, colours: Array, sizes: Array | float = 1.0) -> None:
        """places (M, 3), colours (M, 3) or (3,), sizes (M,) times the mesh's own; more than `most` are left out."""
        M = min(len(places), self.most)
        if M == self.shown == 0:
            return
        at = self._away()
        at[:M] = places[:M]
        tint = np.zeros((self.most, 3), dtype=np.uint8)
        tint[:M] = np.broadcast_to(colours, (len(places), 3))[:M]
        scale = np.full(self.most, NO_SIZE, dtype=np.float32)
        scale[:M] = np.broadcast_to(sizes, (len(places),))[:M]
        self.batch.batched_positions, self.batch.batched_colors, self.batch.batched_scales = (
            at,
            for_batches(tint),
            scale,
        )
        self.shown = M

    def _away(self) -> Array:
        return np.tile(np.array([0, AWAY, 0], dtype=np.float32), (self.most, 1))

    def remove(self) -> None:
        self.batch.remove()


class Shades:
    """Dark discs under pelvis and feet, in place of shadows."""

    def __init__(self, server: Any, name: str, people: int) -> None:
        self.spots = Spots(server, name, disc(1.0), 3 * people, 0.16)

    def show(self, joints: Array) -> None:
        """joints: (P, 22, 3)"""
        ground = joints[:, [PELVIS, *TOES]] * np.array([1.0, 0.0, 1.0]) + np.array([0.0, 0.004, 0.0])
        low = np.clip(1.0 - joints[:, TOES, 1] / 0.5, 0.0, 1.0)
        sizes = np.concatenate([np.full((len(joints), 1), 0.26), 0.05 + 0.09 * low], axis=1)
        self.spots.show(ground.reshape(-1, 3), np.array(SHADOW), sizes.ravel())

    def clear(self) -> None:
        self.spots.show(np.zeros((0, 3)), np.zeros(3))


class Marks:
    """Discs under standing feet, balls where hands touch and where bodies overlap."""

    def __init__(self, server: Any, name: str, people: int, fps: float) -> None:
        self.fps = fps
        self.feet = Spots(server, f"{name}/feet", disc(DISC), 2 * people, 0.9)
        self.hands = Spots(server, f"{name}/hands", ball(HAND), 2 * people, 0.6)
        self.hits = Spots(server, f"{name}/hits", ball(1.0), MOST, 0.75)

    def contacts(self, before: Array, now: Array) -> tuple[int, int]:
        """Joints of the frame before and of this one, (P, 22, 3). -> feet that stand, hands that touch"""
        stands, slides = (each[0] for each in standing(np.stack([before, now]), self.fps))
        feet = now[:, TOES][stands] * np.array([1.0, 0.0, 1.0]) + np.array([0.0, 0.008, 0.0])
        colours = np.where(slides[stands][:, None], np.array(SLIDES), np.array(STANDS))
        self.feet.show(feet, colours)
        _, hands = touching(now[None])
        self.hands.show(hands, np.array(TOUCHES))
        return len(feet), len(hands)

    def collisions(self, now: Array) -> float:
        """Joints (P, 22, 3). -> metres that the deepest collision is deep"""
        _, places, radii, depths = penetrations(now[None])
        deepest = np.argsort(-depths)
        self.hits.show(places[deepest], depth_colours(depths[deepest]), radii[deepest] + BALL)
        return float(depths.max(initial=0.0))

    def clear(self, contacts: bool, collisions: bool) -> None:
        """Take marks away."""
        nothing = np.zeros((0, 3))
        for spots in ([self.feet, self.hands] if contacts else []) + ([self.hits] if collisions else []):
            spots.show(nothing, np.zeros(3))

    def remove(self) -> None:
        for spots in (self.feet, self.hands, self.hits):
            spots.remove()


def disc(radius: float, sectors: int = 20) -> tuple[Array, Index]:
    """A flat disc that faces up: vertices, faces."""
    angle = np.arange(sectors) * (2 * np.pi / sectors)
    rim = radius * np.stack([np.sin(angle), np.zeros(sectors), np.cos(angle)], axis=1)
    here = np.arange(sectors)
    faces = np.stack([np.full(sectors, sectors), here, (here + 1) % sectors], axis=1)
    return np.concatenate([rim, np.zeros((1, 3))]), faces


def ball(radius: float, rings: int = 8, sectors: int = 14) -> tuple[Array, Index]:
    """A ball: vertices, faces."""
    points, faces, _ = capsule(0.0, radius, radius, sectors, rings // 2)
    return points, faces
