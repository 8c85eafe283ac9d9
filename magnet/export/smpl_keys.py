"""Keys and shapes under which files of SMPL's family have motion, of whichever program."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.export.smpl_clock import FRAMES
from magnet.motion.rotations import to_rotvec
from magnet.motion.scene import BODY_JOINTS

Doubles = NDArray[np.float64]

WHOLE = ("poses", "pose", "smpl_poses", "fullpose", "full_pose")
ORIENT, BODY = ("root_orient", "global_orient", "poses_root"), ("pose_body", "body_pose", "poses_body")
PLACE = ("trans", "transl", "smpl_trans", "translation")
WORLD = ("pose_world", "trans_world")
"""Rotations and places in the world, of files that have those that a camera sees under the other keys."""
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

UNIT_WITHIN, NEARLY_ALL, LOOKED_AT = 0.1, 0.9, 1000
"""Of numbers that are no axis-angle: how far lengths and products are from those of unit vectors at right angles, as
networks give them; in which share of them; and frames that are looked at."""
OTHERS = {
    9: ("matrices", "orthonormal", "save them as (frames, joints, 3, 3), which is read"),
    6: (
        "two columns of matrices (6D)",
        "orthonormal",
        "make matrices of them (the third column is the product of both) and save these as (frames, joints, 3, 3)",
    ),
    4: (
        "quaternions",
        "of unit length",
        "convert them by scipy's Rotation.from_quat(numbers.reshape(-1, 4)[:, [1, 2, 3, 0]]).as_rotvec() where w comes "
        "first, without the [:, [1, 2, 3, 0]] where it comes last",
    ),
}
"""By how many numbers a joint has: what they are, how that is told, and what to do. Nine come first: of a matrix's
nine numbers six may look like two columns."""
GENDER = "gender"
LIKELY_PEOPLE = 20
"""More people than these with fewer than a quarter as many frames are frames first, unless shapes say otherwise."""


class Unreadable(ValueError):
    """Whole numbers that are no motion as it is read; the message says what to do."""


def first_of(keys: Sequence[str], there: Collection[str]) -> str | None:
    """The first of several keys that is there."""
    return next((key for key in keys if key in there), None)


def posed(there: Collection[str]) -> bool:
    """Whether a file with these keys holds rotations of somebody."""
    return first_of((*WHOLE, *ORIENT), there) is not None or set(WORLD) <= set(there)


def there_in_world(held: Mapping[str, Any]) -> bool:
    """Whether a file says where somebody is in the world, beside what a camera sees."""
    return all(held.get(key) is not None for key in WORLD)


def in_world(held: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a file holds, with motion in the world, where it has that, under the keys that are looked for first."""
    if not there_in_world(held):
        return held
    pose, place = (held[key] for key in WORLD)
    return ChainMap({WHOLE[0]: pose, **dict.fromkeys(PLACE, place)}, held)  # type: ignore[arg-type]


def rotations(where: object, held: Mapping[str, Any]) -> Doubles:
    """Axis-angle numbers a frame, radians, (T, D) or (P, T, D), the pelvis's first, however a file holds them.

    Numbers that are not finite stay so.

    Args:
        where: for messages.
        held: what the file has; None counts as absent.

    Raises:
        Unreadable: quaternions, 6D numbers or flat matrices, or frames before people; says how to convert them.
        ValueError: a key is missing, no numbers, matrices that are no rotations, or unequal parts.
    """
    there = [key for key in (*WHOLE, *ORIENT, *BODY) if key in held and held[key] is not None]
    whole = first_of(WHOLE, there)
    if whole is not None:
        return _people_first(where, held, _axis_angle(where, held[whole]))
    found = []
    for keys in (ORIENT, BODY):
        key = first_of(keys, there)
        if key is None:
            has = ", ".join(sorted(map(str, held))[:20]) or "nothing"
            raise ValueError(f"{where}: lacks {' or '.join(keys[:2])}; it has {has}")
        found.append(held[key])
    body = _people_first(where, held, _axis_angle(where, found[1], 3 * BODY_JOINTS - 3))
    if body.ndim == 2 and np.ndim(found[0]) == 3 and np.shape(found[0])[1:] == (3, 3):
        found[0] = np.asarray(found[0])[:, None]  # a matrix a frame: of one person's body, not three frames of people
    root = _axis_angle(where, found[0], 3, joints=1)
    if root.shape[-1] != 3:
        raise ValueError(f"{where}: the root's rotations: got shape {np.shape(found[0])}, expected 3 numbers a frame")
    if root.shape[-2] != body.shape[-2]:
        raise ValueError(
            f"{where}: unequal numbers of frames: root {root.shape[-2]}, body {body.shape[-2]}; expected one length"
        )
    if root.shape[:-1] != body.shape[:-1]:
        raise ValueError(f"{where}: root {root.shape} and body {body.shape} are of unequal numbers of people")
    return np.concatenate([root, body], axis=-1)


