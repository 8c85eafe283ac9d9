"""Strangers' skeletons on our body: whatever their names, rest pose, unit, up axis and proportions."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import roma
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body import Body
from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.datamodules.preparing.fit_cache import fit_whole
from magnet.datamodules.reading.asf_amc import AmcRecording, read_amc, read_asf
from magnet.datamodules.reading.cmu_joints import measured
from magnet.export import load_rigs, save_bvh
from magnet.export.bvh_read import read_bvh
from magnet.export.naming import recognised
from magnet.export.retarget import Imported
from magnet.export.rig import UP, understood_together
from magnet.motion.rotations import geodesic
from magnet.motion.scene import Scene
from magnet.testing import random_scene
from tests.cases import few, some_slow
from tests.export import strangers

LIMBS = [1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21]


@dataclass(frozen=True)
class Truth:
    scene: Scene
    world: Tensor  # (T, 22, 3, 3)
    joints: Tensor  # (T, 22, 3)


@pytest.fixture(scope="module")
def truth(body: Body) -> Truth:
    """A standing person who moves every joint, arms hanging."""
    scene = random_scene(1, 16, 1, torch.Generator().manual_seed(1))
    hang = pose(arms=70)
    scene = scene.replace(body_rot=scene.body_rot @ hang, betas=0.5 * scene.betas)
    world, joints = turned(body, scene.body_rot[0, :, 0], scene.T_world_root[0, :, 0], scene.betas[0, 0])
    return Truth(scene, world, joints)


def pose(arms: float = 0.0, legs: float = 0.0) -> Tensor:
    """Arms lowered and legs spread by so many degrees. (21, 3, 3)"""
    vectors = torch.zeros(21, 3)
    vectors[[15, 16], 2] = torch.tensor([-1.0, 1.0]) * np.radians(arms)
    vectors[[0, 1], 2] = torch.tensor([1.0, -1.0]) * np.radians(legs)
    return roma.rotvec_to_rotmat(vectors)


def turned(body: Body, body_rot: Tensor, T_world_root: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
    """World rotations and joints, by walking the tree."""
    world = [T_world_root[..., :3, :3]]
    for j in range(1, 22):
        world.append(world[PARENTS[j]] @ body_rot[..., j - 1, :, :])
    return torch.stack(world, dim=-3), body.forward_kinematics(body_rot, T_world_root, betas)


def stranger(truth: Truth, body: Body, path: Path, naming: str = "mixamo", arms: float = 0, legs: float = 0, **how):
    rest_world, rest_at = turned(body, pose(arms, legs), torch.eye(4), truth.scene.betas[0, 0])
    root = truth.scene.T_world_root[0, :, 0, :3, 3]
    arrays = [t.double().numpy() for t in (truth.world, rest_world, rest_at, root)]
    return strangers.rerigged(path, strangers.NAMINGS[naming], JOINT_NAMES, PARENTS, *arrays, fps=30.0, **how)


def errors(found: Imported, truth: Truth, body: Body) -> tuple[Tensor, Tensor]:
    """Distance of each joint in metres and angle of each world rotation in degrees, means over frames. (22,) x 2"""
    scene = found.scene
    world, joints = turned(body, scene.body_rot[0, :, 0], scene.T_world_root[0, :, 0], scene.betas[0, 0])
    return (joints - truth.joints).norm(dim=-1).mean(0), geodesic(world, truth.world).rad2deg().mean(0)


@pytest.mark.parametrize("naming", strangers.NAMINGS)
def test_every_naming_scheme_is_recognised_whole(naming):
    names = strangers.NAMINGS[naming]
    found = recognised(list(names.values()))
    assert not found.missing
    got = {JOINT_NAMES[j]: list(names.values())[k] for j, k in found.joints.items()}
    assert got == {ours: theirs for ours, theirs in names.items() if ours in got}
    assert len(got) == 18


def test_the_wrist_of_cmus_conversions_is_where_the_fingers_begin_and_nobody_elses_is():
    """Their Hand begins in the middle of the forearm; MotionBuilder's own skeletons have a FingerBase in the palm."""
    names = list(CMU_NAMES.values())
    found = recognised(names)
    assert (found.scheme, names[found.joints[20]], names[found.joints[18]]) == ("CMU", "LeftFingerBase", "LeftForeArm")
    others = [name for name in names if "HipJoint" not in name]
    assert others[recognised(others).joints[21]] == "RightHand"
    bones = list(CMU_NAMES)
    assert bones[recognised(bones).joints[20]] == "lhand" and recognised(bones).scheme == "Acclaim"


