"""Retargeting of recorded skeletons to a body: of known joint names, in any unit, up axis and rest pose."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body.base import MOST_SHAPE, Body

from magnet.body.joints import (  # isort: skip
    COLLARS, JOINT_NAMES, L_ANKLE, L_ELBOW, L_FOOT, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, NECK, PARENTS, PELVIS, SPINE,
    SPINE1, SPINE3,
)  # fmt: skip
from magnet.body.fit import fit_body, floor_height, jumps_in
from magnet.errors import first_names
from magnet.export.bones import bone_names
from magnet.export.bvh import offsets_of
from magnet.export.cutting import require_one_clock, require_one_rate, together
from magnet.export.read_options import Reading
from magnet.export.rests import rests_aligned, with_doubts
from magnet.export.rig import Skeleton, people_of, require_unit, require_up, understood_together
from magnet.export.rig_files import read_rigs
from magnet.motion.frames import rigid
from magnet.motion.scene import BODY_JOINTS, Scene

Floats = NDArray[np.float64]

SIDED = {L_HIP: 1.0, L_KNEE: 1.0, L_ANKLE: 1.0, L_FOOT: 0.5, L_SHOULDER: 1.0, L_ELBOW: 1.0, L_WRIST: 2.0}
TARGETS = {NECK: 0.1} | {left + side: weight for left, weight in SIDED.items() for side in (0, 1)}
"""Joints that the body is fitted to, with weights. Spine, collars and head lie elsewhere in every rig: only their
rotations are used."""
SAME_BODY = 0.002
"""Largest difference of rest joints, in metres, for a skeleton to count as the body's own."""
RESTS = 2
"""First frames that hold a rest pose, at most, where programs put one before the motion."""
SHOWN = 20
"""Joints that nothing was taken from, so many of which are named."""
POOR_FIT, REFUSED_FIT = 0.04, 0.15
"""Mean distance of joints, in metres, above which a fit is reported as poor, and above which it is refused."""


@dataclass(frozen=True)
class Source:
    """How one file was read."""

    path: Path
    label: str  # the file's name, and who of several people in it
    scheme: str
    joints: dict[str, str]  # our joint's name: theirs
    unused: tuple[str, ...]  # their joints that nothing was taken from
    unit: str
    up: str
    exact: bool  # the skeleton is the body's own: nothing had to be fitted
    residual: float  # metres between limb joints and the file's, mean over joints and frames
    worst: str  # limb joint with the largest mean residual
    jumps: tuple[int, ...] = ()  # frames of the file to which everything jumps
    notes: tuple[str, ...] = ()  # doubts about unit and axis, and how they were decided

    @property
    def poor(self) -> bool:
        return self.residual > POOR_FIT

    def __str__(self) -> str:
        how = "the body's own skeleton" if self.exact else f"names of {self.scheme}; {len(self.joints)} joints mapped"
        lines = [f"{self.label}: {how}; unit {self.unit}, {self.up} up"]
        lines += [f"  {note}" for note in self.notes]
        if not self.exact:
            lines.append(f"  limbs lie {100 * self.residual:.1f} cm from the file's on average, most at {self.worst}")
            if self.poor:
                lines.append("  that is much: its proportions are far from a person's; hands and feet may miss")
            if self.unused:
                lines.append(f"  not mapped: {first_names(self.unused, SHOWN)}")
        if self.jumps:
            lines.append(f"  {_jumps_said(self.jumps)}")
        return "\n".join(lines)


def _jumps_said(jumps: Sequence[int]) -> str:
    """What it may mean that everything jumps to these frames, and what to do."""
    where = ", ".join(map(str, jumps[:5])) + (", ..." if len(jumps) > 5 else "")
    if len(jumps) > 1:
        why = "stepped keys, or cuts? Nothing is drawn between them"
        return f"everything jumps to frames {where} ({why}): bake motion first, or keep a part with --start and --end"
    (frame,) = jumps
    if frame <= RESTS:
        return f"everything jumps to frame {frame} (a rest pose before it?): better leave it out, --start {frame}"
    return f"everything jumps to frame {frame} (a cut?): keep one part, --end {frame} or --start {frame}"


@dataclass(frozen=True)
class Imported:
    """People read from files as one scene (B = 1), and how each was read."""

    scene: Scene
    sources: tuple[Source, ...]
    floor: float  # metres that everybody was lowered by, so that resting feet stand on y = 0
    rates: tuple[float, ...] = ()  # frames a second of each file


