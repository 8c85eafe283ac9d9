"""Scenes as SMPL-X style npz files, for tools that read AMASS-like data, and back."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
import roma
import torch
from torch import Tensor

from magnet.motion.frames import rigid
from magnet.motion.scene import BODY_JOINTS, Scene

SMPLX_JOINTS = 55


class Shaped(Protocol):
    """What these files ask of a body model: where its joints rest."""

    id: str

    def rest_joints(self, betas: Tensor) -> Tensor: ...


def save_smplx(scene: Scene, path: str | Path, body: Shaped, *, apart: bool = False) -> list[Path]:
    """Write one scene (B = 1, present agents) with SMPL-X's conventional keys.

    poses (P, T, 165) axis-angle in radians, fingers, jaw and eyes at rest; transl and its other name trans (P, T, 3) =
    pelvis - J0(betas), metres, y up; betas (P, 10); gender, mocap_frame_rate, surface_model_type; `body` says which
    body model the betas belong to. Only SMPL-X's own betas look right in SMPL-X tools.

    Args:
        apart: one file a person (path_0.npz, ...) without the axis P, as most tools read them.

    Returns:
        The paths written.

    Raises:
        ValueError: more than one scene, or another body's.
    """
    if scene.scenes != 1:
        raise ValueError(f"got {scene.scenes} scenes, expected one; write each of scene.pick([b]) to a file of its own")
    if scene.body != body.id:
        raise ValueError(f"the scene belongs to body {scene.body!r}, but {body.id!r} was given")
    scene = scene.order(scene.present[0].nonzero()[:, 0])
    T_world_root = scene.T_world_root[0].transpose(0, 1).double()  # (P, T, 4, 4)
    rotations = torch.cat([T_world_root[..., None, :3, :3], scene.body_rot[0].transpose(0, 1).double()], dim=2)
    poses = torch.zeros(*rotations.shape[:2], 3 * SMPLX_JOINTS, dtype=torch.float64)
    poses[..., : 3 * BODY_JOINTS] = roma.rotmat_to_rotvec(rotations).flatten(-2).cpu()
    rest_pelvis = body.rest_joints(scene.betas[0])[:, 0].double()
    transl = (T_world_root[..., :3, 3] - rest_pelvis[:, None]).cpu().numpy()
    arrays = {"poses": poses.numpy(), "transl": transl, "trans": transl, "betas": scene.betas[0].cpu().numpy()}
    facts = {
        "gender": np.array("neutral"),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(scene.fps),
        "body": np.array(scene.body),
        "name": np.array(scene.names[0] if scene.names else ""),
    }
    path = Path(path).with_suffix(".npz")
    path.parent.mkdir(parents=True, exist_ok=True)
    if not apart:
        np.savez_compressed(path, **arrays, **facts)  # type: ignore[arg-type]
        return [path]
    paths = [path.with_name(f"{path.stem}_{p}.npz") for p in range(scene.agents)]
    for p, each in enumerate(paths):
        np.savez_compressed(each, **{key: value[p] for key, value in arrays.items()}, **facts)  # type: ignore[arg-type]
    return paths


def load_smplx(path: str | Path, body: Shaped) -> Scene:
    """Read what `save_smplx` wrote, one person or several. -> Scene with B = 1, float32

    Raises:
        ValueError: no such file's keys or shapes, or another body's.
    """
    with np.load(path, allow_pickle=False) as file:
        wanted = {"poses", "transl", "betas", "mocap_frame_rate"}
        missing = sorted(wanted - set(file.files))
        if missing:
            raise ValueError(f"{path}: lacks {', '.join(missing)}; it has {', '.join(sorted(file.files))}")
        poses, transl, betas = (torch.from_numpy(file[key]).double() for key in ("poses", "transl", "betas"))
        fps = float(file["mocap_frame_rate"])
        written_for = str(file["body"]) if "body" in file.files else body.id
        name = str(file["name"]) if "name" in file.files else ""
    if written_for != body.id:
        raise ValueError(f"{path}: written for body {written_for!r}, but {body.id!r} was given")
    if poses.ndim == 2:
        poses, transl, betas = poses[None], transl[None], betas[None]
    P, T = poses.shape[:2]
    if poses.ndim != 3 or poses.shape[-1] < 3 * BODY_JOINTS or transl.shape != (P, T, 3) or betas.shape != (P, 10):
        shapes = f"poses {tuple(poses.shape)}, transl {tuple(transl.shape)}, betas {tuple(betas.shape)}"
        raise ValueError(f"{path}: got {shapes}, expected (P, T, 66 or more), (P, T, 3), (P, 10)")
    rotations = roma.rotvec_to_rotmat(poses[..., : 3 * BODY_JOINTS].unflatten(-1, (BODY_JOINTS, 3)))
    pelvis = transl + body.rest_joints(betas.float())[:, 0].double()[:, None]
    T_world_root = rigid(rotations[:, :, 0], pelvis)
    return Scene(
        body_rot=rotations[:, :, 1:].transpose(0, 1)[None].float(),
        T_world_root=T_world_root.transpose(0, 1)[None].float(),
        betas=betas[None].float(),
        present=torch.ones(1, P, dtype=torch.bool),
        fps=fps,
        body=body.id,
        names=(name,) if name else (),
    )
