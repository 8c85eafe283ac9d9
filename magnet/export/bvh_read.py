"""Reader of BVH files: hierarchy and motion as written, and joints in the world."""

from __future__ import annotations

import codecs
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from magnet.export.cutting import kept_frames
from magnet.export.rig_motion import RATES, Bools, Floats, RigMotion, rest_of, usual_rate
from magnet.motion.bvh import AXES, BvhHeader, BvhJoint, bvh_header, decimal_comma
from magnet.motion.runs import filled


def read_bvh(path: str | Path, gaps: bool = False, start: int = 0, end: int | None = None) -> RigMotion:
    """Read one BVH file.

    Position channels of a joint replace its OFFSET, as most programs write them, and are added to it where they
    rather count from there: see `_added`.

    Args:
        path: the file.
        gaps: frames may hold NaN or infinity, where tracking was lost: they become `RigMotion.tracked`.
        start, end: the frames that are kept, from 0, without `end`; None: to the last.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no BVH, truncated, or a line makes no sense; names file and line. NaN in all frames that are kept,
            or, without `gaps`, in any. No such frames.
    """
    path = Path(path)
    lines = bvh_lines(path)
    header = bvh_header(lines, path)
    joints, parents = _without_ends(header.joints)
    values, tracked = _motion(path, lines, header)
    kept = kept_frames(path, len(values), start, end)
    if tracked is not None and not (gaps and tracked[kept].any()):
        _require_finite(path, header.first + 1, tracked, kept)
        tracked = None
    tracked = None if tracked is None or tracked[kept].all() else tracked[kept]
    offsets = np.array([joint.offset for joint in joints], dtype=np.float64)
    T, K = len(values), len(joints)
    place = np.broadcast_to(offsets, (T, K, 3)).copy()
    local = np.broadcast_to(np.eye(3), (T, K, 3, 3)).copy()
    reach = float(np.linalg.norm(rest_of(offsets, parents), axis=-1).max())
    column = 0
    for k, joint in enumerate(joints):
        moved = {}
        for channel in joint.channels:
            axis = AXES.index(channel[0])
            if channel.endswith("position"):
                moved[axis] = values[:, column]
            else:
                local[:, k] = local[:, k] @ about(axis, np.radians(values[:, column]))
            column += 1
        if moved:
            place[:, k] = _placed(offsets[k], moved, T, reach)
    names = tuple(joint.name for joint in joints)
    fps = _rate(header.seconds, header.digits)
    # Cut last: where the root is counted from is told by the whole file.
    return RigMotion(names, parents, offsets, place[kept], local[kept], fps, path, tracked)


def bvh_lines(path: Path) -> list[str]:
    """Lines of a text in UTF-8 or, as some programs on Windows write it, in UTF-16."""
    try:
        raw = path.read_bytes()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path}: no such file") from error
    coding = "utf-8-sig"
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        coding = "utf-16"
    elif b"\0" in raw[:2]:  # without its mark: what begins a BVH is ASCII
        coding = "utf-16-be" if raw[:1] == b"\0" else "utf-16-le"
    return raw.decode(coding, errors="replace").splitlines()


def _placed(offset: Floats, moved: dict[int, Floats], frames: int, reach: float) -> Floats:
    channels = np.zeros((frames, 3))
    for axis, values in moved.items():
        channels[:, axis] = values
    return channels + offset if _added(offset, channels, reach) else channels


def _added(offset: Floats, channels: Floats, reach: float) -> bool:
    """Whether channels (T, 3) count from the OFFSET. reach: of the skeleton, in the file's unit

    Not where they begin at the OFFSET. Else they do if nearer to zero than to it, as seen along the axis of least
    movement: over the floor people go anywhere, but hips stay at about their height.
    """
    if len(channels) == 0 or np.linalg.norm(channels[0] - offset) <= 0.1 * np.linalg.norm(offset):
        return False
    middle = np.median(channels, axis=0)
    telling = np.flatnonzero(np.abs(offset) >= 0.2 * reach)
    if len(telling) and len(channels) > 1:
        low, high = np.percentile(channels[:, telling], [10, 90], axis=0)
        steady = telling[int((high - low).argmin())]
        return bool(abs(middle[steady]) < abs(middle[steady] - offset[steady]))
    return bool(np.linalg.norm(middle) < np.linalg.norm(middle - offset))


def about(axis: int, radians: Floats) -> Floats:
    """Rotation about x (0), y or z. (...) -> (..., 3, 3)"""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((*radians.shape, 3, 3))
    matrix[..., axis, axis] = 1.0
    matrix[..., i, i] = matrix[..., j, j] = np.cos(radians)
    matrix[..., j, i] = np.sin(radians)
    matrix[..., i, j] = -matrix[..., j, i]
    return matrix


def _without_ends(written: Sequence[BvhJoint]) -> tuple[list[BvhJoint], tuple[int, ...]]:
    """Joints without End Sites, whose offsets move nothing, and the parents' new numbers."""
    joints = [joint for joint in written if not joint.end]
    number = {k: i for i, k in enumerate(k for k, joint in enumerate(written) if not joint.end)} | {-1: -1}
    return joints, tuple(number[joint.parent] for joint in joints)


def _motion(path: Path, lines: Sequence[str], header: BvhHeader) -> tuple[Floats, Bools | None]:
    """All numbers (T, D), those of frames that are not finite as before them; and (T,) which were, None: all."""
    frames, width = header.frames, header.width
    words = " ".join(lines[header.first :]).split()
    if len(words) != frames * width:
        has = f"{len(words) / max(width, 1):.4g} frames of {width} numbers"
        advice = "the file is truncated: export it again" if len(words) < frames * width else "its header is wrong"
        raise ValueError(f"{path}: Frames: {frames}, but {has} follow; {advice}")
    try:
        values = np.array(words, dtype=np.float64).reshape(frames, width)
    except ValueError as error:
        what = decimal_comma(words) or f"the MOTION part holds something that is no number ({error})"
        raise ValueError(f"{path}: {what}") from error
    finite: Bools = np.logical_and.reduce(np.isfinite(values), axis=1)
    if finite.all():
        return values, None
    return (filled(values[:, None], finite[:, None])[:, 0] if finite.any() else values), finite


def _require_finite(path: Path, first: int, finite: Bools, kept: slice) -> None:
    """Refuse NaN in frames that are kept. first: line of the first frame; finite (T,)"""
    bad = np.flatnonzero(~finite[kept])
    if len(bad):
        frame = (kept.start or 0) + int(bad[0])
        leave = "leave such frames out in all files of the scene, as --start and --end do at the beginning and the end"
        out = leave if finite.any() else "every frame does"
        raise ValueError(f"{path}:{first + frame}: frame {frame} holds NaN or infinity; {out}")


def _rate(seconds: float, digits: int) -> float:
    """Frames a second of a Frame Time that may have been rounded or cut to few digits, such as 0.033 or 0.0166."""
    fps = 1 / seconds
    if abs(round(fps) - fps) < 1e-6 * fps:
        return float(round(fps))
    near = RATES if 2 < digits < 5 else ()
    rounded = [rate for rate in near if round(1 / rate, digits) == seconds]
    rounded = rounded or [rate for rate in near if 10**digits // rate == round(seconds * 10**digits)]  # cut
    if rounded:
        return min(rounded, key=lambda rate: (rate != round(rate), abs(rate - fps)))
    return usual_rate(fps)
