"""A light body is the body with fewer vertices: closed, near to the whole one, bent by the same bones."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from magnet.body import Body
from magnet.export.page.light import VERTICES, light, simplified
from magnet.export.page.rig import CROWD, bend, bone_poses, first_style, rigs
from magnet.motion.scene import Scene

Floats = NDArray[np.float64]


def from_surface(points: Floats, vertices: Floats, faces: NDArray[np.int64], candidates: int = 60) -> Floats:
    """Distance of points from a surface, by trimesh. (N, 3) -> (N,)"""
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    from scipy.spatial import cKDTree

    corners = vertices[faces]
    _, near = cKDTree(corners.mean(axis=1)).query(points, k=candidates)
    place = trimesh.triangles.closest_point(corners[near.ravel()], np.repeat(points, candidates, axis=0))
    return np.linalg.norm(place.reshape(len(points), candidates, 3) - points[:, None], axis=-1).min(axis=1)


def edges(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges once each (E, 2), and how many triangles have them (E,)."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(ends, axis=0, return_counts=True)


def test_the_light_body_is_closed_and_has_the_vertices_it_promises(body: Body) -> None:
    few = light(body)
    assert len(few.keep) == VERTICES and few.faces.max() == VERTICES - 1
    ends, count = edges(few.faces)
    assert (count == 2).all()
    whole, _ = edges(body.faces.numpy())
    assert len(few.keep) - len(ends) + len(few.faces) == len(body.v_template) - len(whole) + len(body.faces)
    assert light(body) is few  # found once


@pytest.mark.parametrize("style_betas", [0.0, 1.5])
def test_the_body_lies_within_millimetres_of_its_light_one_in_any_pose(style_betas, duet: Scene, body: Body) -> None:
    scene = duet.replace(betas=torch.full_like(duet.betas, style_betas))
    turns, places = bone_poses(body, scene)
    whole, few = rigs(body, scene.betas[0])[1], rigs(body, scene.betas[0], "light")[1]
    some = np.random.default_rng(1).choice(len(whole.skin.vertices), 1500, replace=False)
    away = from_surface(
        bend(whole, turns[11, 1], places[11, 1])[some], bend(few, turns[11, 1], places[11, 1]), few.skin.faces
    )
    assert away.mean() < 0.004 and np.quantile(away, 0.95) < 0.012


def test_a_ball_keeps_its_size_and_the_same_input_gives_the_same_mesh() -> None:
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    ball = trimesh.creation.icosphere(subdivisions=4)
    points, faces = np.asarray(ball.vertices, dtype=np.float64), np.asarray(ball.faces, dtype=np.int64)
    few = simplified(points, faces, np.ones((len(points), 22)) / 22, 200)
    again = simplified(points.copy(), faces.copy(), np.ones((len(points), 22)) / 22, 200)
    assert (few.faces == again.faces).all() and (few.keep == again.keep).all()
    mesh = trimesh.Trimesh(points[few.keep], few.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(ball.volume, rel=0.06)


def test_vertices_at_a_hole_stay() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(12.0), np.arange(12.0), indexing="ij"))
    points = np.stack([x, y, np.zeros_like(x)], axis=1)
    here = np.array([12 * i + k for i in range(11) for k in range(11)])
    faces = np.concatenate([np.stack([here, here + 12, here + 13], 1), np.stack([here, here + 13, here + 1], 1)])
    few = simplified(points, faces, np.ones((144, 22)) / 22, 10)
    rim = (x % 11 == 0) | (y % 11 == 0)
    assert set(np.nonzero(rim)[0]) <= set(few.keep.tolist()) and len(few.keep) < 60
    corners = points[few.keep][few.faces]
    assert np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2].sum() == pytest.approx(2 * 121)


def test_crowds_begin_light() -> None:
    assert first_style(CROWD) == "body" and first_style(CROWD + 1) == "light"
