"""Capsules fitted to a body's mesh, hands and feet included, and beside them those that depth is measured by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from magnet.body.base import Body
from magnet.body.capsules import FROM, RADII, TO
from magnet.body.indices import indices, picked
from magnet.waiting import constant

from magnet.body.joints import (  # isort: skip
    HEAD, L_ANKLE, L_COLLAR, L_ELBOW, L_FOOT, L_HIP, L_KNEE, L_SHOULDER, L_WRIST, NECK, PELVIS, R_ANKLE, R_COLLAR,
    R_ELBOW, R_FOOT, R_HIP, R_KNEE, R_SHOULDER, R_WRIST, SPINE1, SPINE2, SPINE3,
)  # fmt: skip


class BodyPart(NamedTuple):
    """A part of the body that one capsule approximates.

    It moves with the joint `bone` and covers the vertices of the joints `skin`. Its axis leads to the joint `axis`, or
    runs across the body where that is -1; then `low` and `high` select vertices by height, as shares of the extent.
    """

    name: str
    bone: int
    skin: tuple[int, ...]
    axis: int = -1
    low: float = 0.0
    high: float = 1.0


PARTS: tuple[BodyPart, ...] = (
    BodyPart("pelvis", PELVIS, (PELVIS, L_HIP, R_HIP), low=0.45, high=1.0),
    BodyPart("belly", SPINE1, (SPINE1,)),
    BodyPart("waist", SPINE2, (SPINE2,)),
    BodyPart("lower chest", SPINE3, (SPINE3,), high=0.5),
    BodyPart("upper chest", SPINE3, (SPINE3, L_COLLAR, R_COLLAR), low=0.5),
    BodyPart("neck", NECK, (NECK,), HEAD),
    BodyPart("head", HEAD, (HEAD,), NECK),
    BodyPart("left upper arm", L_SHOULDER, (L_SHOULDER,), L_ELBOW),
    BodyPart("right upper arm", R_SHOULDER, (R_SHOULDER,), R_ELBOW),
    BodyPart("left forearm", L_ELBOW, (L_ELBOW,), L_WRIST),
    BodyPart("right forearm", R_ELBOW, (R_ELBOW,), R_WRIST),
    BodyPart("left hand", L_WRIST, (L_WRIST,), L_ELBOW),
    BodyPart("right hand", R_WRIST, (R_WRIST,), R_ELBOW),
    BodyPart("left thigh", L_HIP, (L_HIP,), L_KNEE),
    BodyPart("right thigh", R_HIP, (R_HIP,), R_KNEE),
    BodyPart("left shin", L_KNEE, (L_KNEE,), L_ANKLE),
    BodyPart("right shin", R_KNEE, (R_KNEE,), R_ANKLE),
    BodyPart("left foot", L_ANKLE, (L_ANKLE, L_FOOT), L_FOOT),
    BodyPart("right foot", R_ANKLE, (R_ANKLE, R_FOOT), R_FOOT),
)

HANDS = (11, 12)
FOREARMS = (9, 10)
UPPER_ARMS = (7, 8)
TRUNK = tuple(range(7))
LEGS = tuple(range(13, 19))
"""Indices into `PARTS`."""

MIDDLE = (0.2, 0.8)
"""Part of a limb's length over which its thickness is measured: joints are thicker."""


@dataclass(frozen=True)
class FittedCapsules:
    """K capsules, each fixed to a bone, of P people in B scenes.

    Attributes:
        ends: (B, P, K, 2, 3) metres from the bone's joint, in its frame at rest.
        radius: (B, P, K) metres.
        bones: the joint that each capsule moves with, by default that of each of `PARTS`.
    """

    ends: Tensor
    radius: Tensor
    bones: tuple[int, ...] = tuple(part.bone for part in PARTS)

    def posed(self, R_world: Tensor, joints: Tensor) -> Tensor:
        """Ends in the world. Rotations (B, T, P, 22, 3, 3), joints (B, T, P, 22, 3) -> (B, T, P, K, 2, 3) metres"""
        bones = indices(self.bones, joints.device)
        R, t = R_world.index_select(-3, bones), joints.index_select(-2, bones)
        return (R[..., None, :, :] @ self.ends[:, None, ..., None])[..., 0] + t[..., None, :]


