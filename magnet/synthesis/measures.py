"""Distance of a motion from its coupling's closed form, to test models trained on it."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from magnet.body.joints import ANKLES, ELBOWS, KNEES, L_HIP, MIRROR, PELVIS, R_HIP, WRISTS
from magnet.motion.scene import FPS
from magnet.synthesis.planning import Truth
from magnet.synthesis.ring import BOTH, LEFT, RIGHT

LATEST = 150
"""Longest delay that is searched, in frames."""
LIMBS = (*KNEES, *ANKLES, *ELBOWS, *WRISTS)
"""Knees, ankles, elbows and wrists, by which delays are found."""


def coupling_error(coupling: str, joints: Tensor, truth: Truth, start: float = 0.0) -> dict[str, float]:
    """Deviation of a motion from its coupling; NaN if the frames do not show it.

    Args:
        coupling: name in `COUPLINGS`.
        joints: (T, P, 22, 3) world metres, 30 fps, agents in the order of the scene.
        truth: as `synthesize` returned it.
        start: seconds of the scene before the first of these frames, for a stretch that starts later.

    Returns:
        mirror, follow: delay (seconds off, the worst follower), distance (metres from the delayed image).
        handshake: gap (metres off the wrists' distance while hands are held).
        circle: radius (metres off it), omega (rad/s off it), gap (metres, held wrists).
        patty_cake: gap (metres, at the claps), period (seconds off the rhythm).

    Raises:
        KeyError: no such coupling.
    """
    return MEASURES[coupling](joints.detach().cpu().double(), truth, start)


def _mean(values: list[Tensor]) -> float:
    return float(torch.cat([v.reshape(-1) for v in values]).mean()) if values else math.nan


def _own_frame(joints: Tensor) -> Tensor:
    """Joints seen from the pelvis, facing where the hips face. (T, P, 22, 3) -> same"""
    away = joints - joints[..., :1, :]
    across = joints[..., L_HIP, :] - joints[..., R_HIP, :]
    yaw = torch.atan2(-across[..., 2], across[..., 0])[..., None]
    x, y, z = away.unbind(-1)
    return torch.stack([yaw.cos() * x - yaw.sin() * z, y, yaw.sin() * x + yaw.cos() * z], dim=-1)


def _delayed(leader: Tensor, followers: list[Tensor], truth: Truth) -> dict[str, float]:
    """Best lag of each follower against the true one; signals are (T, N, 3)."""
    lags = range(min(LATEST, len(leader) // 2) + 1)
    late, far = [], []
    for follower, delay in zip(followers, truth["delay"].tolist(), strict=True):
        if round(delay * FPS) not in lags:
            continue
        miss = torch.stack([(follower[k:] - leader[: len(leader) - k]).norm(dim=-1).mean() for k in lags])
        late.append(abs(int(miss.argmin()) / FPS - delay))
        far.append(miss[round(delay * FPS)])
    return {"delay": max(late, default=math.nan), "distance": _mean(far)}


def _mirror(joints: Tensor, truth: Truth, start: float) -> dict[str, float]:
    own = _own_frame(joints)
    image = own[:, 0, list(MIRROR)] * torch.tensor([-1.0, 1.0, 1.0], dtype=own.dtype)
    limbs = list(LIMBS)
    return _delayed(image[:, limbs], [own[:, p, limbs] for p in range(1, own.shape[1])], truth)


def _follow(joints: Tensor, truth: Truth, start: float) -> dict[str, float]:
    path = joints[..., :1, :] * torch.tensor([1.0, 0.0, 1.0], dtype=joints.dtype)
    return _delayed(path[:, 0], [path[:, p] for p in range(1, path.shape[1])], truth)


def _wrists_apart(joints: Tensor, a: int, hand_a: int, b: int, hand_b: int) -> Tensor:
    """Distance between a wrist of one and a wrist of another. (T,) metres"""
    return (joints[:, a, WRISTS[hand_a]] - joints[:, b, WRISTS[hand_b]]).norm(dim=-1)


def _handshake(joints: Tensor, truth: Truth, start: float) -> dict[str, float]:
    clock = start + torch.arange(len(joints), dtype=torch.float64) / FPS
    off = []
    for (a, b), (grip, release), gap in zip(
        truth["pairs"].tolist(), truth["contact"].tolist(), truth["gap"].tolist(), strict=True
    ):
        held = (clock >= grip) & (clock <= release)
        if bool(held.any()):
            off.append((_wrists_apart(joints, a, 1, b, 1)[held] - gap).abs())
    return {"gap": _mean(off)}


def _circle(joints: Tensor, truth: Truth, start: float) -> dict[str, float]:
    P = joints.shape[1]
    clock = start + torch.arange(len(joints), dtype=torch.float64) / FPS
    ground = joints[:, :, PELVIS, [0, 2]]
    spoke = ground - ground.mean(dim=1, keepdim=True)
    swell = 0.5 - 0.5 * torch.cos(2 * math.pi * clock / truth["period"])
    radius = (truth["radius"] - truth["dip"] * swell)[:, None]
    turned = torch.atan2(spoke[..., 1], spoke[..., 0]).diff(dim=0)
    turned = torch.atan2(turned.sin(), turned.cos()).mean() * FPS
    return {
        "radius": float((spoke.norm(dim=-1) - radius).abs().mean()),
        "omega": float((turned - truth["omega"]).abs()),
        "gap": _mean([(_wrists_apart(joints, p, 0, (p + 1) % P, 1) - truth["gap"]).abs() for p in range(P)]),
    }


def _patty_cake(joints: Tensor, truth: Truth, start: float) -> dict[str, float]:
    T, P = joints.shape[:2]
    meeting = {BOTH: [(p, 0, (p + 1) % P, 1) for p in range(P)], RIGHT: [(0, 1, 1, 1)], LEFT: [(0, 0, 1, 0)]}
    off = []
    for clap, kind in zip(truth["claps"].tolist(), truth["kinds"].tolist(), strict=True):
        frame = round((clap - start) * FPS)
        if 0 <= frame < T:
            off += [(_wrists_apart(joints, *pair)[frame] - truth["gap"]).abs() for pair in meeting[kind]]
    # Own hands meet every other beat: the strongest rhythm of their distance.
    apart = torch.stack([_wrists_apart(joints, p, 0, p, 1) for p in range(P)], dim=-1)
    beats = torch.arange(0.4, 1.0, 0.001, dtype=torch.float64)
    turns = torch.arange(T, dtype=torch.float64) / FPS / (2 * beats[:, None])
    taper = torch.hann_window(T, periodic=False, dtype=torch.float64)
    waves = torch.polar(taper.expand_as(turns), 2 * math.pi * turns)
    power = (waves @ (apart - apart.mean(dim=0)).to(waves.dtype)).abs().sum(dim=-1)
    return {"gap": _mean(off), "period": abs(float(beats[power.argmax()]) - float(truth["period"]))}


MEASURES: dict[str, Callable[[Tensor, Truth, float], dict[str, float]]] = {
    "mirror": _mirror,
    "follow": _follow,
    "handshake": _handshake,
    "circle": _circle,
    "patty_cake": _patty_cake,
}
