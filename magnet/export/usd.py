"""Scenes as USD, everybody skinned in one world, for Omniverse, Houdini, Maya, Blender and Apple's viewers."""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from magnet.body import Body
from magnet.body.joints import PARENTS
from magnet.export.bones import BoneOptions, bone_names
from magnet.export.drawing import AGENTS
from magnet.export.glb import INFLUENCES, influences, linear, moved, slots_to_write, standing, standing_vertices
from magnet.extras import installing
from magnet.files import whole
from magnet.motion.scene import Scene

ROOT = "root"


def require_usd() -> None:
    """Refuse where usd-core is not installed."""
    if importlib.util.find_spec("pxr") is None:
        raise ImportError(f".usda, .usdc and .usdz need usd-core: {installing('usd')}")


def save_usd(scene: Scene, path: str | Path, body: Body, bones: BoneOptions = BoneOptions()) -> Path:
    """Write one scene (B = 1) as UsdSkel: metres, y up, a time code for every frame of the scene.

    Each person present is `/scene/person_0` ..., numbered by slot, with a skeleton of 22 joints, on the floor at rest,
    its animation and a mesh skinned to it in the slot's colour. The suffix says which kind of USD: text (.usda), binary
    (.usdc) or packed (.usdz). Returns the path written.

    Args:
        bones: names and hierarchy of joints; USD always has one animation per skeleton.

    Raises:
        ImportError: usd-core is not installed.
        ValueError: more than one scene, nobody present, no frames, or another body's.
    """
    require_usd()
    from pxr import Tf, UsdUtils

    slots = slots_to_write(scene, body)
    path = Path(path)
    packed = path.suffix.lower() == ".usdz"
    with tempfile.TemporaryDirectory() as folder:  # usd-core does not always say that a disk is full; a copy does
        plain = Path(folder) / (f"{path.stem}.usdc" if packed else path.name)
        made = Path(folder) / "packed.usdz" if packed else plain
        try:
            _save_stage(scene, plain, body, bones, slots)
            if packed:
                UsdUtils.CreateNewUsdzPackage(str(plain), str(made))
        except Tf.ErrorException as error:
            said = str(error).strip().splitlines()[-1].strip()
            raise OSError(f"{path}: usd-core could not write it: {said}") from error
        with whole(path) as part:
            shutil.copyfile(made, part)
    return path


def _save_stage(scene: Scene, path: Path, body: Body, bones: BoneOptions, slots: Sequence[int]) -> None:
    from pxr import Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(scene.fps)
    stage.SetFramesPerSecond(scene.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(scene.frames - 1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
    for slot in slots:
        betas = scene.betas[0, slot].detach().cpu().float()
        place, turns = moved(scene, slot, bones.root == "floor")
        root = UsdSkel.Root.Define(stage, f"/scene/person_{slot}")
        _skeleton(stage, root, standing(body, betas), bones, place, turns)
        _skin(stage, root, standing_vertices(body, betas), body, slot)
    stage.GetRootLayer().Save()


def _skeleton(stage: Any, root: Any, rest: Tensor, bones: BoneOptions, place: Tensor, turns: Tensor) -> None:
    """A person's joints at rest and in motion. rest (22, 3), place (T, n, 3), turns (T, J, 4) as x y z w"""
    from pxr import Gf, UsdSkel, Vt

    extra = [ROOT] if bones.root == "floor" else []
    paths = joint_paths(bone_names(bones.names), extra)
    at = np.concatenate([np.zeros((len(extra), 3)), rest.numpy()])
    above = [*([-1] * len(extra)), *(p + len(extra) for p in PARENTS)]
    away = at - np.where(np.array(above)[:, None] < 0, 0.0, at[above])
    skeleton = UsdSkel.Skeleton.Define(stage, root.GetPath().AppendChild("skeleton"))
    skeleton.CreateJointsAttr(paths)
    # Pivots only: at rest nothing is turned.
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray([Gf.Matrix4d(1.0).SetTranslate(Gf.Vec3d(*p)) for p in at]))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray([Gf.Matrix4d(1.0).SetTranslate(Gf.Vec3d(*p)) for p in away]))
    motion = UsdSkel.Animation.Define(stage, skeleton.GetPath().AppendChild("motion"))
    motion.CreateJointsAttr(paths)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([motion.GetPath()])
    motion.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1, 1, 1)] * len(paths)))
    places, rotations = motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()
    for frame in range(len(turns)):
        moved = away.copy()
        moved[: place.shape[1]] = place[frame].numpy()
        places.Set(Vt.Vec3fArray.FromNumpy(moved.astype(np.float32)), frame)
        quaternions = [Gf.Quatf(w, x, y, z) for x, y, z, w in turns[frame].tolist()]
        rotations.Set(Vt.QuatfArray(quaternions), frame)


def joint_paths(names: Sequence[str], above: Sequence[str] = ()) -> list[str]:
    """Joints as USD names them, by the way from the first one; colons are none of its letters.

    >>> joint_paths(["pelvis", "left_hip"], above=["root"])
    ['root', 'root/pelvis', 'root/pelvis/left_hip']
    """
    paths: list[str] = []
    for name, parent in zip(names, PARENTS, strict=False):
        before = paths[parent] if parent >= 0 else "/".join(above)
        paths.append(f"{before}/{name.replace(':', '_')}".lstrip("/"))
    return [*above, *paths]


def _skin(stage: Any, root: Any, vertices: NDArray[np.float64], body: Body, slot: int) -> None:
    """A person's mesh at rest, bound to its skeleton."""
    from pxr import Gf, UsdGeom, UsdSkel, Vt

    faces = body.faces.detach().cpu().numpy()
    joints, shares = influences(body.weights.detach().cpu().double().numpy())
    skeleton = root.GetPath().AppendChild("skeleton")
    count = len(UsdSkel.Skeleton.Get(stage, skeleton).GetJointsAttr().Get())
    mesh = UsdGeom.Mesh.Define(stage, root.GetPath().AppendChild("body"))
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*linear(AGENTS[slot % len(AGENTS)]))])
    mesh.CreateExtentAttr([Gf.Vec3f(*vertices.min(0).tolist()), Gf.Vec3f(*vertices.max(0).tolist())])
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton])
    first = count - body.weights.shape[1]  # a joint on the floor, which moves no vertex, comes before the others
    indices = (joints + first).reshape(-1).astype(np.int32)
    binding.CreateJointIndicesPrimvar(False, INFLUENCES).Set(Vt.IntArray.FromNumpy(indices))
    weights = (shares / 65535).reshape(-1).astype(np.float32)
    binding.CreateJointWeightsPrimvar(False, INFLUENCES).Set(Vt.FloatArray.FromNumpy(weights))
