"""A whole take fitted to a body, with masked frames, and the report of the fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from magnet.body import Body
from magnet.body.fit import BodyFit, floor_height
from magnet.body.joints import ELBOWS, FEET, HIPS, KNEES, SHOULDERS, WRISTS
from magnet.datamodules.preparing.canonicalize import fit_positions
from magnet.datamodules.reading.cmu_glitches import Glitches
from magnet.datamodules.reading.recording import Recording
from magnet.motion.scene import Scene

LIMBS = (*HIPS, *KNEES, *FEET, *SHOULDERS, *ELBOWS, *WRISTS)
HELD = 0.20
"""Metres within which two people's wrists say that they may hold hands."""


@dataclass(frozen=True)
class Fitted:
    """A take as a scene, and the numbers for its report."""

    fit: BodyFit
    glitches: tuple[Glitches, ...]
    limb_error: float  # metres, mean over limb joints, valid frames and people
    wrist_error: float  # the same over both wrists
    wrist_recorded: float  # metres between two people's nearest wrists over the take; NaN for one person
    wrist_fitted: float
    held_recorded: float  # share of frames with two people's wrists closer than HELD; NaN for one person
    held_fitted: float
    floor: float  # metres that the recording's ground lay above its y = 0


def fit_whole(
    recording: Recording, glitches: tuple[Glitches, ...], body: Body, progress: Callable[[int, int], None] | None = None
) -> Fitted:
    """A whole take as bodies in one scene at 30 fps, standing on y = 0; what was mended too long ago is masked.

    Raises:
        ValueError: the body does not fit.
    """
    assert recording.positions is not None and recording.valid is not None
    targets, good = torch.from_numpy(recording.positions), torch.from_numpy(recording.valid)
    fit = fit_positions(recording, targets, recording.valid, body, progress=progress)
    joints = list(recording.joints)
    limbs = [joints.index(j) for j in LIMBS]
    found = body.joints(fit.scene)[0]
    scene, floor = on_floor(fit.scene, found, body)
    wrists = [joints.index(joint) for joint in WRISTS]
    recorded, fitted = (wrists_apart(each, good) for each in (targets[:, :, wrists], found[:, :, WRISTS]))
    return Fitted(
        fit=BodyFit(scene, fit.residual),
        glitches=glitches,
        limb_error=float(fit.residual[good][:, limbs].mean()),
        wrist_error=float(fit.residual[good][:, wrists].mean()),
        wrist_recorded=float(recorded.amin()) if len(recorded) else math.nan,
        wrist_fitted=float(fitted.amin()) if len(fitted) else math.nan,
        held_recorded=float((recorded < HELD).double().mean()),
        held_fitted=float((fitted < HELD).double().mean()),
        floor=floor,
    )


def wrists_apart(wrists: Tensor, valid: Tensor) -> Tensor:
    """Metres between the nearest wrists of two people, in frames with two who are valid; none for one person.

    (T, P, 2, 3), (T, P) -> (frames,)
    """
    pairs = [(p, q) for p in range(wrists.shape[1]) for q in range(p)]
    nearest = torch.full((len(wrists), 1), torch.inf, dtype=wrists.dtype)
    for p, q in pairs:
        apart = torch.cdist(wrists[:, p], wrists[:, q]).amin(dim=(-1, -2))
        nearest = torch.cat([nearest, torch.where(valid[:, p] & valid[:, q], apart, torch.inf)[:, None]], dim=1)
    nearest = nearest.amin(dim=1)
    return nearest[nearest.isfinite()]


def on_floor(scene: Scene, found: Tensor, body: Body) -> tuple[Scene, float]:
    """The scene moved up or down so that resting feet rest at y = 0; and the height that the floor was at.

    Of the lower sole of each person and frame, the median over valid frames is taken as resting: people stand on at
    least one foot for most of a take. One height serves everybody, for they stand on one floor.
    """
    lowest = floor_height(found, body, scene.betas[0])
    good = slice(None) if scene.valid is None else scene.valid[0]
    floor = float(lowest[good].median())
    T_world_root = scene.T_world_root.clone()
    T_world_root[..., 1, 3] -= floor
    return scene.replace(T_world_root=T_world_root), floor


def report_of(fitted: Fitted) -> dict[str, Any]:
    """What the json beside a cached take says; lengths in centimetres."""
    scene = fitted.fit.scene
    assert scene.valid is not None

    def cm(metres: float) -> float | None:
        return None if np.isnan(metres) else round(100 * metres, 2)

    def percent(share: float) -> float | None:
        return None if np.isnan(share) else round(100 * share, 1)

    return {
        "frames": scene.frames,
        "frames masked": int((~scene.valid).sum()),
        "limb error cm": cm(fitted.limb_error),
        "wrist error cm": cm(fitted.wrist_error),
        "nearest wrists recorded cm": cm(fitted.wrist_recorded),
        "nearest wrists fitted cm": cm(fitted.wrist_fitted),
        "wrists under 20 cm recorded %": percent(fitted.held_recorded),
        "wrists under 20 cm fitted %": percent(fitted.held_fitted),
        "floor cm": cm(fitted.floor),
        "largest shape number": round(float(scene.betas.abs().max()), 2),
        "glitches": [
            {
                "jumps": glitch.jumps,
                "jumps of modelled joints": glitch.body_jumps,
                "frames interpolated": int(glitch.repaired.sum()),
                "frames masked": int(glitch.masked.sum()),
            }
            for glitch in fitted.glitches
        ],
    }
