"""Scenes as SMPL-X style npz files, for tools that read AMASS-like data, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body import Body
from magnet.errors import first_names
from magnet.export.bvh import person_file
from magnet.export.rig import UNITS, UP, require_unit, require_up
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
from magnet.export.smpl_people import PERSON, without_gaps
from magnet.export.upright import LONG, WARNING, Stance, axis_of, stance
from magnet.files import DAMAGED, load_npz, save_npz, suffixed
from magnet.motion.frames import rigid
from magnet.motion.required import require_body, require_one
from magnet.motion.rotations import from_rotvec, to_rotvec
from magnet.motion.scene import BODY_JOINTS, Scene

_Held = tuple[dict[str, Tensor], float, str | None, str]
"""Arrays by our keys, frames a second, the body that a file was written for if it says so, and its name."""
SMPLX_JOINTS = 55
SHOWN = 20
"""Keys of a file that are named where some are missing."""
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
    Returns the paths written.

    Args:
        apart: one file per person (path_person0.npz ... by slot) without the axis P, as most tools expect.

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
    """Read a SMPL-X style npz, of `save_smplx` or of other tools, one person or several, as `scene_of` does.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a damaged file, or as `scene_of`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with load_npz(path) as archive:
            arrays = _arrays(path, archive, in_fps)
    except (OSError, ValueError, *DAMAGED) as error:
        if str(error).startswith(str(path)):  # of what it holds
            raise
        raise ValueError(f"{path}: not a readable npz ({error}); copy or download it again") from error
    return _scene_of(path, arrays, body, up, unit)


def scene_of(
    where: str | Path,
    held: Mapping[str, Any],
    body: Body,
    up: str | None = None,
    unit: str | None = None,
    in_fps: float | None = None,
) -> tuple[Scene, str]:
    """Arrays under the keys of SMPL's family as a scene, of one person or of several along the first axis.

    Also read: every name that `magnet.export.smpl_keys` knows (`trans`, `root_orient` and `pose_body`,
    `global_orient` and `body_pose`, ...), rotations as matrices or joint by joint, more or fewer than ten betas (the
    first ten count; the median where a person has several rows, of those without NaN), no betas (zero). A file that
    does not name its body is SMPL-X's: its betas are taken if `body` is not the open one, and are zero otherwise, with
    SMPL-X's mean J0.
    Frames of somebody that hold NaN hold the pose before, and are not valid.

    Args:
        where: the file, and whose numbers they are, for messages.
        held: arrays, or what numpy makes arrays of; None counts as absent.
        body: whose shapes the scene will have.
        up: axis of the file that points up, one of `magnet.export.rig.UP`. None: y in files of ours, in others the
            axis along which pelvises stand.
        unit: of the file's lengths, one of `magnet.export.rig.UNITS`; None: metres, refused where nobody is so high.
        in_fps: frames a second of a file that does not say it.

    Returns:
        The scene, B = 1, float32; and the axis of the file that points up.

    Raises:
        ValueError: no such file's keys or shapes, or another body's; no such unit, or another one than is said; no
            frame rate, or another one than is said; turns in degrees; nobody tracked in any frame.
    """
    there = {key: value for key, value in held.items() if value is not None}
    return _scene_of(where, _arrays(where, there, in_fps), body, up, unit)


