"""USD, opened and posed by Pixar's own library: joints where the body's are, skin where its vertices are."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from magnet.body import Body
from magnet.export.bones import BoneOptions
from magnet.export.drawing import AGENTS
from magnet.export.glb import linear
from magnet.export.usd import joint_paths, save_usd
from magnet.extras import installing
from magnet.testing import random_scene


def posed(path: Path, frame: int) -> list[tuple[dict[str, Any], np.ndarray]]:
    """World positions of each person's joints, and vertices as UsdSkel skins them."""
    from pxr import Usd, UsdGeom, UsdSkel, Vt

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    cache, found = UsdSkel.Cache(), []
    for prim in stage.Traverse():
        if not prim.IsA(UsdSkel.Root):
            continue
        root = UsdSkel.Root(prim)
        cache.Populate(root, Usd.PrimDefaultPredicate)
        (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
        query = cache.GetSkelQuery(binding.GetSkeleton())
        places = query.ComputeJointSkelTransforms(Usd.TimeCode(frame))
        names = [name.rpartition("/")[2] for name in query.GetJointOrder()]
        (skinning,) = binding.GetSkinningTargets()
        points = Vt.Vec3fArray(UsdGeom.Mesh(skinning.GetPrim()).GetPointsAttr().Get())
        assert skinning.ComputeSkinnedPoints(query.ComputeSkinningTransforms(Usd.TimeCode(frame)), points, frame)
        joints = {name: np.array(m.ExtractTranslation()) for name, m in zip(names, places, strict=True)}
        found.append((joints, np.array(points)))
    return found


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usdz"])
def test_pixars_library_poses_joints_and_skin_where_the_body_has_them(suffix: str, body: Body, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    scene = random_scene(1, 9, 2, torch.Generator().manual_seed(4))
    bones = BoneOptions(root="none") if suffix == ".usda" else BoneOptions()
    path = save_usd(scene, tmp_path / f"duo{suffix}", body, bones)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    joints, vertices = body.joints(scene)[0].numpy(), body.vertices(scene)[0].numpy()
    for frame in (0, 8):
        people = posed(path, frame)
        assert len(people) == 2
        for person, (found, points) in enumerate(people):
            assert ("root" in found) == (bones.root == "floor")
            there = np.stack([place for name, place in found.items() if name != "root"])
            assert np.abs(there - joints[frame, person]).max() < 1e-4
            assert np.abs(points - vertices[frame, person]).max() < 1e-4


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_the_stage_says_its_rate_and_its_first_and_last_frame(fps: float, body: Body, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    scene = random_scene(1, 9, 1, torch.Generator().manual_seed(4)).replace(fps=fps)
    stage = usd.Stage.Open(str(save_usd(scene, tmp_path / "solo.usda", body)))
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == fps
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 8)


@pytest.mark.parametrize("root", ["floor", "none"])
def test_at_rest_joints_are_where_the_mesh_is_bound_to_them(root: Any, body: Body, tmp_path: Path) -> None:
    """Standing on the floor in the person's own shape and colour."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdSkel

    scene = random_scene(1, 3, 2, torch.Generator().manual_seed(4))
    stage = Usd.Stage.Open(str(save_usd(scene, tmp_path / "duo.usda", body, BoneOptions(root=root))))
    cache = UsdSkel.Cache()
    for slot in range(2):
        prim = stage.GetPrimAtPath(f"/scene/person_{slot}")
        cache.Populate(UsdSkel.Root(prim), Usd.PrimDefaultPredicate)
        skeleton = UsdSkel.Skeleton(prim.GetChild("skeleton"))
        resting = cache.GetSkelQuery(skeleton).ComputeJointSkelTransforms(Usd.TimeCode(0), atRest=True)
        rest, bound = np.array(resting), np.array(skeleton.GetBindTransformsAttr().Get())
        assert np.abs(rest - bound).max() < 1e-6
        mesh = UsdGeom.Mesh(prim.GetChild("body"))
        points, (low, high) = np.array(mesh.GetPointsAttr().Get()), np.array(mesh.GetExtentAttr().Get())
        assert abs(points[:, 1].min()) < 1e-5
        np.testing.assert_allclose([low, high], [points.min(axis=0), points.max(axis=0)])
        joints = body.rest_joints(scene.betas[0, slot]).numpy()
        own = bound[-22:, 3, :3]
        assert np.abs((own - own[0]) - (joints - joints[0])).max() < 1e-5
        assert mesh.GetSubdivisionSchemeAttr().Get() == "none", "triangles are not smoothed"
        np.testing.assert_allclose(mesh.GetDisplayColorAttr().Get()[0], linear(AGENTS[slot]), atol=1e-6)


def test_people_keep_their_numbers(body: Body, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    scene = random_scene(1, 3, 4, torch.Generator().manual_seed(4))
    some = scene.replace(present=torch.tensor([[False, True, False, True]]))
    stage = usd.Stage.Open(str(save_usd(some, tmp_path / "some.usda", body)))
    assert [prim.GetName() for prim in stage.GetDefaultPrim().GetChildren()] == ["person_1", "person_3"]


def test_without_the_package_the_extra_is_named(body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ImportError, match=re.escape(installing("usd"))):
        save_usd(random_scene(1, 4, 1, torch.Generator().manual_seed(4)), tmp_path / "a.usda", body)


def test_joints_have_names_that_usd_takes() -> None:
    assert joint_paths(["mixamorig:Hips"]) == ["mixamorig_Hips"]