def load_rigs(paths: str | Path | Sequence[str | Path], body: Body, **said: Any) -> Imported:
    """Read BVH, glTF, VRM or FBX files, of one person or several: our own, or any skeleton with known joint names.

    A skeleton that is the body's own is restored exactly; any other is fitted: limbs to positions, all else to
    rotations relative to the file's rest pose, which may be a T or an A pose. One unit is found for all files where it
    suits them all. The up axis is y of glTF and FBX, as their formats say, else found from where torsos point, and from
    rest poses where somebody lies.

    Args:
        **said: what the files do not state, as for `Reading`.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: an FBX, and no Blender.
        ValueError: not such a file, unknown names, units or up axis, rates or lengths that differ, no fit, no such
            frames.
    """
    options = Reading(**said)
    each = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    if not each:
        raise ValueError("no files given")
    require_up(options.up)
    require_unit(options.unit)
    start, end = options.start, options.end
    files = [rig for path in each for rig in people_of(read_rigs(path, start, end, options.clip), options.joints)]
    require_one_clock([file.path for file in files], [file.fps for file in files], start, end)
    if options.fps is None:
        require_one_rate([file.path for file in files], [file.fps for file in files])
    prescribed = {file.up for file in files}  # where all are of formats that say it
    up = options.up or (prescribed.pop() if len(prescribed) == 1 else None)
    for file in files:
        file.require_near()
    skeletons = with_doubts(understood_together(files, options.unit, up, options.joints))
    read = [onto(skeleton, body, most_shape=MOST_SHAPE) for skeleton in skeletons]  # what models take
    jumps = [tuple(start + frame for frame in _jumps(each)) for each in skeletons]
    sources = tuple(replace(source, jumps=found) for (_, source), found in zip(read, jumps, strict=True))
    tracked = [None if file.tracked is None else torch.from_numpy(file.tracked)[None] for file in files]
    people = [one.replace(valid=valid) for (one, _), valid in zip(read, tracked, strict=True)]
    names = [f"{file.path} {file.person}".rstrip() for file in files]
    scene = together(people, names, fps=options.fps, trim=options.trim)
    floor = 0.0
    if not options.keep_floor and not all(source.exact for _, source in read):
        soles = floor_height(body.joints(scene)[0], body, scene.betas[0]).amin(dim=-1)
        seen = None if scene.valid is None or not bool(scene.valid.any()) else scene.valid[0]
        floor = float((soles if seen is None else soles[seen]).median())
        T_world_root = scene.T_world_root.clone()
        T_world_root[..., 1, 3] -= floor
        scene = scene.replace(T_world_root=T_world_root)
    named = scene.replace(names=(" + ".join(path.stem for path in each),))
    return Imported(named, sources, floor, tuple(file.fps for file in files))


def onto(
    skeleton: Skeleton, body: Body, refuse_above: float = REFUSED_FIT, most_shape: float | None = None
) -> tuple[Scene, Source]:
    """One person on a body, and how the file was read; a ValueError where it does not fit.

    refuse_above: mean distance of limb joints, in metres; most_shape: largest fitted shape number, None: no bound.
    """
    return _exact(skeleton, body) or _fitted(skeleton, body, refuse_above, most_shape)


def _jumps(skeleton: Skeleton) -> tuple[int, ...]:
    """Frames to which everything jumps: of two that do not go on, the second."""
    joints = torch.from_numpy(skeleton.at)[:, None]
    off = jumps_in(joints, skeleton.file.fps)[:, 0]
    step = (joints[1:] - joints[:-1]).norm(dim=-1).mean(dim=-1)[:, 0]
    # A step from frame t to t + 1 is a part of the second differences of both; it is the longer one of a jump's two.
    at = {t + 1 + int(step[t + 1] > step[t]) for t in off.nonzero()[:, 0].tolist()}
    return tuple(sorted(at))


# -- a skeleton of the body's own --------------------------------------------------------------


def _exact(skeleton: Skeleton, body: Body) -> tuple[Scene, Source] | None:
    """The scene of a skeleton with our names, tree and a shape that the body can take; None for any other."""
    file = skeleton.file
    names = bone_names("vrm" if file.path.suffix.lower() == ".vrma" else "smplx")  # whose format names bones by roles
    if not set(names) <= set(file.names):
        return None
    number = [file.names.index(name) for name in names]
    if any(file.parents[number[j]] != number[PARENTS[j]] for j in range(1, BODY_JOINTS)):
        return None
    Q = np.round(skeleton.R_rest_ours)  # ours rest along the axes, however far a shape leans
    if np.linalg.det(Q) != 1.0:
        return None
    offsets = torch.from_numpy(skeleton.metres * file.offsets[number] @ Q)
    betas, off = shape_of(offsets, body)
    slides = float(np.abs(file.place[:, number[1:]] - file.offsets[number[1:]]).max()) * skeleton.metres
    if max(off, slides) > SAME_BODY:
        return None
    turned, at = skeleton.turned[:, number[0]], skeleton.at[:, number[0]]
    local = Q.T @ file.local[:, number[1:]] @ Q
    scene = Scene(
        body_rot=torch.from_numpy(local).float()[None, :, None],
        T_world_root=rigid(torch.from_numpy(turned @ Q), torch.from_numpy(at)).float()[None, :, None],
        betas=betas.float()[None, None],
        present=torch.ones(1, 1, dtype=torch.bool),
        fps=file.fps,
        body=body.id,
    )
    residual = np.linalg.norm(body.joints(scene)[0, :, 0].numpy() - skeleton.at[:, number], axis=-1).mean(axis=0)
    return scene, _source(skeleton, {j: number[j] for j in range(BODY_JOINTS)}, True, residual, range(BODY_JOINTS))


