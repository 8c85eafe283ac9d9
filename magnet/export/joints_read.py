"""People on a body by the positions of their joints, from a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from magnet.body.base import MOST_SHAPE, Body
from magnet.body.fit import BodyFit, fit_body
from magnet.body.joints import ANKLES, HIPS, JOINT_NAMES, KNEES, L_ANKLE, L_FOOT, L_HIP, L_KNEE, SHOULDERS, TOES
from magnet.export.cutting import Begin, kept_frames
from magnet.export.joints_table import SLOW, JointTable, read_table
from magnet.export.naming import recognised
from magnet.export.npz import require_own_rate
from magnet.export.read_options import Reading
from magnet.export.retarget import POOR_FIT, REFUSED_FIT, TARGETS
from magnet.export.rig import LONGEST_LEG, SHORTEST_LEG, UNITS, UP, require_unit, require_up
from magnet.export.rig_motion import Bools, Floats
from magnet.export.upright import WARNING
from magnet.motion.rotations import about_y
from magnet.motion.scene import BODY_JOINTS, FPS, Scene

OURS = "our own names"
LOW = 0.05
"""Metres over its lowest place under which an ankle is that of a foot on the floor."""
BRIDGED = 0.2
"""Weight of a joint where it is missing, beside where it is known: it is taken to be on a straight line between."""
BACK = 0.02
"""Leg lengths that knees, and toes where they are tracked, are behind legs and ankles of who is mirrored, at least: in
each take of CMU's, dances included, they are 0.03 before them or more, and with toes 0.07."""
UPRIGHT, CLEAR = 0.5, 0.8
"""Cosine between torsos and the axis that is said to be up, below which it is doubted; and from which one is found."""


def load_joints(path: str | Path, body: Body, options: Reading) -> tuple[Scene, str, bool, Begin]:
    """The people of a table on a body, fitted to their joints; a note on how it was read; whether it is one of ours;
    and when it begins.

    Frames in which somebody's hips or shoulders are missing are not valid; other joints may be missing now and then.
    Up is found from where torsos point. The options' `in_fps` is the rate of the table, or of its count of frames, if
    it says no time, or too few of them; of one frame it is `FPS`, too.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: as `read_table`, unknown joints, no unit, no rate, another rate than the times', nobody, or no fit.
    """
    path, table = Path(path), read_table(path)
    rate, doubts = _rate(path, table, options.in_fps)
    require_up(options.up)
    found, weight, scheme = _joints(path, table, options.joints)
    used = sorted(weight)
    kept = kept_frames(path, len(table.at), options.start, options.end)
    at = table.at[kept][:, :, [found[j] for j in used]]
    name, notes = _unit(path, at, used, options.unit or table.unit)
    sure = np.asarray(np.isfinite(at).all(axis=-1))  # (T, P, M)
    valid = np.asarray(sure[:, :, [used.index(j) for j in (*HIPS, *SHOULDERS)]].all(axis=-1))
    for person, there in zip(table.people, valid.T, strict=True):
        if not there.any():
            raise ValueError(f"{path}: {person or 'the person'} has hips and shoulders in no frame")
    up, notes_up = _up(at[valid], used, options.up)
    doubts += [*notes_up, *_untracked(table.people, used, sure), *_mirrored(at[valid], used)]
    weights = np.array([weight[j] for j in used]) * np.where(sure, 1.0, BRIDGED * sure.any(axis=0))
    fit = _fitted(path, UNITS[name] * _bridged(at @ UP[up].T, sure), used, weights, valid, rate, body)
    off = float(fit.residual[torch.from_numpy(sure & valid[..., None])].mean())
    head = f"{path.name}: joint positions, {scheme}, {len(used)} joints; unit {name}, {up} up, {rate:g} fps"
    notes = [head, f"  the body's joints lie {100 * off:.1f} cm from the file's on average", *notes, *doubts]
    if off > POOR_FIT:
        notes.append("  that is much: its proportions are far from a person's; hands and feet may miss")
    if not valid.all():
        lack = int(np.count_nonzero(~valid.all(axis=1)))
        notes.append(f"  {lack} of {len(valid)} frames lack somebody's hips or shoulders: not valid")
    scene = fit.scene.replace(names=(path.stem,), valid=None if valid.all() else fit.scene.valid)
    count = rate * table.step
    own = (table.fps or rate) * table.step  # by its times
    first = None if table.first is None else table.first + kept.start * table.step
    second = None if table.second is None else table.second * own / count + kept.start / rate
    return scene, "\n".join(notes), scheme == OURS, Begin(first, second, count)