CASES = {
    "mixamo, T pose": {"naming": "mixamo"},
    "biped, A pose, centimetres, z up": {"naming": "biped", "arms": 45, "legs": 8, "metres": 0.01, "up": UP["z"].T},
    "unreal, arms down, XYZ": {"naming": "unreal", "arms": 80, "metres": 0.01, "order": "XYZ"},
    "motive, inches, every joint slides": {"naming": "motive", "metres": 0.0254, "positions_everywhere": True},
    "xsens, millimetres, x up": {"naming": "biovision", "arms": 45, "metres": 0.001, "up": UP["x"].T},
    "smpl, turned upside down": {"naming": "smpl", "up": UP["-y"].T},
}


@pytest.mark.parametrize("case", few(list(CASES)[::-1], 2))
def test_a_person_comes_back_from_any_rig(case, truth: Truth, body: Body, tmp_path: Path):
    path = stranger(truth, body, tmp_path / "stranger.bvh", **CASES[case])
    found = load_rigs(path, body, keep_floor=True)
    (source,) = found.sources
    assert not source.exact and source.residual < 0.01
    distance, angle = errors(found, truth, body)
    assert distance[LIMBS].max() < 0.015 and distance.max() < 0.04
    assert angle[LIMBS].max() < 12 and angle.mean() < 7


def test_whoever_was_lost_in_the_air_is_not_put_on_the_floor_there(truth: Truth, body: Body, tmp_path: Path):
    path = stranger(truth, body, tmp_path / "stranger.bvh")
    whole, lines = load_rigs(path, body, end=5).floor, path.read_text().splitlines()
    x, y, *rest = lines[-12].split()  # of 16 frames the fifth
    lines[-12:] = [" ".join([x, str(float(y) + 0.5), *rest]), *[" ".join(["nan"] * (len(rest) + 2))] * 11]
    path.write_text("\n".join(lines) + "\n")
    assert load_rigs(path, body).floor == pytest.approx(whole, abs=0.03)


def person(
    truth: Truth, body: Body, path: Path, about: float = 0.0, walk: float = 0.0, bones: float = 1.0, **how
) -> Path:
    """The standing person, turned about z by so many degrees (90: lies, the head at -x), who walks along x or not."""
    R = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, np.radians(about)], dtype=torch.float64))
    root = truth.scene.T_world_root[0, :, 0, :3, 3] * torch.tensor([0.02, 1.0, 0.02])
    root = R @ (root.double() + torch.linspace(0, walk, len(root))[:, None] * torch.eye(3)[0])[..., None]
    rest_world, rest_at = turned(body, pose(70, 0), torch.eye(4), truth.scene.betas[0, 0])
    arrays = [t.double().numpy() for t in (R @ truth.world.double(), rest_world, bones * rest_at, root[..., 0])]
    return strangers.rerigged(path, strangers.NAMINGS["mixamo"], JOINT_NAMES, PARENTS, *arrays, fps=30.0, **how)


def axes(*files: Path, **options: str) -> list[str]:
    """Which axis is taken for up in each file of a scene."""
    return [one.up for one in understood_together([read_bvh(f) for f in files], None, options.get("up"), None)]