def _scene_of(where: str | Path, read: _Held, body: Body, up: str | None, unit: str | None) -> tuple[Scene, str]:
    require_unit(unit)
    arrays, fps, written_for, name = read
    if written_for is not None and written_for != body.id:
        raise ValueError(f"{where}: written for body {written_for!r}, but {body.id!r} was given")
    poses, transl, betas = arrays["poses"], arrays["transl"], arrays.get(OWN_SHAPE, arrays["betas"])
    of_smplx = OWN_SHAPE in arrays or (written_for is None and is_open(body))  # transl is, betas are not
    if poses.ndim == 2:
        poses, transl, betas = poses[None], transl[None], betas[None]
    if betas.ndim == 3 and betas.shape[1]:  # a row a frame, where it was tracked, or one for all
        whole = betas.isfinite().all(dim=-1, keepdim=True)
        betas = betas.where(whole, torch.nan).nanquantile(0.5, dim=1)
    P, T = poses.shape[:2]
    fits = poses.ndim == 3 and P > 0 and poses.shape[-1] >= 3 * BODY_JOINTS and transl.shape == (P, T, 3)
    if not fits or betas.ndim != 2 or len(betas) != P:
        shapes = f"poses {tuple(poses.shape)}, transl {tuple(transl.shape)}, betas {tuple(betas.shape)}"
        raise ValueError(f"{where}: got {shapes}, expected (P, T, 66 or more), (P, T, 3), (P, 10) of P people")
    if not bool(betas.isfinite().all()):
        raise ValueError(f"{where}: betas: expected finite numbers")
    betas = torch.nn.functional.pad(betas[:, :10], (0, max(0, 10 - betas.shape[1])))
    poses, transl, valid = _without_gaps(where, poses[..., : 3 * BODY_JOINTS], transl)
    if written_for is None and is_open(body):
        betas = torch.zeros_like(betas)
    _require_radians(where, poses)
    turned = from_rotvec(poses.unflatten(-1, (BODY_JOINTS, 3)))
    rest_pelvis = _smplx_pelvis(transl) if of_smplx else body.rest_joints(betas.float())[:, 0].double()
    pelvis = transl * UNITS[unit or "m"] + rest_pelvis[:, None]
    T_world_root = rigid(turned[:, :, 0], pelvis)
    if up is None:
        up = "y" if written_for is not None else _standing(T_world_root)
    require_up(up)
    T_world_root = T_world_root.new_tensor(np.block([[UP[up], np.zeros((3, 1))], [np.eye(4)[3:]]])) @ T_world_root
    if unit is None:
        _require_metres(where, T_world_root)
    scene = Scene(
        body_rot=turned[:, :, 1:].transpose(0, 1)[None].float(),
        T_world_root=T_world_root.transpose(0, 1)[None].float(),
        betas=betas[None].float(),
        present=torch.ones(1, P, dtype=torch.bool),
        fps=fps,
        body=body.id,
        valid=valid,
        names=(name,) if name else (),
        given=None if "given" not in arrays else arrays["given"].view(P, T).T[None],
    )
    return scene, up


