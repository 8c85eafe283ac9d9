"""A body's mesh with a twentieth of its vertices, for crowds: a choice of them, and new triangles between them.

Because vertices are chosen and not made, shapes and skinning weights of the whole body hold for the light one.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnet.body import Body

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

VERTICES = 700
"""Vertices of a light body."""
BENDS = 0.02
"""Metres that a vertex counts as away from one that follows wholly other bones."""
GREED = 0.25
"""Share of the edges, the cheapest, that one round may collapse."""
TURN = 0.3
"""Smallest cosine between a triangle's normals before and after a collapse."""


@dataclass(frozen=True)
class Light:
    """Which vertices of a body stay, and the triangles between these."""

    keep: Ints  # (V',), rising
    faces: Ints  # (F', 3) into `keep`


_made: dict[tuple[bytes, int], Light] = {}


def light(body: Body, vertices: int = VERTICES) -> Light:
    """A body's mesh collapsed to about so many vertices; made once for all copies of a body."""
    points = body.v_template.detach().cpu().double().numpy()
    weights = body.weights.detach().cpu().double().numpy()
    digest = hashlib.blake2b(points.tobytes())
    digest.update(weights.tobytes())
    key = digest.digest(), vertices
    if key not in _made:
        _made[key] = simplified(points, body.faces.cpu().numpy().astype(np.int64), weights, vertices)
    return _made[key]


def simplified(points: Floats, faces: Ints, weights: Floats, vertices: int) -> Light:
    """Collapse edges where that moves the surface least, until so many vertices are left.

    A collapse takes a vertex into a neighbour. Its cost is the sum of squared distances of the neighbour from the
    planes of all triangles that have gone into either (Garland and Heckbert 1997, with the neighbour as the place),
    and what the skinning weights differ. Many collapses that do not touch each other make one round. Vertices at holes
    stay. points: (V, 3) metres; faces: (F, 3); weights: (V, 22).
    """
    planes, area = _planes(points, faces)
    quadric = np.zeros((len(points), 4, 4))  # squared distance from the planes of a vertex's triangles
    reach = np.zeros(len(points))
    for corner in range(3):
        np.add.at(quadric, faces[:, corner], planes)
        np.add.at(reach, faces[:, corner], area)
    pinned = np.zeros(len(points), dtype=bool)
    pinned[_border(faces, len(points))] = True
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    while (left := len(np.unique(faces))) > vertices:
        linked = _linked(faces, len(points))
        low, high = linked // len(points), linked % len(points)
        source, goal = np.concatenate([low, high]), np.concatenate([high, low])  # each edge in both directions
        cost = np.einsum("ei,eij,ej->e", homogeneous[goal], quadric[source] + quadric[goal], homogeneous[goal])
        apart = np.abs(weights[source] - weights[goal]).sum(axis=1) / 2
        cost = np.maximum(cost, 0.0) + reach[source] * (BENDS * apart) ** 2
        cost[pinned[source]] = np.inf
        cheap = np.argsort(cost, kind="stable")[: max(int(GREED * len(cost)), 8)]
        cheap = cheap[np.isfinite(cost[cheap])]
        source, goal = source[cheap], goal[cheap]
        sound = _sound(points, faces, linked, source, goal)
        chosen = _apart(faces, source[sound], goal[sound], len(points))[: left - vertices]
        if not len(chosen):
            break
        gone, into = source[sound][chosen], goal[sound][chosen]
        np.add.at(quadric, into, quadric[gone])
        np.add.at(reach, into, reach[gone])
        moved = np.arange(len(points))
        moved[gone] = into
        faces = moved[faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    keep, numbers = np.unique(faces, return_inverse=True)
    return Light(keep, numbers.reshape(-1, 3))


def _planes(points: Floats, faces: Ints) -> tuple[Floats, Floats]:
    """Squared distance from each triangle's plane as a form, times its area: (F, 4, 4); and areas (F,)"""
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    double = np.linalg.norm(normal, axis=1)
    normal = normal / np.maximum(double, 1e-12)[:, None]
    plane = np.concatenate([normal, -(normal * a).sum(axis=1, keepdims=True)], axis=1)
    return double[:, None, None] / 2 * plane[:, :, None] * plane[:, None, :], double / 2


def _edges(faces: Ints) -> Ints:
    """(3 F, 2), as they run round each triangle"""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _linked(faces: Ints, vertices: int) -> Ints:
    """Every edge once, as smaller end * V + greater end, rising."""
    ends = np.sort(_edges(faces), axis=1)
    return np.unique(ends[:, 0] * vertices + ends[:, 1])


def _border(faces: Ints, vertices: int) -> Ints:
    """Vertices of edges that do not lie between two triangles."""
    ends = np.sort(_edges(faces), axis=1)
    key, count = np.unique(ends[:, 0] * vertices + ends[:, 1], return_counts=True)
    odd = key[count != 2]
    return np.unique(np.concatenate([odd // vertices, odd % vertices]))


def _sound(points: Floats, faces: Ints, linked: Ints, source: Ints, goal: Ints) -> Mask:
    """Which collapses neither fold the surface over nor pinch it. (E,)"""
    V = len(points)
    corner = np.argsort(faces.ravel(), kind="stable")  # corners sorted by vertex
    begin = np.concatenate([[0], np.cumsum(np.bincount(faces.ravel(), minlength=V))])
    touched = begin[source + 1] - begin[source]
    number = np.repeat(np.arange(len(source)), touched)  # the collapse that each touched corner belongs to
    step = np.arange(len(number)) - np.repeat(np.cumsum(touched) - touched, touched)
    at = corner[begin[source][number] + step]
    face, k = at // 3, at % 3
    here, after, last = faces[face, k], faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
    to = goal[number]
    dies = (after == to) | (last == to)
    old = np.cross(points[after] - points[here], points[last] - points[here])
    new = np.cross(points[after] - points[to], points[last] - points[to])
    straight = (old * new).sum(axis=1) > TURN * np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1)
    sound = np.ones(len(source), dtype=bool)
    sound[number[~dies & ~straight]] = False
    # A closed surface stays one where the two ends of the edge have exactly two neighbours in common.

    def joined(a: Ints, b: Ints) -> Mask:
        key = np.minimum(a, b) * V + np.maximum(a, b)
        place = np.minimum(np.searchsorted(linked, key), len(linked) - 1)
        return linked[place] == key

    common = np.bincount(number, joined(after, to) & (after != to), minlength=len(source))
    return sound & (common == 2)


def _apart(faces: Ints, source: Ints, goal: Ints, vertices: int) -> Ints:
    """Collapses, cheapest first, whose triangles no cheaper one touches. Numbers of these, rising"""
    rank = np.arange(len(source))
    best = np.full(vertices, len(source))  # cheapest collapse at each vertex
    np.minimum.at(best, source, rank)
    np.minimum.at(best, goal, rank)
    touched = best[faces].min(axis=1)  # cheapest at each triangle
    around = np.full(vertices, len(source))
    for corner in range(3):
        np.minimum.at(around, faces[:, corner], touched)
    return rank[(around[source] == rank) & (around[goal] == rank)]
