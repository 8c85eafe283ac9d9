"""People as polygons: stick figures, mannequins of tapered capsules, and skinned meshes."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from magnet.export.drawing import BACKGROUND, Array, Canvas, View, strokes
from magnet.export.limbs import CAPSULES, L_HEEL, L_TOE, R_HEEL, R_TOE, SIDE_TONE, STICKS, extended, limbs, turn_to


def add_shadows(canvas: Canvas, joints: Array) -> None:
    """Shadows of everybody on the floor. (P, 22, 3)"""
    start, end, radii = limbs(joints, CAPSULES)
    points = extended(joints)
    feet = np.stack([points[:, [L_HEEL, R_HEEL]], points[:, [L_TOE, R_TOE]]], axis=2).reshape(-1, 2, 3)
    canvas.shadows(start.reshape(-1, 3), end.reshape(-1, 3), radii.mean(axis=-1).ravel(), feet)


def add_ghosts(canvas: Canvas, joints: Array, strength: float = 0.34) -> None:
    """Pale stick figures behind everybody. (P, 22, 3)"""
    p, q, widths, depth = _sticks(canvas.view, joints)
    colour = (1 - strength) * np.array(BACKGROUND) + strength * np.array([70.0, 76.0, 90.0])
    canvas.add(strokes(p, q, *(0.75 * widths)), np.broadcast_to(colour, (len(p), 3)), depth)
    canvas.paint()


def add_sticks(canvas: Canvas, joints: Array, colours: Array) -> None:
    """Stick figures: a dark edge, the limb, and a light streak where the light falls. (P, 22, 3), (P, 3)"""
    p, q, widths, depth = _sticks(canvas.view, joints)
    tone = SIDE_TONE[[limb[4] for limb in STICKS]]
    fill = (colours[:, None] * tone[:, None]).reshape(-1, 3)
    edge = 0.009 * canvas.view.focal / canvas.view.distance
    # An edge lies a little behind its limb, so that limbs of one body flow into each other.
    canvas.add(strokes(p, q, *(widths + edge)), 0.45 * fill + 8, depth + 0.07)
    canvas.add(strokes(p, q, *widths), fill, depth)
    shift = widths.mean(axis=0)[:, None] * np.array([-0.22, -0.22])
    canvas.add(strokes(p + shift, q + shift, *(0.42 * widths)), fill + 0.33 * (255 - fill), depth - 0.001)


def _sticks(view: View, joints: Array) -> tuple[Array, Array, Array, Array]:
    """Both ends (M, 2) and half widths (2, M) of all sticks in pixels, and their depths (M,)."""
    start, end, radii = limbs(joints, STICKS)
    (p, near), (q, far) = view.project(start), view.project(end)
    widths = np.stack([r * view.focal / np.maximum(d, 0.3) for r, d in ((radii[..., 0], near), (radii[..., 1], far))])
    return p.reshape(-1, 2), q.reshape(-1, 2), widths.reshape(2, -1), ((near + far) / 2).ravel()


@cache
def _capsule_mesh(rings: int = 4, between: int = 3, sectors: int = 16) -> tuple[Array, Array, NDArray[np.int64]]:
    """Unit directions (V, 3) of a capsule's surface, how far along its line each stands (V,), and quads (Q, 4)."""
    # Rings along the straight part keep faces small, which sorting by depth needs where limbs meet.
    latitude = np.concatenate([np.linspace(-np.pi / 2, 0, rings), np.zeros(between), np.linspace(0, np.pi / 2, rings)])
    along = np.concatenate([np.zeros(rings), np.arange(1, between + 1) / (between + 1), np.ones(rings)])
    longitude = np.arange(sectors) * (2 * np.pi / sectors)
    flat = np.cos(latitude)[:, None]
    up = np.broadcast_to(np.sin(latitude)[:, None], (len(latitude), sectors))
    directions = np.stack([flat * np.cos(longitude), flat * np.sin(longitude), up], axis=-1)
    ring, sector = (x.ravel() for x in np.meshgrid(np.arange(len(latitude) - 1), np.arange(sectors), indexing="ij"))
    here, after = ring * sectors, (sector + 1) % sectors
    quads = np.stack([here + sector, here + after, here + sectors + after, here + sectors + sector], axis=-1)
    return directions.reshape(-1, 3), np.repeat(along, sectors), quads