def _people_first(where: object, held: Mapping[str, Any], poses: Doubles) -> Doubles:
    """Numbers a frame as they are, but not where frames come before people; files of ours have people first."""
    if poses.ndim != 3 or {"body", "surface_model_type"} <= set(held):
        return poses
    first, second = poses.shape[:2]
    told = _people_told(held)
    numbered = first != second and _shape_of(held, FRAMES) in ((first,), (first, 1))
    if not numbered and (first in told or (first == 1 and second > 1)):  # shapes of one person may be a row a frame
        return poses
    if numbered or second in told or (first > LIKELY_PEOPLE and first > 4 * second):
        but = f", but {FRAMES} number {first} frames" if numbered else ""
        raise Unreadable(
            f"{where}: rotations: got shape {poses.shape}, which is {first} people of {second} frames{but}; people "
            "come first: transpose the first two axes of all arrays that have both, as array.swapaxes(0, 1) does; if "
            f"they are {first} people, say so by shapes: {SHAPE[0]} ({first}, 10)"
        )
    return poses


def _people_told(held: Mapping[str, Any]) -> set[int]:
    """How many people there are, by what files have for each of them: shape numbers (P, 10) and genders (P,)."""
    told = set()
    for key, axes in (*((key, 2) for key in SHAPE), (GENDER, 1)):
        shape = _shape_of(held, key)
        if len(shape) == axes:
            told.add(shape[0])
    return told


def _shape_of(held: Mapping[str, Any], key: str) -> tuple[int, ...]:
    """The shape of what a file has under a key; () of nothing, of uneven lists and of what is pickled in a npz."""
    try:
        return np.shape(held.get(key, 0))
    except ValueError:
        return ()


def _require_vectors(where: object, array: Doubles) -> None:
    """Refuse numbers (..., D) that are other rotations than axis-angle, which nobody's turns look like by chance."""
    width = array.shape[-1]
    frames = array.reshape(-1, width) if width else array.reshape(0, 1)
    frames = frames[np.isfinite(frames).all(axis=1)]
    frames = frames[:: 1 + len(frames) // LOOKED_AT].clip(-10.0, 10.0)
    for size, (what, told, convert) in OTHERS.items():
        if len(frames) and width % size == 0 and _orthonormal(frames.reshape(-1, size)):
            raise Unreadable(
                f"{where}: rotations: got shape {array.shape}: groups of {size} numbers are {told}, as {what} are, "
                f"expected axis-angle, 3 numbers a joint; {convert}"
            )


def _orthonormal(groups: Doubles) -> bool:
    """Whether nearly all (N, 4) have unit length, or nearly all (N, 6) or (N, 9) hold vectors that do, at right angles.

    Six numbers may be two columns of a matrix one after the other, or row by row.
    """
    count, size = groups.shape
    layouts = [groups[:, None]] if size == 4 else [groups.reshape(count, -1, 3)]
    layouts += [groups.reshape(count, 3, 2).swapaxes(1, 2)] if size == 6 else []
    off = [np.abs(each @ each.swapaxes(1, 2) - np.eye(each.shape[1])).max(axis=(1, 2)) for each in layouts]
    return any((each < UNIT_WITHIN).mean() > NEARLY_ALL for each in off)


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
    _require_vectors(where, array)
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
