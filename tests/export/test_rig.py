"""Limbs that turn in several parts: what the bones of each do together is taken for the limb."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from magnet.body import Body
from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.export.bvh_read import read_bvh
from magnet.export.retarget import hints
from magnet.export.rig import understood_together
from magnet.motion.rotations import geodesic
from tests.export import strangers

FRAMES = 8
LIMBS = ("hip", "knee", "shoulder", "elbow")
PROGRAMS = {
    "Daz": (
        dict(
            pelvis="pelvis", spine1="abdomenLower", spine2="chestLower", spine3="chestUpper", neck="neckLower",
            head="head", hip="ThighBend", knee="Shin", ankle="Foot", foot="Toe", collar="Collar",
            shoulder="ShldrBend", elbow="ForearmBend", wrist="Hand", hip2="ThighTwist", shoulder2="ShldrTwist",
            elbow2="ForearmTwist",
        ),
        "{side}{name}",
    ),
    "MakeHuman": (
        dict(
            pelvis="root", spine1="spine05", spine2="spine03", spine3="spine01", neck="neck01", head="head",
            hip="upperleg01", knee="lowerleg01", ankle="foot", foot="toe1-1", collar="clavicle",
            shoulder="upperarm01", elbow="lowerarm01", wrist="wrist", hip2="upperleg02", knee2="lowerleg02",
            shoulder2="upperarm02", elbow2="lowerarm02",
        ),
        "{name}.{SIDE}",
    ),
    "MikuMikuDance": (
        dict(
            pelvis="センター", spine1="下半身先", spine2="上半身", spine3="上半身2", neck="首", head="頭", hip="足",
            knee="ひざ", ankle="足首", foot="つま先", collar="肩", shoulder="腕", elbow="ひじ", wrist="手首",
            shoulder2="腕捩", elbow2="手捩",
        ),
        "{KANJI}{name}",
    ),
}  # fmt: skip


@pytest.mark.parametrize("program", PROGRAMS)
def test_twists_between_the_ends_of_a_limb_are_its_own(program: str, body: Body, tmp_path: Path) -> None:
    """Upper arms and thighs lost them: they stayed rolled by as much."""
    words, pattern = PROGRAMS[program]
    generator = np.random.default_rng(0)
    local = Rotation.from_rotvec(generator.normal(0, 0.3, (FRAMES * 22, 3))).as_matrix().reshape(FRAMES, 22, 3, 3)
    rest = body.rest_joints(torch.zeros(10)).double().numpy()
    names, parents, naming = list(JOINT_NAMES), list(PARENTS), {}
    twists = {}  # of a limb, its second half
    for j, name in enumerate(JOINT_NAMES):
        side, _, part = name.rpartition("_")
        spelled = {"side": side[:1], "SIDE": side[:1].upper(), "KANJI": {"left": "左", "right": "右"}.get(side)}
        naming[name] = pattern.format(name=words[part], **spelled) if side else words[name]
        if f"{part}2" in words and side:
            twists[j] = len(names)
            names.append(f"{name}2")
            naming[names[-1]] = pattern.format(name=words[f"{part}2"], **spelled)
            parents.append(j)
    for j, twist in twists.items():
        child = PARENTS.index(j)
        parents[child] = twist
        rest = np.concatenate([rest, [(rest[j] + rest[child]) / 2]])
    world = np.concatenate([local, np.empty((FRAMES, len(twists), 3, 3))], axis=1)
    for j in range(1, 22):
        world[:, j] = world[:, PARENTS[j]] @ local[:, j]
    for j, twist in twists.items():
        world[:, twist] = world[:, j]
        bone = rest[PARENTS.index(j)] - rest[j]
        roll = Rotation.from_rotvec(np.linspace(-1, 1, FRAMES)[:, None] * bone / np.linalg.norm(bone)).as_matrix()
        world[:, j] = world[:, j] @ roll  # the first half has not all of the turn
    whole = world[:, :22].copy()
    whole[:, list(twists)] = world[:, list(twists.values())]
    still, root = np.tile(np.eye(3), (len(names), 1, 1)), np.tile([0.0, 1.0, 0.0], (FRAMES, 1))
    path = strangers.rerigged(tmp_path / "a.bvh", naming, names, parents, world, still, rest, root, 30.0, 0.01)
    (skeleton,) = understood_together([read_bvh(path)], None, "y", None)
    found, _ = hints(skeleton, body.rest_joints(torch.zeros(10)).double())
    angles = geodesic(found, torch.from_numpy(whole)).rad2deg().amax(dim=0)
    for j, name in enumerate(JOINT_NAMES):
        if name.rpartition("_")[2] in LIMBS:
            assert angles[j] < 2, name