def _rate(path: Path, table: JointTable, said: float | None) -> tuple[float, list[str]]:
    """Frames a second of the table's frames, and notes on how that is known."""
    own = table.fps and table.fps * table.step
    slow = own is not None and own < SLOW
    if own is not None and not slow:
        require_own_rate(path, own, said)
    notes = [f"  {table.told}"] if table.told else []
    if slow:
        notes.append(f"{'  ' if said else WARNING}its times make {own:.3g} frames a second")
        notes[-1] += f"; {said:g}, as said, are taken" if said else "; if that is wrong, say it with --in_fps"
    rate = table.fps if own is not None and not (slow and said) else said and said / table.step
    if rate is None and len(table.at) == 1:
        return FPS, [*notes, f"  it has one frame and so no rate: {FPS:g} frames a second, unless --in_fps says others"]
    if rate is None:
        why = f"{table.told}, and it " if table.told else ""
        lacks = "says no time" if table.second is None else "its times tell no rate, as where they hardly change"
        raise ValueError(f"{path}: {why}{lacks}; say its frames a second: --in_fps 30 (in_fps=30 in Python)")
    if table.step > 1:
        notes.append(f"  its frames are counted in steps of {table.step}, so {rate:g} of them are a second")
    return rate, notes


def _untracked(people: Sequence[str], used: Sequence[int], sure: Bools) -> list[str]:
    """A warning for each person of whom joints are missing in all frames. sure (T, P, M)"""
    found = []
    for person, ever in zip(people, np.asarray(sure.any(axis=0)), strict=True):
        if not ever.all():
            names = ", ".join(JOINT_NAMES[j] for j, once in zip(used, ever.tolist(), strict=True) if not once)
            whose = f" of {person}" if person else ""
            found.append(f"{WARNING}{names}{whose}: in no frame; made up of the body at rest")
    return found


def _joints(
    path: Path, table: JointTable, given: Mapping[str, str] | None
) -> tuple[dict[int, int], dict[int, float], str]:
    """Which of the table's joints each of ours is, the weights of those that the body is fitted to, and by what names.

    All of ours count alike; of others limbs and neck, as of rigs: spines and heads lie elsewhere in every one.
    """
    if set(table.names) >= set(JOINT_NAMES):
        found = {j: table.names.index(JOINT_NAMES[j]) for j in range(BODY_JOINTS)}
        return found, dict.fromkeys(found, 1.0), OURS
    naming = recognised(table.names, given)
    if naming.missing:
        raise ValueError(
            f"{path}: cannot tell which joint is {', '.join(naming.missing)}; it has {', '.join(table.names)}. "
            f"Name them: --joint {naming.missing[0]}=ITS_NAME (joints={{...}} in Python)"
        )
    return naming.joints, {j: w for j, w in TARGETS.items() if j in naming.joints}, f"names of {naming.scheme}"


def _fitted(
    path: Path, at: Floats, used: Sequence[int], weights: Floats, valid: Bools, fps: float, body: Body
) -> BodyFit:
    """The body at the joints, with shape numbers that models take. at (T, P, M, 3) metres, weights (T, P, M)"""
    targets = torch.from_numpy(at).float()
    more = (torch.from_numpy(weights).float(), torch.from_numpy(valid))
    feet = None if L_FOOT in used else _level_feet(targets, used)

    def fitted(betas: Tensor | None = None) -> BodyFit:
        own, good = more
        return fit_body(
            targets, used, body, rotations=feet, weights=own, valid=good, betas=betas, fps=fps, refuse_above=REFUSED_FIT
        )

    try:
        fit = fitted()
        betas = fit.scene.betas[0].clamp(-MOST_SHAPE, MOST_SHAPE)
        return fit if torch.equal(betas, fit.scene.betas[0]) else fitted(betas)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _level_feet(targets: Tensor, used: Sequence[int]) -> Tensor:
    """World rotations of feet whose toes nobody tracked: level and as the person faces where they are low, else NaN.

    targets (T, P, M, 3) -> (T, P, 22, 3, 3)
    """
    at = {joint: targets[:, :, used.index(joint)] for joint in (*HIPS, *SHOULDERS, *ANKLES)}
    left = at[HIPS[0]] - at[HIPS[1]] + at[SHOULDERS[0]] - at[SHOULDERS[1]]
    level = about_y(torch.atan2(-left[..., 2], left[..., 0]))
    rotations = torch.full((*targets.shape[:2], BODY_JOINTS, 3, 3), torch.nan)
    for ankle in ANKLES:
        height = at[ankle][..., 1]
        low = height < height.quantile(0.05, dim=0) + LOW
        rotations[:, :, ankle] = torch.where(low[..., None, None], level, torch.nan)
    return rotations


