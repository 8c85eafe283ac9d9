"""Conversion of shape numbers from one body model to another."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.body.base import SHAPES, Body

PULL = 3e-4
"""Metres of joint error that weigh as much as one shape number: shapes that joints hardly show stay small."""


def reshaped(betas: Tensor, source: Body, target: Body) -> tuple[Tensor, Tensor]:
    """Shape numbers of `target` whose rest joints, seen from the pelvis, are nearest to those of `source`.

    Least squares over the 22 joints; unchanged if both bodies have the same rest joints.

    Args:
        betas: (P, 10) of `source`.
        source: the body of these numbers.
        target: the body of the result.

    Returns:
        (P, 10) float64 shape numbers of `target`, and (P, 22) metres of error of its rest joints.
    """
    betas = betas.double()
    if torch.equal(source.J_template, target.J_template) and torch.equal(source.J_shapedirs, target.J_shapedirs):
        return betas, betas.new_zeros(*betas.shape[:-1], len(source.J_template))
    wanted = _from_pelvis(source.rest_joints(betas))
    mean, directions = _from_pelvis(target.J_template.double()), target.J_shapedirs.double()
    directions = (directions - directions[:1]).flatten(0, 1)  # (66, 10)
    pulled = torch.cat([directions, PULL * torch.eye(SHAPES, dtype=torch.float64)])
    missing = (wanted - mean).flatten(-2).T  # (66, P)
    found = torch.linalg.lstsq(pulled, torch.cat([missing, missing.new_zeros(SHAPES, missing.shape[1])])).solution.T
    return found, (_from_pelvis(target.rest_joints(found)) - wanted).norm(dim=-1)


def _from_pelvis(joints: Tensor) -> Tensor:
    return joints - joints[..., :1, :]
