"""Scenes as SMPL-X style npz files, for tools that read AMASS-like data, and back."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from magnet.body import Body
from magnet.export.bvh import person_file
from magnet.export.rig import UNITS, UP
from magnet.export.smpl_keys import (
    BODY,
    ORIENT,
    OWN_SHAPE,
    PLACE,
    RATE,
    SCALE,
    SHAPE,
    SMPLX_PELVIS,
    WHOLE,
    first_of,
    in_world,
    rotations,
)
from magnet.export.upright import LONG, WARNING, Stance, axis_of, stance
from magnet.files import DAMAGED, load_npz, save_npz, suffixed
from magnet.motion.frames import rigid
from magnet.motion.required import require_body, require_one
from magnet.motion.rotations import from_rotvec, to_rotvec
from magnet.motion.scene import BODY_JOINTS, Scene

SMPLX_JOINTS = 55
STANDING, LYING = (0.4, 1.4), 0.15
"""Metres of a pelvis over the floor: of who stands or sits, and at least."""
HIGHEST, MOST_TURNED = 30.0, 9.0
"""Metres of a pelvis over the floor, and radians of a turn, which files in metres and radians do not hold."""


def save_smplx(scene: Scene, path: str | Path, body: Body, *, apart: bool = False) -> list[Path]:
    """Write one scene (B = 1, present agents) with SMPL-X's conventional keys.

    poses (P, T, 165) axis-angle in radians, fingers, jaw and eyes at rest; transl and its other name trans (P, T, 3) =
    pelvis - J0(betas), metres, y up; betas (P, 10); gender, mocap_frame_rate, surface_model_type. Beside these `body`
    says which body model the scene is of, and `given` (P, T), where the scene has it, what a model was given.
    The open body's shapes mean nothing to SMPL-X: its betas are written as zero, J0 is that of SMPL-X's mean shape, so
    that pelvises are right in SMPL-X's tools, and `body_betas` (P, 10) keeps the shapes for `read_smplx`.

    Args:
        apart: one file per person (path_person0.npz ... by slot) without the axis P, as most tools expect.

    Returns:
        The paths written.

    Raises:
        ValueError: more than one scene, nobody present, or another body's.
    """
    require_one(scene)
    require_body(scene, body.id)
    if not bool(scene.present.any()):
        raise ValueError("nobody is present in the scene, so there is nobody to write")
    slots = scene.present[0].nonzero()[:, 0]
    scene = scene.permute_agents(slots)
    T_world_root = scene.T_world_root[0].transpose(0, 1).double()  # (P, T, 4, 4)
    turned = torch.cat([T_world_root[..., None, :3, :3], scene.body_rot[0].transpose(0, 1).double()], dim=2)
    poses = torch.zeros(*turned.shape[:2], 3 * SMPLX_JOINTS, dtype=torch.float64)
    poses[..., : 3 * BODY_JOINTS] = to_rotvec(turned).flatten(-2).cpu()
    own = is_open(body)
    rest_pelvis = _smplx_pelvis(T_world_root) if own else body.rest_joints(scene.betas[0])[:, 0].double()
    transl = (T_world_root[..., :3, 3] - rest_pelvis[:, None]).cpu().numpy()
    betas = scene.betas[0].cpu().numpy()
    arrays = {
        "poses": poses.numpy(),
        "transl": transl,
        "trans": transl,
        "betas": np.zeros_like(betas) if own else betas,
    }
    if own:
        arrays[OWN_SHAPE] = betas
    if scene.given is not None:
        arrays["given"] = scene.given[0].T.cpu().numpy()
    facts = {
        "gender": np.array("neutral"),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(scene.fps),
        "body": np.array(scene.body),
        "name": np.array(scene.names[0] if scene.names else ""),
    }
    path = suffixed(path, ".npz")
    if not apart:
        save_npz(path, arrays | facts)
        return [path]
    paths = each_of(path, slots.tolist())
    for p, each in enumerate(paths):
        save_npz(each, {key: value[p] for key, value in arrays.items()} | facts)
    return paths


def each_of(path: Path, slots: Sequence[int]) -> list[Path]:
    """The files of people in these slots, written apart: out_person0.npz, out_person1.npz ..."""
    return [person_file(path, slot) for slot in slots]


def is_open(body: Body) -> bool:
    """Whether shapes of this body are not SMPL-X's."""
    return body.id.startswith("open")


