"""Rest poses whose palms do not look down: told by the fingers, and by how elbows bend."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magnet.body import Body
from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.export.bvh_read import read_bvh
from magnet.export.palms import fingers
from magnet.export.rests import with_doubts
from magnet.export.retarget import hints
from magnet.export.rig import Skeleton, understood_together
from magnet.motion.rotations import geodesic
from tests.export import strangers

Floats = NDArray[np.float64]
J = {name: j for j, name in enumerate(JOINT_NAMES)}
FRAMES = 12
ARMS = ("shoulder", "elbow", "wrist")
FINGERS = {"Index": (0.09, -0.01, 0.03), "Pinky": (0.08, -0.01, -0.04), "Thumb": (0.05, -0.01, 0.05)}
"""Where their first joints are from a left wrist in our rest pose, metres."""


def reach(body: Body) -> tuple[Floats, Floats]:
    """Somebody who reaches ahead with bent elbows: world rotations (T, 22, 3, 3), and our joints at rest (22, 3)."""
    turns, swing = np.zeros((FRAMES, 22, 3)), np.sin(np.arange(FRAMES) / 3)
    for way, side in ((1, "left"), (-1, "right")):
        turns[:, J[f"{side}_shoulder"], 2] = way * (0.3 * swing - 0.9)
        turns[:, J[f"{side}_elbow"], 1] = -way * (0.9 + 0.4 * swing)
        turns[:, J[f"{side}_wrist"], 0] = 0.4 * swing
    world = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(FRAMES, 22, 3, 3)
    for j in range(1, 22):
        world[:, j] = world[:, PARENTS[j]] @ world[:, j]
    return world, body.rest_joints(torch.zeros(10)).double().numpy()


def written(path: Path, body: Body, rolls: tuple[float, float, float], tell: tuple[str, ...], down: float = 0) -> Path:
    """The person as a BVH that rests with arms lowered by `down` degrees, their parts rolled by `rolls`, thumbs up."""
    world, ours = reach(body)
    names, parents, naming = list(JOINT_NAMES), list(PARENTS), dict(strangers.NAMINGS["mixamo"])
    rest, turned = ours.copy(), np.tile(np.eye(3), (22, 1, 1))
    for way, side in ((1, "left"), (-1, "right")):
        for part, roll in zip(ARMS, rolls, strict=True):
            turned[J[f"{side}_{part}"]] = Rotation.from_euler("xz", [-roll, -way * down], degrees=True).as_matrix()
        for above, below in pairwise(ARMS):
            a, b = J[f"{side}_{above}"], J[f"{side}_{below}"]
            rest[b] = rest[a] + turned[a] @ (ours[b] - ours[a])
    for way, side in ((1, "left"), (-1, "right")):
        w = J[f"{side}_wrist"]
        for finger in tell:
            names.append(f"{side}_{finger}")
            parents.append(w)
            naming[names[-1]] = f"mixamorig:{side.capitalize()}Hand{finger}1"
            away = turned[w] @ (np.array(FINGERS[finger]) * (way, 1, 1))
            rest, turned = np.concatenate([rest, [rest[w] + away]]), np.concatenate([turned, turned[w : w + 1]])
            world = np.concatenate([world, world[:, w : w + 1]], axis=1)
    root = np.tile([0.0, 1.0, 0.0], (FRAMES, 1))
    return strangers.rerigged(path, naming, names, parents, world, turned, rest, root, 30.0, 0.01)


def understood(path: Path) -> Skeleton:
    return with_doubts(understood_together([read_bvh(path)], None, None, None))[0]


def off(path: Path, body: Body) -> dict[str, float]:
    """Degrees by which parts of arms are turned wrongly, the most in any frame of either."""
    found, _ = hints(understood(path), body.rest_joints(torch.zeros(10)).double())
    angles = geodesic(found, torch.from_numpy(reach(body)[0])).rad2deg().amax(dim=0)
    return {part: max(float(angles[J[f"{side}_{part}"]]) for side in ("left", "right")) for part in ARMS}


@pytest.mark.parametrize("down", [0, 45])
@pytest.mark.parametrize("tell", [("Index", "Pinky"), ("Index", "Pinky", "Thumb")])
def test_arms_that_rest_with_palms_forward_are_not_rolled(tell, down, body: Body, tmp_path: Path) -> None:
    """They came out rolled by 90 degrees, from the shoulder to the hand."""
    assert max(off(written(tmp_path / "a.bvh", body, (90, 90, 90), tell, down), body).values()) < 2


def test_forearms_that_rest_turned_do_not_roll_upper_arms(body: Body, tmp_path: Path) -> None:
    """A palm that looks forward by the forearm alone: half of the turn is the elbow's."""
    found = off(written(tmp_path / "a.bvh", body, (0, 45, 90), ("Index", "Pinky")), body)
    assert max(found.values()) < 2


def test_a_thumb_alone_tells_as_far_as_it_may_lean(body: Body, tmp_path: Path) -> None:
    found = off(written(tmp_path / "a.bvh", body, (90, 90, 90), ("Thumb",)), body)
    assert max(found.values()) < 25
    assert max(off(written(tmp_path / "b.bvh", body, (0, 0, 0), ("Thumb",)), body).values()) < 2


def test_palms_that_rest_nearly_down_stay_as_they_are(body: Body, tmp_path: Path) -> None:
    """Hands of other shapes: their fingers lie a little askew."""
    assert off(written(tmp_path / "a.bvh", body, (0, 0, 0), ("Index", "Pinky")), body)["elbow"] < 2
    slight = off(written(tmp_path / "b.bvh", body, (0, 0, 15), ("Index", "Pinky")), body)
    assert slight["elbow"] < 2 and slight["wrist"] < 17


def test_without_fingers_a_line_says_that_arms_may_be_rolled(body: Body, tmp_path: Path) -> None:
    (note,) = understood(written(tmp_path / "a.bvh", body, (90, 90, 90), ())).notes
    assert "elbows bend 90 degrees aside" in note and "palms" in note and "\n" not in note
    assert not understood(written(tmp_path / "b.bvh", body, (0, 0, 0), ())).notes
    assert not understood(written(tmp_path / "c.bvh", body, (90, 90, 90), ("Index", "Pinky"))).notes


NAMES = {
    "Mixamo": "LeftHand LeftHandThumb1 LeftHandIndex1 LeftHandMiddle1 LeftHandRing1 LeftHandPinky1",
    "VRM": "leftHand leftThumbProximal leftIndexProximal leftMiddleProximal leftRingProximal leftLittleProximal",
    "3ds Max Biped": "Bip01 L Hand,Bip01 L Finger0,Bip01 L Finger1,Bip01 L Finger2,Bip01 L Finger3,Bip01 L Finger4",
    "MakeHuman": "wrist.L finger1-1.L finger2-1.L finger3-1.L finger4-1.L finger5-1.L",
    "CAT": "LArmPalm LArmDigit11 LArmDigit21 LArmDigit31 LArmDigit41 LArmDigit51",
    "MikuMikuDance": "左手首 左親指１ 左人指１ 左中指１ 左薬指１ 左小指１",
}


@pytest.mark.parametrize("program", NAMES)
def test_fingers_are_known_by_the_names_of_programs(program: str) -> None:
    names = NAMES[program].split("," if "," in NAMES[program] else " ")
    found = fingers([*names, "Head"], [-1, 0, 0, 0, 0, 0, -1], 0)
    assert (found["thumb"], found["index"], found["pinky"]) == ([1], [2], [5])
