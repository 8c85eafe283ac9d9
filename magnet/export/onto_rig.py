"""Motion on a character of one's own: its bones turn as people's do, its names, proportions and mesh stay."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from magnet.body import Body
from magnet.body.joints import ANKLES, COLLARS, HIPS, KNEES
from magnet.export.bvh import bvh_text, depth_first, euler_zxy, paths_of
from magnet.export.bvh_read import bvh_lines, read_bvh
from magnet.export.fbx import as_fbx, at_whole_rate, converted
from magnet.export.glb import FLOAT, Gltf, animation, frame_times, standing, unbroken
from magnet.export.glb_read import GlbRig, in_one_line, read_rig
from magnet.export.gltf_file import matrices
from magnet.export.rests import rests_aligned, rests_upright
from magnet.export.retarget import sources
from magnet.export.rig import UP, Skeleton, rest_frame, understood_together
from magnet.export.rig_motion import Floats, RigMotion
from magnet.files import whole, write_text
from magnet.motion.bvh import bvh_header
from magnet.motion.required import require_body, require_one
from magnet.motion.rotations import to_quat
from magnet.motion.scene import BODY_JOINTS, Scene

FLOOR = 0.15
"""Metres over 0 up to which the lowest joint of a rest pose may be for 0 to be its floor."""


@dataclass(frozen=True)
class RigOptions:
    """How a character's file is understood; what it does not state.

    Args:
        unit: of its lengths; None: found from its legs.
        up: its axis that points up; None: found.
        joints: our joint's name to its own, if no naming scheme fits.
    """

    unit: str | None = None
    up: str | None = None
    joints: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Moved:
    """A skeleton that moves as a person does, in its file's axes and unit.

    Attributes:
        turned: of each joint that is driven by its number, world rotations from its rest pose. (T, 3, 3)
        pelvis: the number of the pelvis.
        at: its places in the world. (T, 3)
    """

    turned: dict[int, Floats]
    pelvis: int
    at: Floats


def save_onto(
    scene: Scene, path: str | Path, body: Body, rigs: Sequence[str | Path], options: RigOptions = RigOptions()
) -> list[Path]:
    """Write one scene (B = 1) as characters of your own: a file a person, out_person0.glb ..., or the path for one.

    Hips are where people's are, higher or lower as legs are longer or shorter; bones turn as people's, those that we
    have not (fingers, twists, faces) stay as they rest on the one above. Returns the paths written.

    Args:
        rigs: files of one character each, of a kind that `RIGS_FOR` has for the path's suffix: one for everybody, or
            one for each person present.

    Raises:
        FileNotFoundError: there is no such character.
        ImportError: an FBX, and no Blender.
        ValueError: another suffix, another number of characters, or one that cannot be read or would be written over.
    """
    require_one(scene)
    require_body(scene, body.id)
    path, suffix = Path(path), Path(path).suffix.lower()
    slots, people = scene.present[0].nonzero()[:, 0].tolist(), scene.people()
    files = [Path(rig) for rig in rigs]
    if not {file.suffix.lower() for file in files} <= set(RIGS_FOR.get(suffix, ())):
        names = ", ".join(file.name for file in files)
        ways = ", ".join(f"{rig} to {to}" for to, kinds in RIGS_FOR.items() for rig in kinds)
        raise ValueError(f"a character is written as it was read: got {names} for {path.name}; {ways}")
    for file in files:
        if not file.is_file():
            raise FileNotFoundError(f"{file}: no such file")
    if len(files) not in (1, len(slots)):
        raise ValueError(f"got {len(files)} characters for {len(slots)} people: give one for all, or one for each")
    places = paths_of(path, slots)
    if same := [place for place in places for file in files if place.exists() and place.samefile(file)]:
        raise ValueError(f"{same[0]}: is the character's own file, and would be written over; give OUT another name")
    for p, place in enumerate(places):
        WRITERS[suffix](people.select([p]), place, body, files[p if len(files) > 1 else 0], options)
    return places


# -- how it moves ------------------------------------------------------------------------------


def moved_as(scene: Scene, body: Body, skeleton: Skeleton) -> Moved:
    """A skeleton that moves as the one person of a scene."""
    M = UP[skeleton.up]
    rest_ours = body.rest_joints(scene.betas[0, 0].cpu())
    # Large shape numbers make a body lean as it rests: it counts from there, too.
    leans = rest_frame(rest_ours.double().numpy(), {j: j for j in range(BODY_JOINTS)}, skeleton.file.path)
    skeleton = replace(skeleton, R_rest_ours=skeleton.R_rest_ours @ leans.T)
    aligned, source = rests_aligned(skeleton, rest_ours.double()), sources(skeleton)
    if not rests_upright(skeleton, rest_ours.double()):
        raise ValueError(
            f"{skeleton.file.path}: its zero pose is no pose of a person, legs are folded up beside the trunk: give "
            "the character as it stands, such as a .glb with its mesh"
        )
    R, at = body.bone_chain(scene.body_rot[0, :, 0].cpu(), scene.T_world_root[0, :, 0].cpu(), rest_ours)
    turned = {
        k: M.T @ R[:, j].double().numpy() @ aligned[j].T.numpy()
        for j, k in (source | {j: skeleton.naming.joints[j] for j in COLLARS if j in skeleton.naming.joints}).items()
        if bool(aligned[j].isfinite().all())
    }
    pelvis, ours = skeleton.chain[0], skeleton.naming.joints
    rest = skeleton.metres * (skeleton.file.rest() + skeleton.file.offsets[0]) @ M.T  # y up, metres
    hips = at[:, list(HIPS)].double().mean(dim=1).numpy()
    stands = standing(body, scene.betas[0, 0].cpu()).numpy()
    longer = _leg(rest, ours) / _leg(stands, {j: j for j in ours})
    own, theirs = float(stands[list(ANKLES), 1].mean()), _ankles(rest, stands, ours, longer)
    hips[:, 1] = theirs + (hips[:, 1] - own) * longer
    to_hips = rest[[ours[j] for j in HIPS]].mean(axis=0) - rest[pelvis]
    world = M @ turned[pelvis] @ M.T  # rotations of rest poses that were turned to y up
    return Moved(turned, pelvis, (hips - world @ to_hips) @ M / skeleton.metres)


def _leg(rest: Floats, ours: Mapping[int, int]) -> float:
    """The length of a leg in a rest pose. rest (K, 3)"""
    bones = [rest[ours[a]] - rest[ours[b]] for a, b in zip((*HIPS, *KNEES), (*KNEES, *ANKLES), strict=True)]
    return float(np.linalg.norm(bones, axis=-1).sum()) / 2


def _ankles(rest: Floats, stands: Floats, ours: Mapping[int, int], longer: float) -> float:
    """How high ankles are over the floor in a rest pose; one that does not stand near 0 does not say where it is.

    rest (K, 3), stands (22, 3) our body's at rest on the floor, metres, y up; longer: how much legs are -> metres
    """
    lowest = float(rest[:, 1].min())
    floor = 0.0 if 0.0 <= lowest <= FLOOR else lowest - longer * float(stands[:, 1].min())
    return float(rest[[ours[j] for j in ANKLES], 1].mean()) - floor


# -- BVH ---------------------------------------------------------------------------------------


def _onto_bvh(scene: Scene, path: Path, body: Body, rig: Path, options: RigOptions) -> None:
    file = read_bvh(rig)
    (skeleton,) = understood_together([file], options.unit, options.up, options.joints)
    moved = moved_as(scene, body, skeleton)
    if moved.pelvis != 0:
        raise ValueError(f"{rig}: its root {file.names[0]} is not its pelvis; write a .glb, or take the hips as root")
    local = local_of(file, moved.turned, scene.frames)
    degrees = euler_zxy(local)[:, depth_first(file.parents)]
    rows = [
        " ".join(f"{number:.6f}" for number in (*place, *angles.ravel()))
        for place, angles in zip(moved.at, degrees, strict=True)
    ]
    offsets = file.offsets.copy()
    offsets[0] = 0.0
    write_text(path, bvh_text(file.names, file.parents, offsets, _tips(rig), "ZXY", rows, scene.fps))


def local_of(file: RigMotion, turned: Mapping[int, Floats], frames: int) -> Floats:
    """Rotations relative to the parent; joints that nothing turns stay on it as they rest. -> (T, K, 3, 3)"""
    world: list[Floats] = []
    local = np.empty((frames, len(file.names), 3, 3))
    for k, parent in enumerate(file.parents):
        above = world[parent] if parent >= 0 else np.broadcast_to(np.eye(3), (frames, 3, 3))
        world.append(turned.get(k, above))
        local[:, k] = np.swapaxes(above, -1, -2) @ world[k]
    return local


def _tips(rig: Path) -> dict[int, Floats]:
    """The End Sites of a BVH, by the joint that they end."""
    header = bvh_header(bvh_lines(rig), rig)
    number = {k: i for i, k in enumerate(k for k, joint in enumerate(header.joints) if not joint.end)}
    return {number[joint.parent]: np.nan_to_num(np.array(joint.offset)) for joint in header.joints if joint.end}


# -- GLB ---------------------------------------------------------------------------------------


def _onto_glb(scene: Scene, path: Path, body: Body, rig: Path, options: RigOptions) -> None:
    character = read_rig(rig, options.joints)
    up = options.up or character.rig.up
    (skeleton,) = understood_together([character.rig], options.unit, up, options.joints)
    moved = moved_as(scene, body, skeleton)
    with whole(path) as part:
        part.write_bytes(_animated(character, moved, scene.frames, scene.fps))


def _animated(character: GlbRig, moved: Moved, frames: int, fps: float) -> bytes:
    """The character's file with one animation, in place of those that it had."""
    file, joints = character.file, character.joints
    with in_one_line(file.path):
        gltf = Gltf(*file.in_one())
    clip = animation("motion")
    times = gltf.accessor(frame_times(frames, fps), FLOAT, "SCALAR", bounds=True)

    def track(node: int, what: str, values: Tensor) -> None:
        said = gltf.document["nodes"][node]
        if said.pop("matrix", None) is not None:  # which a node that moves may not have
            said |= {key: value.tolist() for key, value in file.resting(node).items()}
        gltf.track(clip, times, node, what, values)

    world = {joints[k]: turned @ character.turn[k] for k, turned in moved.turned.items()}
    for node in joints:
        if node in world:
            above = np.eye(3) if node not in file.parents else _turn_of(character, file.parents[node], world)
            local = np.swapaxes(above, -1, -2) @ world[node]
            track(node, "rotation", unbroken(to_quat(torch.from_numpy(np.broadcast_to(local, (frames, 3, 3)).copy()))))
    pelvis = joints[moved.pelvis]
    above = file.at_rest(file.parents[pelvis]) if pelvis in file.parents else np.eye(4)
    back = np.linalg.inv(above)
    track(pelvis, "translation", torch.from_numpy(moved.at @ back[:3, :3].T + back[:3, 3]))
    gltf.document["animations"] = [clip]
    return gltf.packed()