def _smplx_pelvis(like: Tensor) -> Tensor:
    """(1, 3), metres"""
    return like.new_tensor([SMPLX_PELVIS])


def load_smplx(path: str | Path, body: Body, up: str | None = None) -> Scene:
    """As `read_smplx`, the scene alone."""
    return read_smplx(path, body, up)[0]


def read_smplx(
    path: str | Path, body: Body, up: str | None = None, unit: str | None = None, in_fps: float | None = None
) -> tuple[Scene, str]:
    """Read a SMPL-X style npz, of `save_smplx` or of other tools, one person or several.

    Also read: every name that `magnet.export.smpl_keys` knows (`trans`, `root_orient` and `pose_body`,
    `global_orient` and `body_pose`, ...), rotations as matrices or joint by joint, more or fewer than ten betas (the
    first ten count; the median where a person has several rows), no betas (zero). A file that does not name its body
    is SMPL-X's: its betas are taken if `body` is not the open one, and are zero otherwise, with SMPL-X's mean J0.

    Args:
        path: the file.
        body: whose shapes the scene will have.
        up: axis of the file that points up, one of `magnet.export.rig.UP`. None: y in files of ours, in others the
            axis along which pelvises stand.
        unit: of the file's lengths, one of `magnet.export.rig.UNITS`; None: metres, refused where nobody is so high.
        in_fps: frames a second of a file that does not say it.

    Returns:
        The scene, B = 1, float32; and the axis of the file that points up.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no such file's keys or shapes, or another body's; no such unit, or another one than is said; no
            frame rate, or another one than is said; turns in degrees.
    """
    if unit is not None and unit not in UNITS:
        raise ValueError(f"unit {unit!r}: expected one of {', '.join(name for name in UNITS if ' ' not in name)}")
    arrays, fps, written_for, name = _read(Path(path), in_fps)
    if written_for is not None and written_for != body.id:
        raise ValueError(f"{path}: written for body {written_for!r}, but {body.id!r} was given")
    poses, transl, betas = arrays["poses"], arrays["transl"], arrays.get(OWN_SHAPE, arrays["betas"])
    of_smplx = OWN_SHAPE in arrays or (written_for is None and is_open(body))  # transl is, betas are not
    if poses.ndim == 2:
        poses, transl, betas = poses[None], transl[None], betas[None]
    if betas.ndim == 3 and betas.shape[1]:  # a row a frame, or one for all
        betas = betas.quantile(0.5, dim=1)
    P, T = poses.shape[:2]
    fits = poses.ndim == 3 and poses.shape[-1] >= 3 * BODY_JOINTS and transl.shape == (P, T, 3)
    if not fits or betas.ndim != 2 or len(betas) != P:
        shapes = f"poses {tuple(poses.shape)}, transl {tuple(transl.shape)}, betas {tuple(betas.shape)}"
        raise ValueError(f"{path}: got {shapes}, expected (P, T, 66 or more), (P, T, 3), (P, 10)")
    betas = torch.nn.functional.pad(betas[:, :10], (0, max(0, 10 - betas.shape[1])))
    if written_for is None and is_open(body):
        betas = torch.zeros_like(betas)
    _require_radians(path, poses)
    turned = from_rotvec(poses[..., : 3 * BODY_JOINTS].unflatten(-1, (BODY_JOINTS, 3)))
    rest_pelvis = _smplx_pelvis(transl) if of_smplx else body.rest_joints(betas.float())[:, 0].double()
    pelvis = transl * UNITS[unit or "m"] + rest_pelvis[:, None]
    T_world_root = rigid(turned[:, :, 0], pelvis)
    if up is None:
        up = "y" if written_for is not None else _standing(T_world_root)
    if up not in UP:
        raise ValueError(f"up axis {up!r}: expected one of {', '.join(UP)}")
    T_world_root = T_world_root.new_tensor(np.block([[UP[up], np.zeros((3, 1))], [np.eye(4)[3:]]])) @ T_world_root
    if unit is None:
        _require_metres(path, T_world_root)
    scene = Scene(
        body_rot=turned[:, :, 1:].transpose(0, 1)[None].float(),
        T_world_root=T_world_root.transpose(0, 1)[None].float(),
        betas=betas[None].float(),
        present=torch.ones(1, P, dtype=torch.bool),
        fps=fps,
        body=body.id,
        names=(name,) if name else (),
        given=None if "given" not in arrays else arrays["given"].view(P, T).T[None],
    )
    return scene, up