def add_capsules(canvas: Canvas, joints: Array, colours: Array) -> None:
    """Mannequins of tapered capsules, shaded round. (P, 22, 3), (P, 3)"""
    start, end, radii = limbs(joints, CAPSULES)
    directions, fraction, quads = _capsule_mesh()
    along = end - start
    normals = directions @ turn_to(along).swapaxes(-1, -2)  # (P, M, V, 3)
    sizes = radii[..., :1] + fraction * (radii[..., 1:] - radii[..., :1])
    surface = start[:, :, None] + fraction[:, None] * along[:, :, None] + sizes[..., None] * normals
    tone = SIDE_TONE[[limb[4] for limb in CAPSULES]] ** 0.7
    tint = (colours[:, None] * tone[:, None])[:, :, None]
    _add_shaded(canvas, surface, normals, quads, tint)


def add_mesh(canvas: Canvas, vertices: Array, faces: NDArray[np.integer], colours: Array) -> None:
    """Skinned bodies, shaded by vertex normals. (P, V, 3), (F, 3), (P, 3)"""
    corners = vertices[:, faces]  # (P, F, 3, 3)
    area = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    V = vertices.shape[1]
    normals = np.zeros_like(vertices)
    for person, axis, corner in np.ndindex(len(vertices), 3, 3):
        normals[person, :, axis] += np.bincount(faces[:, corner], area[person, :, axis], minlength=V)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    if len(faces) < 8000:
        corners, shading = bulged(corners, normals[:, faces])
        vertices, normals = corners.reshape(len(vertices), -1, 3), shading.reshape(len(vertices), -1, 3)
        faces = np.arange(vertices.shape[1]).reshape(-1, 3)
    _add_shaded(canvas, vertices, normals, faces, colours[:, None])


def bulged(corners: Array, normals: Array, bulge: float = 0.7) -> tuple[Array, Array]:
    """Each triangle as four, new points near the tangent planes of the old: Phong tessellation. (..., F, 3, 3) x 2"""
    after, after_normal = np.roll(corners, -1, axis=-2), np.roll(normals, -1, axis=-2)
    middle = (corners + after) / 2

    def onto(point: Array, normal: Array) -> Array:
        return middle - ((middle - point) * normal).sum(-1, keepdims=True) * normal

    middle = (1 - bulge) * middle + bulge * (onto(corners, normals) + onto(after, after_normal)) / 2
    turned = normals + after_normal
    turned = turned / np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-12)

    def split(old: Array, new: Array) -> Array:
        a, b, c = np.moveaxis(old, -2, 0)
        ab, bc, ca = np.moveaxis(new, -2, 0)
        small = [np.stack(t, axis=-2) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        return np.concatenate(small, axis=-3)

    return split(corners, middle), split(normals, turned)


def _add_shaded(canvas: Canvas, points: Array, normals: Array, faces: NDArray[np.integer], tint: Array) -> None:
    """Shade the faces that face the camera, and keep them. (..., V, 3) x 2, (F, corners), tint (..., 1, 3)"""
    view = canvas.view
    pixels, depth = view.project(points)
    a, b, c = (pixels[..., faces[:, corner], :] for corner in (0, 1, -1))
    first, last = b - a, c - a
    front = first[..., 0] * last[..., 1] - first[..., 1] * last[..., 0] < 0  # pixel rows run downwards
    which = np.nonzero(front)
    corners = (*(index[:, None] for index in which[:-1]), faces[which[-1]])
    normal = normals[corners].mean(axis=-2)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    colours = lit(normal, np.broadcast_to(tint, (*front.shape, 3))[which], view)
    canvas.add(_grown(pixels[corners]), colours, depth[corners].mean(axis=-1))


def _grown(pixels: Array, by: float = 0.35) -> Array:
    """Polygons a fraction of a pixel larger, so that no floor shines through between neighbours. (F, V, 2)"""
    offset = pixels - pixels.mean(axis=1, keepdims=True)
    return pixels + by * offset / np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-6)


def lit(normals: Array, tint: Array, view: View) -> Array:
    """Colours of matt surfaces under a soft light with a bright sky and a faint gloss. (F, 3), (F, 3) -> (F, 3)"""
    toward = normals @ view.light
    diffuse = np.clip(0.30 + 0.70 * toward, 0.0, None)
    sky = 0.5 + 0.5 * normals[:, 1]
    rim = np.clip(1.0 + normals @ view.axes[2], 0.0, 1.0) ** 3
    shade = (0.38 + 0.66 * diffuse + 0.14 * sky - 0.14 * rim)[:, None]
    # Where it is brighter than its own colour a surface turns paler, not only more saturated.
    pale = np.clip(shade - 0.92, 0.0, 0.5) * 0.9 + 0.16 * np.clip(toward, 0.0, None)[:, None] ** 16
    return tint * np.minimum(shade, 1.0) * (1 - pale) + 255 * pale