def shape_of(offsets: Tensor, body: Body) -> tuple[Tensor, float]:
    """Shape numbers whose joints at rest are `offsets` (22, 3) apart, and the largest distance left, metres."""
    zero = torch.zeros(10, dtype=torch.float64)
    base = offsets_of(body.rest_joints(zero))[1:].flatten()
    directions = offsets_of(body.J_shapedirs.double().movedim(-1, 0))[:, 1:].flatten(1).T  # (63, 10)
    betas = torch.linalg.lstsq(directions, offsets[1:].double().flatten() - base).solution
    left = offsets_of(body.rest_joints(betas))[1:] - offsets[1:]
    return betas, float(left.norm(dim=-1).max())


def _source(
    skeleton: Skeleton, used: Mapping[int, int], exact: bool, residual: Floats, joints: Sequence[int]
) -> Source:
    names = skeleton.file.names
    taken = {*used.values(), *skeleton.chain}
    return Source(
        path=skeleton.file.path,
        label=skeleton.file.label,
        scheme=skeleton.naming.scheme,
        joints={JOINT_NAMES[j]: names[k] for j, k in sorted(used.items())},
        unused=tuple(name for k, name in enumerate(names) if k not in taken),
        unit=skeleton.unit,
        up=skeleton.up,
        exact=exact,
        residual=float(residual.mean()),
        worst=JOINT_NAMES[joints[int(residual.argmax())]],
        notes=(*skeleton.file.notes, *skeleton.notes),
    )


# -- any other skeleton ------------------------------------------------------------------------


def _fitted(skeleton: Skeleton, body: Body, refuse_above: float, most_shape: float | None) -> tuple[Scene, Source]:
    ours = skeleton.naming.joints
    weights = {j: w for j, w in TARGETS.items() if j in ours}
    joints = sorted(weights)
    targets = torch.from_numpy(skeleton.at[:, [ours[j] for j in joints]])[:, None]
    rotations, used = hints(skeleton, body.rest_joints(torch.zeros(10)).double())
    fitted = partial(
        fit_body,
        targets,
        joints,
        body,
        rotations=rotations[:, None],
        weights=torch.tensor([weights[j] for j in joints]),
        fps=skeleton.file.fps,
    )
    try:
        fit = fitted(refuse_above=refuse_above if most_shape is None else math.inf)
        if most_shape is not None:
            betas = fit.scene.betas[0].clamp(-most_shape, most_shape)
            if not torch.equal(betas, fit.scene.betas[0]) or float(fit.residual.mean()) > refuse_above:
                fit = fitted(betas=betas, refuse_above=refuse_above)
    except ValueError as error:
        raise ValueError(f"{skeleton.file.path}: {error}") from error
    limbs = [joint for joint in joints if joint != NECK]
    residual = fit.residual[:, 0, [joints.index(joint) for joint in limbs]].mean(dim=0).double().numpy()
    return fit.scene, _source(skeleton, ours | used, False, residual, limbs)


def hints(skeleton: Skeleton, rest: Tensor) -> tuple[Tensor, dict[int, int]]:
    """World rotations of our joints from our rest pose, NaN where unknown, and the joint each was taken from.

    A bone that rests otherwise than ours is first swung to where theirs rests, its parent's swing included. rest
    (22, 3) -> (T, 22, 3, 3)
    """
    aligned, source = rests_aligned(skeleton, rest), sources(skeleton)
    known = torch.full((skeleton.file.frames, BODY_JOINTS, 3, 3), torch.nan, dtype=torch.float64)
    for j, k in source.items():
        whole = skeleton.carrier(j) if j in skeleton.naming.joints else k
        known[:, j] = torch.from_numpy(skeleton.turned[:, whole]) @ aligned[j]
    return known, source


def sources(skeleton: Skeleton) -> dict[int, int]:
    """Which joint of a skeleton turns as each of ours does."""
    used = dict(zip(*_spine(len(skeleton.chain)), strict=True))
    source = {joint: skeleton.chain[place] for joint, place in used.items()}
    # Collars differ most of all from rig to rig.
    return source | {j: k for j, k in skeleton.naming.joints.items() if j not in COLLARS}


def _spine(bones: int) -> tuple[list[int], list[int]]:
    """Our pelvis and spine joints, and which of so many bones from the pelvis to the chest each takes."""
    last = bones - 1
    if last < 1:
        return [PELVIS], [0]
    if last == 1:
        return [PELVIS, SPINE3], [0, 1]
    if last == 2:
        return [PELVIS, SPINE1, SPINE3], [0, 1, 2]
    return list(SPINE), [0, 1, (1 + last) // 2, last]