def with_measured(fitted: FittedCapsules, rest: Tensor) -> FittedCapsules:
    """The fitted capsules and behind them `CAPSULES`, by which depth is measured.

    rest: (B, 1, P, 22, 3) joints at rest, metres.
    """
    at = rest[:, 0]
    along = picked(at, TO) - picked(at, FROM)
    ends = torch.stack([torch.zeros_like(along), along], dim=-2).to(fitted.ends)
    radius = constant(RADII, fitted.radius).expand(ends.shape[:3])
    both = torch.cat([fitted.ends, ends], dim=2), torch.cat([fitted.radius, radius], dim=2)
    return FittedCapsules(*both, (*fitted.bones, *FROM))


_KEPT: WeakKeyDictionary[Body, dict[bytes, FittedCapsules]] = WeakKeyDictionary()
"""Cache: while a scene is sampled, the same bodies are asked for many times."""

MOST_KEPT = 64


def fit_capsules(body: Body, betas: Tensor) -> FittedCapsules:
    """Capsules fitted to the mesh at rest. betas (B, P, 10)

    In the trunk the radius is half the depth of the part; in limbs it is the mean distance of the skin from the axis.
    The ends reach the skin.
    """
    kept = _KEPT.setdefault(body, {})
    key = betas.detach().float().cpu().numpy().tobytes() + repr((betas.shape, betas.device)).encode()
    if key not in kept:
        if len(kept) >= MOST_KEPT:
            kept.clear()
        with torch.inference_mode(False), torch.no_grad():
            kept[key] = _fit(body, betas.detach().clone())
    return kept[key]


def _fit(body: Body, betas: Tensor) -> FittedCapsules:
    flat = betas.flatten(0, 1).to(body.v_template)
    vertices = body.v_template + (flat @ body.shapedirs.flatten(0, 1).T).unflatten(-1, (-1, 3))  # (M, V, 3)
    rest = body.rest_joints(flat)
    owner = body.weights.argmax(dim=1)
    corners = body.v_template[body.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1).norm(dim=-1)
    weight = area.new_zeros(len(owner)).index_add_(0, body.faces.flatten(), area.repeat_interleave(3))
    fitted = [_fitted(part, body, vertices, rest, owner, weight) for part in PARTS]
    ends = torch.stack([each for each, _ in fitted], dim=1).unflatten(0, betas.shape[:2])
    radius = torch.stack([each for _, each in fitted], dim=1).unflatten(0, betas.shape[:2])
    return FittedCapsules(ends.to(betas.device), radius.to(betas.device))


def _fitted(
    part: BodyPart, body: Body, vertices: Tensor, rest: Tensor, owner: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Ends (M, 2, 3) from the bone's joint, and radius (M,), of one part of M people."""
    mine = torch.isin(owner, torch.tensor(part.skin, device=owner.device))
    across = part.axis < 0
    height = body.v_template[:, 1]
    if across:
        low, high = height[mine].min(), height[mine].max()
        mine &= (height >= low + part.low * (high - low)) & (height <= low + part.high * (high - low))
    skin, weight = vertices[:, mine] - rest[:, None, part.bone], weight[mine]
    if across:
        axis = skin.new_tensor([1.0, 0.0, 0.0]).expand(len(skin), 3)
    else:
        axis = torch.nn.functional.normalize(rest[:, part.axis] - rest[:, part.bone], dim=-1)
    along = (skin * axis[:, None]).sum(dim=-1)
    beside = skin - along[..., None] * axis[:, None]
    first, last = along.amin(dim=1), along.amax(dim=1)
    if across:
        centre = (beside.amin(dim=1) + beside.amax(dim=1)) / 2
        radius = (skin[..., 2].amax(dim=1) - skin[..., 2].amin(dim=1)) / 2
    else:
        share = (along - first[:, None]) / (last - first)[:, None]
        inner = weight * ((share >= MIDDLE[0]) & (share <= MIDDLE[1]))
        centre = (beside * inner[..., None]).sum(dim=1) / inner.sum(dim=1)[:, None]
        radius = ((beside - centre[:, None]).norm(dim=-1) * inner).sum(dim=1) / inner.sum(dim=1)
    middle, half = (first + last) / 2, ((last - first) / 2 - radius).clamp_min(0)
    reach = torch.stack([middle - half, middle + half], dim=1)
    return centre[:, None] + reach[..., None] * axis[:, None], radius
