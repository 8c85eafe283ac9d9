"""Which axis points up where a world was turned after the rest pose, as that of AMASS on SMPL's skeleton."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from magnet.body import Body
from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.export import load_rigs
from magnet.export.rig import UP
from tests.export import strangers

FRAMES = 24


def stander(body: Body, path: Path, aside: float, walks: float = 0.0, floor: float = 0.0) -> Path:
    """Somebody who stands along z, the rest pose along y: so far from the origin along y, and walks along it or not."""
    rest = body.rest_joints(body.J_shapedirs.new_zeros(10)).double().numpy()
    world = np.broadcast_to(UP["z"].T, (FRAMES, 22, 3, 3))
    root = np.tile([0.0, aside, floor - rest[:, 1].min() + rest[0, 1]], (FRAMES, 1))
    root[:, 1] += np.linspace(0, walks, FRAMES)
    still = np.broadcast_to(np.eye(3), (22, 3, 3))
    return strangers.rerigged(path, strangers.NAMINGS["smpl"], JOINT_NAMES, PARENTS, world, still, rest, root, 30.0)


def ups(body: Body, *files: Path) -> list[str]:
    return [source.up for source in load_rigs(list(files), body).sources]


def test_who_stands_on_the_floor_does_not_lie_in_the_air(body: Body, tmp_path: Path) -> None:
    """Who gestured on the spot in a world that is z up was laid down."""
    assert ups(body, stander(body, tmp_path / "away.bvh", aside=1.5)) == ["z"]


def test_who_may_as_well_lie_is_as_the_rest_pose_says(body: Body, tmp_path: Path) -> None:
    assert ups(body, stander(body, tmp_path / "origin.bvh", aside=0.0)) == ["y"]
    assert ups(body, stander(body, tmp_path / "nowhere.bvh", aside=1.5, floor=0.5)) == ["y"]


def test_who_stays_beside_somebody_who_walks_stands_in_the_same_world(body: Body, tmp_path: Path) -> None:
    """Of a couple in one world one danced on the spot, and was laid down beside the other."""
    stays, walks = (stander(body, tmp_path / f"{way}.bvh", 0.0, way, 0.5) for way in (0.0, 2.0))
    assert ups(body, stays, walks) == ups(body, walks, stays) == ["z", "z"]