def test_whoever_lies_throughout_is_not_stood_up(truth: Truth, body: Body, tmp_path: Path):
    stands = person(truth, body, tmp_path / "stands.bvh", metres=0.01)
    lies = person(truth, body, tmp_path / "lies.bvh", about=90, metres=0.01)
    assert axes(stands, lies) == ["y", "y"] and axes(lies) == ["y"]
    assert axes(stands, lies, up="-x") == ["-x", "-x"]
    alone, beside = understood_together([read_bvh(lies), read_bvh(stands)], None, None, None)
    assert len(alone.notes) == 1 and "torsos point along -x" in alone.notes[0] and not beside.notes


def test_files_of_two_axes_in_which_people_stand_are_read_and_told_of(truth: Truth, body: Body, tmp_path: Path):
    y, z = (person(truth, body, tmp_path / f"{up}.bvh", up=UP[up].T) for up in "yz")
    assert axes(y, z) == ["y", "z"]
    notes = [one.notes for one in understood_together([read_bvh(y), read_bvh(z)], None, None, None)]
    assert all("files have different axes" in note for (note,) in notes)


def test_a_world_turned_after_the_rest_pose_is_seen_where_somebody_walks(truth: Truth, body: Body, tmp_path: Path):
    """Whoever lies with the head at -x does not move along y."""
    assert axes(person(truth, body, tmp_path / "a.bvh", about=90, walk=2.0)) == ["-x"]


def test_a_child_is_measured_in_the_unit_of_the_grown_up(truth: Truth, body: Body, tmp_path: Path):
    grown = person(truth, body, tmp_path / "grown.bvh", metres=0.01)
    child = person(truth, body, tmp_path / "child.bvh", metres=0.01, bones=0.42)
    first, second = understood_together([read_bvh(grown), read_bvh(child)], None, None, None)
    assert (first.unit, second.unit) == ("cm", "cm") and not first.notes
    assert len(second.notes) == 1 and "cm long if its unit is that of the others" in second.notes[0]
    metres = person(truth, body, tmp_path / "metres.bvh")
    found = understood_together([read_bvh(grown), read_bvh(metres)], None, None, None)
    assert [one.unit for one in found] == ["cm", "m"]
    assert all("different units" in note for one in found for note in one.notes)
    assert {one.unit for one in understood_together([read_bvh(grown), read_bvh(child)], "inch", None, None)} == {"inch"}


@pytest.mark.slow
def test_rest_poses_make_no_difference(truth: Truth, body: Body, tmp_path: Path):
    scenes = [load_rigs(stranger(truth, body, tmp_path / f"{arms}.bvh", arms=arms), body).scene for arms in (0, 45, 90)]
    for scene in scenes[1:]:
        assert (body.joints(scene) - body.joints(scenes[0])).abs().max() < 5e-3


def test_missing_toes_are_reported_and_feet_follow_the_ankles(truth: Truth, body: Body, tmp_path: Path):
    path = stranger(truth, body, tmp_path / "a.bvh", "biovision", drop=("left_foot", "right_foot"))
    found = load_rigs(path, body, keep_floor=True)
    assert not {"left_foot", "right_foot"} & set(found.sources[0].joints)
    distance, _ = errors(found, truth, body)
    assert distance[[7, 8]].max() < 0.015 and distance[[10, 11]].max() < 0.04


@pytest.mark.parametrize(("legs", "arms"), some_slow([(1.15, 1.0), (0.9, 1.15), (1.0, 0.85)], (1.15, 1.0), (1.0, 0.85)))
def test_other_proportions_keep_limbs_pointing_the_same_way(legs, arms, truth: Truth, body: Body, tmp_path: Path):
    rest_world, rest_at = turned(body, pose(), torch.eye(4), truth.scene.betas[0, 0])
    longer = rest_at.clone()
    for j in range(1, 22):
        stretch = legs if j in (4, 5, 7, 8) else arms if j in (18, 19, 20, 21) else 1.0
        longer[j] = longer[PARENTS[j]] + stretch * (rest_at[j] - rest_at[PARENTS[j]])
    arrays = [t.double().numpy() for t in (truth.world, rest_world, longer, truth.scene.T_world_root[0, :, 0, :3, 3])]
    naming = strangers.NAMINGS["mixamo"]
    path = strangers.rerigged(tmp_path / "tall.bvh", naming, JOINT_NAMES, PARENTS, *arrays, fps=30.0)
    found = load_rigs(path, body)
    assert found.sources[0].residual < 0.03
    _, angle = errors(found, truth, body)
    assert angle[LIMBS].max() < 16