def _without_gaps(where: str | Path, poses: Tensor, transl: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Numbers of frames that hold NaN as in the frame before; and (1, T) whether everybody was tracked, None: always.

    poses (P, T, 66), transl (P, T, 3) -> the same
    """
    if not poses.numel():
        return poses, transl, None
    filled, tracked = [], []
    for p, parts in enumerate(zip(poses.numpy(), transl.numpy(), strict=True)):
        whole, there, _ = without_gaps(where if len(poses) == 1 else f"{where}, person {p + 1}", *parts)
        filled.append([torch.from_numpy(part) for part in whole])
        tracked.append(torch.from_numpy(there))
    valid = torch.stack(tracked).all(dim=0)
    poses, transl = (torch.stack(parts) for parts in zip(*filled, strict=True))
    return poses, transl, None if bool(valid.all()) else valid[None]


def _require_radians(where: str | Path, poses: Tensor) -> None:
    """Refuse turns that nobody writes in radians, where half a turn is pi. poses (P, T, 66)"""
    turn = poses.unflatten(-1, (BODY_JOINTS, 3)).norm(dim=-1)
    if (turn > MOST_TURNED).any(dim=-1).float().mean() > 0.5:
        raise ValueError(f"{where}: poses: turns of up to {float(turn.max()):.0f} radians; degrees? Divide by 180 / pi")


def _require_metres(where: str | Path, T_world_root: Tensor) -> None:
    """Refuse pelvises so high that their unit is another. (P, T, 4, 4) in the world"""
    if not T_world_root.numel():
        return
    height = float(T_world_root[..., 1, 3].median(dim=1).values.abs().max())
    if height > HIGHEST:
        raise ValueError(
            f"{where}: pelvises are {height:.0f} m over or under the floor; say the unit of lengths: --in_unit cm or "
            "mm (unit=...), or m if they are"
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


def _numbers(where: str | Path, held: Mapping[str, Any], key: str) -> NDArray[Any]:
    """An array of numbers."""
    try:
        array = np.asarray(held[key])
    except ValueError as error:  # rows of unequal length, or pickled in a npz
        raise ValueError(f"{where}: {key}: expected an array of numbers ({error})") from error
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{where}: {key}: holds {array.dtype}, expected finite numbers")
    return array


def _number(where: str | Path, key: str, held: Mapping[str, Any], what: str) -> float:
    """A number, which some programs write as an array of one."""
    try:
        (number,) = np.ravel(held[key]).tolist()
        return float(number)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {key}: expected one number, {what}") from error


def _arrays(where: str | Path, held: Mapping[str, Any], in_fps: float | None) -> _Held:
    _require_keys(where, held, in_fps)
    held = in_world(held)
    there = set(held)
    ours = {"body", "surface_model_type"} <= there  # other programs may mean something else by `body`
    place, shape = first_of(("transl", *PLACE), there) or "", first_of(SHAPE, there)
    arrays = {"poses": rotations(where, held), "transl": _numbers(where, held, place)}
    arrays["betas"] = np.zeros((*arrays["poses"].shape[:-2], 10)) if shape is None else _numbers(where, held, shape)
    if ours and OWN_SHAPE in there:
        arrays[OWN_SHAPE] = _numbers(where, held, OWN_SHAPE)
    if SCALE in there:
        arrays["transl"] = arrays["transl"] / _number(where, SCALE, held, "by which translations are divided")
    fps = _rate(where, held, in_fps)
    if not 0 < fps < float("inf"):
        raise ValueError(f"{where}: mocap_frame_rate: expected a finite number over 0")
    tensors = {name: torch.from_numpy(array.astype(np.float64)) for name, array in arrays.items()}
    if ours and "given" in there:
        given, expected = np.asarray(held["given"]), arrays["poses"].shape[:-1]
        if given.dtype != bool or given.shape != expected:
            raise ValueError(f"{where}: given: got {given.dtype} {given.shape}, expected bool {expected}")
        tensors["given"] = torch.from_numpy(given)
    written_for = str(held["body"]) if ours else None
    name = ""
    if "name" in there:
        with suppress(ValueError):  # pickled in an npz, and not needed
            name = str(held["name"])
    return tensors, fps, written_for, name


def _require_keys(where: str | Path, held: Mapping[str, Any], in_fps: float | None) -> None:
    """Refuse a file without motion or rate, by our names of what is missing."""
    own, there = set(held) - {PERSON}, set(in_world(held))
    whole = first_of(WHOLE, there) or (first_of(ORIENT, there) and first_of(BODY, there))
    unrated = in_fps is None and not first_of(RATE, there)
    missing = ["mocap_frame_rate"] * unrated + ["poses"] * (not whole) + ["transl"] * (not first_of(PLACE, there))
    if {"body", "surface_model_type"} <= there and "betas" not in there:
        missing.insert(0, "betas")
    if missing:
        fix = "; say the frames a second: --in_fps 30 (in_fps=30)" if unrated else ""
        if not whole and not first_of(PLACE, there):
            fix = "; positions of joints are read from a table, .csv (docs/export.md)" + fix
        raise ValueError(f"{where}: lacks {', '.join(missing)}; it has {first_names(sorted(own), SHOWN)}{fix}")


def _rate(where: str | Path, held: Mapping[str, Any], in_fps: float | None) -> float:
    """Frames a second, of the file or, where it says nothing, as given."""
    key = first_of(RATE, held.keys())
    fps = in_fps if key is None else _number(where, key, held, "frames a second")
    assert fps is not None  # `_require_keys`
    require_own_rate(where, fps, in_fps)
    return fps


def require_own_rate(path: str | Path, fps: float, in_fps: float | None) -> None:
    """Refuse to call the frame rate of a file another than it says."""
    if in_fps is not None and abs(fps - in_fps) > 1e-6:
        raise ValueError(
            f"{path}: says {fps:g} frames a second; --in_fps {in_fps:g} is for files that say nothing, --fps resamples"
        )