def _require_radians(path: str | Path, poses: Tensor) -> None:
    """Refuse turns that nobody writes in radians, where half a turn is pi. poses (P, T, 66 or more)"""
    turn = poses[..., : 3 * BODY_JOINTS].unflatten(-1, (BODY_JOINTS, 3)).norm(dim=-1).nan_to_num()
    if (turn > MOST_TURNED).any(dim=-1).float().mean() > 0.5:
        raise ValueError(f"{path}: poses: turns of up to {float(turn.max()):.0f} radians; degrees? Divide by 180 / pi")


def _require_metres(path: str | Path, T_world_root: Tensor) -> None:
    """Refuse pelvises so high that their unit is another. (P, T, 4, 4) in the world"""
    if not T_world_root.numel():
        return
    height = float(T_world_root[..., 1, 3].nan_to_num().median(dim=1).values.abs().max())
    if height > HIGHEST:
        raise ValueError(
            f"{path}: pelvises are {height:.0f} m over or under the floor; say the unit of lengths: --in_unit cm or mm "
            "(unit=...), or m if they are"
        )


def _standing(T_world_root: Tensor) -> str:
    """The axis of a file's world that points up, by where pelvises do. (P, T, 4, 4) -> a key of `UP`"""
    return axis_of(T_world_root[..., :3, 1].mean(dim=(0, 1)).numpy())


def stance_in(scene: Scene, body: Body, up: str, sure: bool) -> Stance:
    """What the people of a file tell of its axis that points up, which was found as `up` or is known for sure."""
    M, leg = UP[up], float(body.rest_joints(torch.zeros(10))[[1, 7], 1].diff().abs())
    joints = body.joints(scene)[0].double().numpy() @ M / leg  # in the file's axes
    torso = scene.T_world_root[0, ..., :3, 1].double().numpy() @ M
    each = [stance(torso[:, p], joints[:, p], joints[:, p, 0]) for p in range(scene.agents)]
    moved = np.max([one.moved for one in each], axis=0)
    return Stance(up, up, up if sure else None, moved, np.min([one.low for one in each], axis=0))


def clear_axes(scene: Scene, up: str) -> list[str]:
    """Along which axis of their file people stand who were read with `up`; `up` itself for whom it is not clear."""
    torsos = scene.T_world_root[..., :3, 1].double().mean(dim=1)[scene.present].cpu().numpy() @ UP[up]
    return [axis_of(torso) if np.abs(torso).max() >= LONG else up for torso in torsos]


def unit_against(scenes: Sequence[Scene], unit: str) -> list[str]:
    """A warning where the unit that was said leaves nobody at a person's height, and another does."""
    heights = [float(scene.T_world_root[..., 1, 3].median()) for scene in scenes if scene.frames]
    if not heights or any(LYING <= height <= STANDING[1] for height in heights):
        return []
    rest = SMPLX_PELVIS[1]  # is in metres whatever the unit of places
    for other in ("m", "cm", "mm"):
        as_other = [(height - rest) / UNITS[unit] * UNITS[other] + rest for height in heights]
        if all(STANDING[0] <= height <= STANDING[1] for height in as_other):
            return [
                f"{WARNING}unit {unit}, as said, puts pelvises {heights[0]:.2g} m over y = 0; the files look like "
                f"{other}: --in_unit {other} (unit={other!r})"
            ]
    return []