@pytest.mark.slow
def test_people_keep_their_places_and_stand_on_the_floor(truth: Truth, body: Body, tmp_path: Path):
    raised = truth.scene.T_world_root.clone()
    raised[..., :3, 3] += torch.tensor([1.5, 0.3, -1.0])
    other = Truth(truth.scene.replace(T_world_root=raised), truth.world, truth.joints)
    paths = [stranger(t, body, tmp_path / f"{i}.bvh", "cmu") for i, t in enumerate((truth, other))]
    found = load_rigs(paths, body)
    joints = body.joints(found.scene)[0]
    apart = (joints[:, 1, LIMBS] - joints[:, 0, LIMBS]).mean(dim=(0, 1))
    assert (apart - torch.tensor([1.5, 0.3, -1.0])).abs().max() < 5e-3
    lowest = body.vertices(found.scene)[0, ..., 1].amin(dim=(1, 2))
    assert lowest.median().abs() < 0.04
    kept = body.joints(load_rigs(paths[:1], body, keep_floor=True).scene)[0]
    assert torch.allclose(kept[..., 1] - joints[:, :1, :, 1], torch.tensor(found.floor), atol=1e-4)


def test_files_of_other_rates_and_lengths_need_a_word(body: Body, tmp_path: Path):
    duo = random_scene(1, 30, 2, torch.Generator().manual_seed(2))
    a = save_bvh(duo.permute_agents(torch.tensor([0])), tmp_path / "a.bvh", body)[0]
    b = save_bvh(duo.permute_agents(torch.tensor([1])).replace(fps=60.0), tmp_path / "b.bvh", body)[0]
    with pytest.raises(
        ValueError, match=r"a\.bvh 30 fps, .*b\.bvh 60 fps; bring all to one with magnet export --fps 30"
    ):
        load_rigs([a, b], body)
    with pytest.raises(ValueError, match=r"a\.bvh 30 frames, .*b\.bvh 15 frames.*--trim"):
        load_rigs([a, b], body, fps=30)
    both = load_rigs([a, b], body, fps=30, trim=True).scene
    assert (both.frames, both.agents, both.fps) == (15, 2, 30.0)
    truth = body.joints(duo)[0]
    assert (body.joints(both)[0, :, 0] - truth[:15, 0]).abs().max() < 1e-5
    assert (body.joints(both)[0, :, 1] - truth[::2, 1]).abs().max() < 1e-5


def test_an_unknown_skeleton_lists_its_names_and_can_be_told(truth: Truth, body: Body, tmp_path: Path):
    naming = {name: f"Bone{i:02}" for i, name in enumerate(JOINT_NAMES)}
    strangers.NAMINGS["bones"] = naming
    try:
        path = stranger(truth, body, tmp_path / "bones.bvh", "bones")
    finally:
        del strangers.NAMINGS["bones"]
    with pytest.raises(ValueError, match=r"cannot tell which joint is left_hip, .*it has Bone00, .*--joint left_hip="):
        load_rigs(path, body)
    with pytest.raises(ValueError, match="joint left_hip=Bone99: expected OUR_NAME=THEIR_NAME; it has Bone00"):
        load_rigs(path, body, joints={"left_hip": "Bone99"})
    told = {JOINT_NAMES[j]: f"Bone{j:02}" for j in LIMBS}
    found = load_rigs(path, body, joints=told, keep_floor=True)
    distance, _ = errors(found, truth, body)
    assert distance[LIMBS].max() < 0.015


def test_lengths_that_no_unit_explains_need_a_word(truth: Truth, body: Body, tmp_path: Path):
    path = stranger(truth, body, tmp_path / "a.bvh", metres=0.2)
    with pytest.raises(ValueError, match=r"legs are .* long, which fits no unit"):
        load_rigs(path, body)
    with pytest.raises(ValueError, match="unit 'ell': expected one of m, cm, mm, inch, foot"):
        load_rigs(path, body, unit="ell")
    with pytest.raises(ValueError, match="up axis 'w'"):
        load_rigs(path, body, up="w")


