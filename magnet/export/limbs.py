"""Limbs between joints and their radii, and body ends without a joint: crown, hands, toes and heels."""

from __future__ import annotations

import numpy as np

from magnet.export.drawing import Array

from magnet.body.joints import (  # isort: skip
    HEAD, L_ANKLE, L_COLLAR, L_ELBOW, L_FOOT, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, NECK, PELVIS, R_ANKLE, R_COLLAR,
    R_ELBOW, R_FOOT, R_HIP, R_KNEE, R_SHOULDER, R_WRIST, SPINE2, SPINE3,
)  # fmt: skip
from magnet.motion.scene import BODY_JOINTS

CROWN, L_HAND, R_HAND, L_TOE, R_TOE, L_HEEL, R_HEEL = range(BODY_JOINTS, BODY_JOINTS + 7)  # points added by `extended`

# (from, to, radius at each end in metres, side: 0 middle, 1 left, 2 right) for a leg of LEG metres
Limb = tuple[int, int, float, float, int]
LEG = 0.80
STICKS: tuple[Limb, ...] = (
    (PELVIS, SPINE2, 0.040, 0.040, 0), (SPINE2, NECK, 0.040, 0.034, 0), (NECK, HEAD, 0.030, 0.030, 0),
    (HEAD, CROWN, 0.082, 0.088, 0),
    (PELVIS, L_HIP, 0.038, 0.036, 1), (L_HIP, L_KNEE, 0.038, 0.032, 1), (L_KNEE, L_ANKLE, 0.032, 0.026, 1),
    (L_HEEL, L_FOOT, 0.026, 0.026, 1), (L_FOOT, L_TOE, 0.026, 0.020, 1),
    (PELVIS, R_HIP, 0.038, 0.036, 2), (R_HIP, R_KNEE, 0.038, 0.032, 2), (R_KNEE, R_ANKLE, 0.032, 0.026, 2),
    (R_HEEL, R_FOOT, 0.026, 0.026, 2), (R_FOOT, R_TOE, 0.026, 0.020, 2),
    (NECK, L_SHOULDER, 0.032, 0.034, 1), (L_SHOULDER, L_ELBOW, 0.032, 0.027, 1),
    (L_ELBOW, L_WRIST, 0.027, 0.021, 1), (L_WRIST, L_HAND, 0.024, 0.020, 1),
    (NECK, R_SHOULDER, 0.032, 0.034, 2), (R_SHOULDER, R_ELBOW, 0.032, 0.027, 2),
    (R_ELBOW, R_WRIST, 0.027, 0.021, 2), (R_WRIST, R_HAND, 0.024, 0.020, 2),
)  # fmt: skip
CAPSULES: tuple[Limb, ...] = (
    (PELVIS, L_HIP, 0.105, 0.080, 0), (PELVIS, R_HIP, 0.105, 0.080, 0), (PELVIS, SPINE2, 0.105, 0.102, 0),
    (SPINE2, L_COLLAR, 0.102, 0.082, 0), (SPINE2, R_COLLAR, 0.102, 0.082, 0), (SPINE2, NECK, 0.098, 0.050, 0),
    (L_COLLAR, L_SHOULDER, 0.078, 0.054, 0), (R_COLLAR, R_SHOULDER, 0.078, 0.054, 0),
    (NECK, HEAD, 0.055, 0.050, 0), (HEAD, CROWN, 0.080, 0.092, 0),
    (L_HIP, L_KNEE, 0.080, 0.054, 1), (L_KNEE, L_ANKLE, 0.054, 0.036, 1), (L_ANKLE, L_HEEL, 0.036, 0.032, 1),
    (L_HEEL, L_FOOT, 0.034, 0.036, 1), (L_FOOT, L_TOE, 0.034, 0.024, 1),
    (R_HIP, R_KNEE, 0.080, 0.054, 2), (R_KNEE, R_ANKLE, 0.054, 0.036, 2), (R_ANKLE, R_HEEL, 0.036, 0.032, 2),
    (R_HEEL, R_FOOT, 0.034, 0.036, 2), (R_FOOT, R_TOE, 0.034, 0.024, 2),
    (L_SHOULDER, L_ELBOW, 0.054, 0.040, 1), (L_ELBOW, L_WRIST, 0.040, 0.028, 1), (L_WRIST, L_HAND, 0.028, 0.026, 1),
    (R_SHOULDER, R_ELBOW, 0.054, 0.040, 2), (R_ELBOW, R_WRIST, 0.040, 0.028, 2), (R_WRIST, R_HAND, 0.028, 0.026, 2),
)  # fmt: skip

SIDE_TONE = np.array([1.0, 1.06, 0.84])  # left limbs lighter, right ones darker, so that the two are told apart


def extended(joints: Array) -> Array:
    """The 22 joints and crown, hands, toes and heels, guessed from them. (..., 22, 3) -> (..., 29, 3)"""

    def unit(v: Array) -> Array:
        return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-6)

    size = scale(joints)[..., None, None]
    j = joints
    head, neck, chest = j[..., HEAD, :], j[..., NECK, :], j[..., SPINE3, :]
    crown = head + 0.105 * size[..., 0] * unit(unit(head - neck) + unit(neck - chest))
    hands = j[..., [L_WRIST, R_WRIST], :]
    hands = hands + 0.10 * size * unit(hands - j[..., [L_ELBOW, R_ELBOW], :])
    ankles, balls, knees = j[..., [L_ANKLE, R_ANKLE], :], j[..., [L_FOOT, R_FOOT], :], j[..., [L_KNEE, R_KNEE], :]
    shin = unit(ankles - knees)
    sole = balls - ankles
    forward = unit(sole - shin * np.clip((sole * shin).sum(-1, keepdims=True), 0.0, None))
    toes = balls + 0.065 * size * forward
    drop = np.clip((sole * shin).sum(-1, keepdims=True), 0.02, 0.09)
    heels = ankles + shin * drop - 0.035 * size * forward
    return np.concatenate([joints, crown[..., None, :], hands, toes, heels], axis=-2)


def scale(joints: Array) -> Array:
    """Size of a body relative to the one of the limb tables. (..., 22, 3) -> (...)"""
    upper, lower = [L_HIP, R_HIP, L_KNEE, R_KNEE], [L_KNEE, R_KNEE, L_ANKLE, R_ANKLE]
    legs = np.linalg.norm(joints[..., upper, :] - joints[..., lower, :], axis=-1).sum(axis=-1) / 2
    return np.clip(legs / LEG, 0.5, 1.4)


def limbs(joints: Array, table: tuple[Limb, ...]) -> tuple[Array, Array, Array]:
    """Both ends (P, M, 3) and radii (P, M, 2) of the limbs of a table."""
    points = extended(joints)
    radii = np.array([limb[2:4] for limb in table]) * scale(joints)[:, None, None]
    return points[:, [limb[0] for limb in table]], points[:, [limb[1] for limb in table]], radii


def turn_to(direction: Array) -> Array:
    """Rotations that take +z to a direction. (..., 3) -> (..., 3, 3)"""
    z = direction / np.maximum(np.linalg.norm(direction, axis=-1, keepdims=True), 1e-9)
    helper = np.where(np.abs(z[..., :1]) < 0.9, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    x = np.cross(helper, z)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)