def _bridged(at: Floats, sure: Bools) -> Floats:
    """Missing joints on straight lines between where they were and will be. at (T, P, M, 3), sure (T, P, M)"""
    whole, frames = np.nan_to_num(at), np.arange(len(at))
    for person, joint in np.argwhere(~sure.all(axis=0) & sure.any(axis=0)):
        known = sure[:, person, joint]
        for axis in range(3):
            track = whole[:, person, joint, axis]
            track[~known] = np.interp(frames[~known], frames[known], track[known])
    return whole


def _unit(path: Path, at: Floats, used: Sequence[int], said: str | None) -> tuple[str, list[str]]:
    """The unit of length as it is said, else by the legs; and a warning where legs say otherwise. at (T, P, M, 3)"""
    require_unit(said)
    hip, knee, ankle = (at[:, :, used.index(j)] for j in (L_HIP, L_KNEE, L_ANKLE))
    bones = np.linalg.norm(hip - knee, axis=-1) + np.linalg.norm(knee - ankle, axis=-1)
    leg = float(np.nanmedian(bones)) if np.isfinite(bones).any() else math.nan
    fitting = [name for name in UNITS if SHORTEST_LEG <= leg * UNITS[name] <= LONGEST_LEG]
    if said is None:
        if not fitting:
            raise ValueError(
                f"{path}: legs are {leg:.3g} long, which fits no unit of length; say --in_unit m, cm or mm"
            )
        return fitting[0], []
    if said in fitting or math.isnan(leg):
        return said, []
    looks = f"; they look like {fitting[0]}" if fitting else ""
    return said, [f"{WARNING}unit {said}, as said, makes legs {leg * UNITS[said]:.2g} m long{looks}"]


def _up(at: Floats, used: Sequence[int], said: str | None) -> tuple[str, list[str]]:
    """The axis that is up as it is said, else the one along which torsos point; a warning where they point elsewhere.

    at (N, M, 3) in the file's axes, of moments with hips and shoulders
    """
    hips, shoulders = (at[:, [used.index(j) for j in pair]].mean(axis=1) for pair in (HIPS, SHOULDERS))
    torso = shoulders - hips
    along = np.median(torso / np.maximum(np.linalg.norm(torso, axis=-1, keepdims=True), 1e-9), axis=0)
    axis = int(np.abs(along).argmax())
    shown = f"{'-' if along[axis] < 0 else ''}{'xyz'[axis]}"
    if said is None:
        return (shown, []) if abs(along[axis]) >= CLEAR else ("y", [])
    if (UP[said] @ along)[1] >= UPRIGHT:
        return said, []
    return said, [f"{WARNING}up {said}, as said, leaves nobody upright: torsos point along {shown}, unless all lie"]


def _mirrored(at: Floats, used: Sequence[int]) -> list[str]:
    """A warning if toes and knees point to the back, which hips and shoulders tell. at (N, M, 3), as for `_up`"""
    of = {joint: at[:, used.index(joint)] for joint in used}
    (left, right), (above_left, above_right) = ([of[joint] for joint in pair] for pair in (HIPS, SHOULDERS))
    ahead = np.cross(left - right + above_left - above_right, above_left + above_right - left - right)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), 1e-9)
    found = []
    for hip, knee, ankle, toe in zip(HIPS, KNEES, ANKLES, TOES, strict=True):
        leg = of[ankle] - of[hip]
        length = np.maximum(np.linalg.norm(leg, axis=-1, keepdims=True), 1e-9)
        along = ((of[knee] - of[hip]) * leg).sum(axis=-1, keepdims=True) / length**2
        bent = of[knee] - of[hip] - along * leg
        if toe in of:
            bent = bent + np.where(np.isfinite(of[toe]), of[toe] - of[ankle], 0.0)
        found.append((bent * ahead).sum(axis=-1) / length[:, 0])
    known = np.concatenate(found)
    known = known[np.isfinite(known)]
    if not len(known) or np.median(known) > -BACK:
        return []
    what = "knees and toes" if set(TOES) & set(of) else "knees"
    return [
        f"{WARNING}looks mirrored: {what} point backwards; if its world is left-handed, as in Unity and Unreal, "
        "negate one axis in the file; else left and right are swapped"
    ]