def test_a_skeleton_that_is_no_person_is_refused_or_called_poor(truth: Truth, body: Body, tmp_path: Path):
    swapped = dict(strangers.NAMINGS["mixamo"])
    swapped["left_wrist"], swapped["left_ankle"] = swapped["left_ankle"], swapped["left_wrist"]
    strangers.NAMINGS["swapped"] = swapped
    try:
        path = stranger(truth, body, tmp_path / "swapped.bvh", "swapped")
    finally:
        del strangers.NAMINGS["swapped"]
    try:
        (source,) = load_rigs(path, body).sources
    except ValueError as error:
        assert "mean error" in str(error) or "fits no unit" in str(error)
    else:
        assert source.poor and "hands and feet may miss" in str(source)


# -- real recordings ---------------------------------------------------------------------------

CMU_NAMES = {
    "root": "Hips", "lowerback": "LowerBack", "upperback": "Spine", "thorax": "Spine1", "lowerneck": "Neck",
    "upperneck": "Neck1", "head": "Head",
    **{
        f"{letter}{bone}": f"{side}{name}"
        for letter, side in (("l", "Left"), ("r", "Right"))
        for bone, name in (
            ("hipjoint", "HipJoint"), ("femur", "UpLeg"), ("tibia", "Leg"), ("foot", "Foot"), ("toes", "ToeBase"),
            ("clavicle", "Shoulder"), ("humerus", "Arm"), ("radius", "ForeArm"), ("wrist", "Hand"),
            ("hand", "FingerBase"), ("fingers", "HandIndex1"), ("thumb", "HandThumb"),
        )
    },
}  # fmt: skip
"""Bones of CMU's ASF by the names that its BVH conversions give the joints at their starts."""


RATE = 60.0
"""Frames a second of the salsa takes."""


def as_bvh(recording: AmcRecording, path: Path) -> Path:
    """A recording as the usual BVH conversion: a joint where each bone starts, in ASF's own unit."""
    skeleton = recording.skeleton
    starts: NDArray[np.float64] = np.array([skeleton.offset[p] if p >= 0 else np.zeros(3) for p in skeleton.parents])
    names = [CMU_NAMES[name] for name in skeleton.names]
    offsets, root = starts / skeleton.metres, recording.root / skeleton.metres
    return strangers.write(path, names, skeleton.parents, offsets, root, recording.local, recording.fps)


@pytest.mark.slow
@pytest.mark.parametrize("take", some_slow(["60_08", "61_03"], "61_03"))
def test_recorded_dancers_as_bvh_fit_as_well_as_their_own_reader_does(take, cmu_root: Path, body: Body, tmp_path: Path):
    """The BVH way knows names alone; the reader of the recordings knows CMU's rest pose, its glitches and the floor."""
    subject = take.split("_")[0]
    asf = next(cmu_root.rglob(f"{subject}.asf"))
    recording = read_amc(next(cmu_root.rglob(f"{take}.amc")), read_asf(asf), RATE)
    slow = recording.resampled(30.0)
    short = replace(slow, root=slow.root[60:120], local=slow.local[60:120])
    found = load_rigs(as_bvh(short, tmp_path / f"{take}.bvh"), body)
    (source,) = found.sources
    assert source.unit.startswith("CMU") and source.scheme == "CMU" and len(source.joints) >= 20
    own, report = fit_whole(*measured([short]), body)
    assert source.residual < report["limb error cm"] / 100 + 0.01 < 0.04
    ours, theirs = body.joints(own)[0, :, 0], body.joints(found.scene)[0, :, 0]
    assert (ours - theirs).norm(dim=-1)[:, LIMBS].mean() < 0.03
    assert (ours[..., 1] - theirs[..., 1]).mean().abs() < 0.02