def _number(path: Path, key: str, file: Mapping[str, np.ndarray], what: str) -> float:
    """A number, which some programs write as an array of one."""
    try:
        (number,) = np.ravel(file[key]).tolist()
        return float(number)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {key}: expected one number, {what}") from error


def _read(path: Path, in_fps: float | None) -> tuple[dict[str, Tensor], float, str | None, str]:
    """Arrays by our keys, frames a second, the body that the file was written for if it says so, and its name."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with load_npz(path) as archive:
            file = in_world(archive)
            there = set(file)
            ours = {"body", "surface_model_type"} <= there  # other programs may mean something else by `body`
            _require_keys(path, there, ours, in_fps)
            poses, transl = rotations(path, file), file[first_of(("transl", *PLACE), there) or ""]
            if SCALE in there:
                transl = transl / _number(path, SCALE, file, "by which translations are divided")
            fps, shape = _rate(path, file, in_fps), first_of(SHAPE, there)
            betas = np.zeros((*poses.shape[:-2], 10)) if shape is None else file[shape]
            written_for = str(file["body"]) if ours else None
            name = str(file["name"]) if "name" in there else ""
            own = file[OWN_SHAPE] if written_for is not None and OWN_SHAPE in there else None
            given = file["given"] if written_for is not None and "given" in there else None
    except (OSError, *DAMAGED) as error:
        raise ValueError(f"{path}: not a readable npz ({error}); copy or download it again") from error
    arrays = {"poses": poses, "transl": transl, "betas": betas} | ({} if own is None else {OWN_SHAPE: own})
    bad = [name for name, array in arrays.items() if array.dtype.kind not in "iuf" or not np.isfinite(array).all()]
    if bad or not 0 < fps < float("inf"):
        cut = "; cut frames without them out, as magnet data prepare does" if bad else ""
        raise ValueError(f"{path}: {', '.join(bad) or 'mocap_frame_rate'}: expected finite numbers{cut}")
    tensors = {name: torch.from_numpy(array.astype(np.float64)) for name, array in arrays.items()}
    if given is not None:
        if given.dtype != bool or given.shape != poses.shape[:-1]:
            raise ValueError(f"{path}: given: got {given.dtype} {given.shape}, expected bool {poses.shape[:-1]}")
        tensors["given"] = torch.from_numpy(given)
    return tensors, fps, written_for, name


def _require_keys(path: Path, there: Collection[str], ours: bool, in_fps: float | None) -> None:
    """Refuse a file without motion or rate, by our names of what is missing."""
    whole = first_of(WHOLE, there) or (first_of(ORIENT, there) and first_of(BODY, there))
    unrated = in_fps is None and not first_of(RATE, there)
    missing = ["mocap_frame_rate"] * unrated + ["poses"] * (not whole) + ["transl"] * (not first_of(PLACE, there))
    if ours and "betas" not in there:
        missing.insert(0, "betas")
    if missing:
        fix = "; say the frames a second: --in_fps 30 (in_fps=30)" if unrated else ""
        if not whole and not first_of(PLACE, there):
            fix = "; positions of joints are read from a table, .csv (docs/export.md)" + fix
        raise ValueError(f"{path}: lacks {', '.join(missing)}; it has {', '.join(sorted(there))}{fix}")


def _rate(path: Path, file: Mapping[str, np.ndarray], in_fps: float | None) -> float:
    """Frames a second, of the file or, where it says nothing, as given."""
    key = first_of(RATE, file.keys())
    fps = in_fps if key is None else _number(path, key, file, "frames a second")
    assert fps is not None  # `_require_keys`
    require_own_rate(path, fps, in_fps)
    return fps


def require_own_rate(path: str | Path, fps: float, in_fps: float | None) -> None:
    """Refuse to call the frame rate of a file another than it says.

    Raises:
        ValueError: `in_fps`, frames a second, is given, and is not what the file says.
    """
    if in_fps is not None and abs(fps - in_fps) > 1e-6:
        raise ValueError(
            f"{path}: says {fps:g} frames a second; --in_fps {in_fps:g} is for files that say nothing, --fps resamples"
        )