def _turn_of(character: GlbRig, node: int, world: Mapping[int, Floats]) -> Floats:
    """A node's world rotation: of one that is turned, else as it rests on the next such node above."""
    line = [node, *character.file.above(node)]
    first = next((k for k, each in enumerate(line) if each in world), len(line))
    turn: Floats = world[line[first]] if first < len(line) else np.eye(3)
    for each in reversed(line[:first]):
        rest = character.file.resting(each)
        turn = turn @ matrices(np.zeros((1, 3)), rest["rotation"][None], np.ones((1, 3)))[0, :3, :3]
    return turn


def _onto_fbx(scene: Scene, path: Path, body: Body, rig: Path, options: RigOptions) -> None:
    with tempfile.TemporaryDirectory() as folder:
        glb, made = converted(rig, Path(folder) / "rig.glb"), Path(folder) / "moved.glb"
        try:
            _onto_glb(at_whole_rate(scene), made, body, glb, options)
        except ValueError as error:
            raise ValueError(str(error).replace(str(glb), str(rig))) from error
        as_fbx(made, path, scene.fps)


WRITERS: dict[str, Callable[[Scene, Path, Body, Path, RigOptions], None]] = {
    ".bvh": _onto_bvh,
    ".glb": _onto_glb,
    ".fbx": _onto_fbx,
}
"""Suffixes, and what writes characters so."""

RIGS_FOR = {".bvh": (".bvh",), ".glb": (".glb", ".gltf", ".vrm"), ".fbx": (".fbx",)}
"""The characters that can be written with a suffix."""