def test_a_rest_pose_in_the_first_frame_spoils_none_of_the_others(truth: Truth, body: Body, tmp_path: Path):
    """Many programs write one, at the origin."""
    path = stranger(truth, body, tmp_path / "plain.bvh")
    head, motion = path.read_text().split("Frame Time:")
    step, *rows = motion.strip().splitlines()
    frames = int(re.search(r"Frames: (\d+)", head)[1])
    rest = " ".join("0" for _ in rows[0].split())
    more = head.replace(f"Frames: {frames}", f"Frames: {frames + 1}")
    led = tmp_path / "led.bvh"
    led.write_text(f"{more}Frame Time: {step}\n" + "\n".join([rest, *rows]) + "\n")
    plain, found = load_rigs(path, body), load_rigs(led, body)
    off = (body.joints(found.scene)[:, 1:] - body.joints(plain.scene)).norm(dim=-1)
    assert off.max() < 0.03, off.amax(dim=(0, 2, 3))
    assert "everything jumps to frame 1 (a rest pose" in str(found.sources[0])
    assert "leave it out, --start 1" in str(found.sources[0])
    assert "jumps" not in str(plain.sources[0])
    without = load_rigs(led, body, start=1)
    assert without.scene.frames == plain.scene.frames and "jumps" not in str(without.sources[0])
    assert (body.joints(without.scene) - body.joints(plain.scene)).norm(dim=-1).max() < 1e-4


def test_where_everything_jumps_again_and_again_nothing_is_to_be_left_out(duet: Scene, body: Body, tmp_path: Path):
    """Poses that are held, as in a first pass of an animation, or takes behind each other."""
    poses = duet.permute_agents(torch.tensor([0])).frames_at(torch.arange(30) // 8 % 2 * 3)
    far = poses.T_world_root.clone()
    far[:, :, :, 0, 3] += (torch.arange(30) // 8).float()[:, None]
    (path,) = save_bvh(poses.replace(T_world_root=far), tmp_path / "held.bvh", body)
    said = str(load_rigs(path, body).sources[0])
    assert "everything jumps to frames 8, 16, 24 (stepped keys, or cuts?" in said and "leave it out" not in said
    said = str(load_rigs(path, body, start=10, end=22).sources[0])
    assert "jumps to frame 16 (a cut?): keep one part, --end 16 or --start 16" in said, "numbers are the file's"


def test_a_single_frame_is_enough(truth: Truth, body: Body, tmp_path: Path):
    still = Truth(truth.scene.slice(3, 4), truth.world[3:4], truth.joints[3:4])
    found = load_rigs(stranger(still, body, tmp_path / "a.bvh", "rigify"), body, keep_floor=True)
    distance, _ = errors(found, still, body)
    assert found.scene.frames == 1 and distance[LIMBS].max() < 0.015


def test_a_node_above_the_hips_moves_everybody_below_it(truth: Truth, body: Body, tmp_path: Path):
    """MotionBuilder and Mixamo put a Reference or an Armature on top, which often turns z up to y up."""
    path = stranger(truth, body, tmp_path / "plain.bvh", "mixamo", up=UP["z"].T)
    lines = path.read_text().split("\n")
    begin, motion = 1, lines.index("MOTION")
    lines[begin] = lines[begin].replace("ROOT", "JOINT")
    above = [
        "ROOT Armature",
        "{",
        "OFFSET 0 0 0",
        "CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation",
    ]
    rows = [f"1.0 0.0 2.0 0 0 -90 {row}" for row in lines[motion + 3 :] if row]
    path.write_text("\n".join([lines[0], *above, *lines[1:motion], "}", *lines[motion : motion + 3], *rows]) + "\n")
    found = load_rigs(path, body, keep_floor=True)
    assert found.sources[0].up == "y"
    moved = Truth(truth.scene, truth.world, truth.joints + torch.tensor([1.0, 0.0, 2.0]))
    distance, angle = errors(found, moved, body)
    assert distance[LIMBS].max() < 0.015 and angle[LIMBS].max() < 12
