"""Keys and shapes under which files of SMPL's family have motion, of whichever program."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.motion.rotations import to_rotvec
from magnet.motion.scene import BODY_JOINTS

Doubles = NDArray[np.float64]

WHOLE = ("poses", "pose", "smpl_poses", "fullpose", "full_pose")
ORIENT, BODY = ("root_orient", "global_orient", "poses_root"), ("pose_body", "body_pose", "poses_body")
PLACE = ("trans", "transl", "smpl_trans", "translation")
RATE = ("mocap_frame_rate", "mocap_framerate", "fps", "framerate", "frame_rate")
SHAPE = ("betas", "shape", "beta")
"""Keys that files may have for the same thing."""
OWN_SHAPE = "body_betas"
"""Our key for shapes of the open body, which SMPL-X's `betas` cannot hold."""
SMPLX_PELVIS = (0.003, -0.351, 0.012)
"""J0, the rest pelvis of SMPL-X's neutral body in its mean shape (J_regressor @ v_template), metres, to a millimetre.
A file's transl is the pelvis without it."""
SCALE = "smpl_scaling"
"""By which AIST++'s translations are to be divided."""


def first_of(keys: Sequence[str], there: Collection[str]) -> str | None:
    """The first of several keys that is there."""
    return next((key for key in keys if key in there), None)


def posed(there: Collection[str]) -> bool:
    """Whether a file with these keys holds rotations of somebody."""
    return first_of((*WHOLE, *ORIENT), there) is not None


def rotations(where: object, held: Mapping[str, Any]) -> Doubles:
    """Axis-angle numbers a frame, radians, (T, D) or (P, T, D), the pelvis's first, however a file holds them.

    Numbers that are not finite stay so.

    Args:
        where: for messages.
        held: what the file has; None counts as absent.

    Raises:
        ValueError: a key is missing, no numbers, matrices that are no rotations, or unequal parts.
    """
    there = [key for key in (*WHOLE, *ORIENT, *BODY) if key in held and held[key] is not None]
    whole = first_of(WHOLE, there)
    if whole is not None:
        return _axis_angle(where, held[whole])
    found = []
    for keys in (ORIENT, BODY):
        key = first_of(keys, there)
        if key is None:
            has = ", ".join(sorted(map(str, held))[:20]) or "nothing"
            raise ValueError(f"{where}: lacks {' or '.join(keys[:2])}; it has {has}")
        found.append(held[key])
    body = _axis_angle(where, found[1], 3 * BODY_JOINTS - 3)
    if body.ndim == 2 and np.ndim(found[0]) == 3 and np.shape(found[0])[1:] == (3, 3):
        found[0] = np.asarray(found[0])[:, None]  # a matrix a frame: of one person's body, not three frames of people
    root = _axis_angle(where, found[0], 3, joints=1)
    if root.shape[-2] != body.shape[-2]:
        raise ValueError(
            f"{where}: unequal numbers of frames: root {root.shape[-2]}, body {body.shape[-2]}; expected one length"
        )
    if root.shape[:-1] != body.shape[:-1]:
        raise ValueError(f"{where}: root {root.shape} and body {body.shape} are of unequal numbers of people")
    return np.concatenate([root, body], axis=-1)


def _axis_angle(where: object, value: Any, least: int = 0, joints: int | None = None) -> Doubles:
    """Rotations as axis-angle numbers: (..., J, 3, 3) matrices, (..., J, 3) vectors or flat already -> (..., 3 J)

    least: numbers a frame; 0: the caller looks.
    joints: J, where (people, frames, 3) would look like it.
    """
    array = np.asarray(value)
    if array.dtype.kind not in "iuf" or array.ndim < 2:
        raise ValueError(f"{where}: rotations hold {array.dtype} {array.shape}, expected numbers a frame")
    with np.errstate(over="ignore", invalid="ignore"):
        array = array.astype(np.float64)
    if array.ndim >= 4 and array.shape[-2:] == (3, 3):
        known = np.isfinite(array).all(axis=(-2, -1))[..., None]
        array = np.where(known[..., None], array, np.eye(3))
        square = np.allclose(array @ np.swapaxes(array, -1, -2), np.eye(3), atol=1e-2)
        if not square or (np.linalg.det(array) < 0).any():
            raise ValueError(f"{where}: matrices that are no rotations")
        array = np.where(known, to_rotvec(torch.from_numpy(array)).numpy(), np.nan)
    if array.ndim >= 3 and array.shape[-1] == 3 and array.shape[-2] == (joints or array.shape[-2]):
        array = array.reshape(*array.shape[:-2], -1)
    if array.ndim not in (2, 3) or array.shape[-1] < least:
        raise ValueError(
            f"{where}: rotations: got shape {np.shape(value)}, expected (frames, {least or 3 * BODY_JOINTS} or more) "
            "in axis-angle, or people first"
        )
    return array
