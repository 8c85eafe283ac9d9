"""Several groups on one floor: scenes of three and four people made of scenes of one and two."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.motion.frames import from_planar
from magnet.motion.planar import rotate_ground


def place_apart(
    T_world_root: Tensor, present: Tensor, second: Tensor, relative_pose: Tensor, clearance: float
) -> Tensor:
    """Turn each scene's second group about its own centre and put it beside the first.

    A group's centre is the mean of its pelvises over people and frames. Where pelvises of the two groups
    would come closer than `clearance` at any frame, the groups move further apart in the same direction.
    Heights do not change.

    Args:
        T_world_root: (B, T, P, 4, 4) pelvis poses; each group in its own recording's world.
        present: (B, P) bool.
        second: (B, P) bool, True for people of the second group.
        relative_pose: (B, 3) radians that the second group turns; direction in radians, 0 along +z, of its centre as
            seen from the first group's; least metres between the centres.
        clearance: metres between pelvises of different groups, at every frame.

    Returns:
        (B, T, P, 4, 4) in the first group's world.
    """
    yaw, direction, distance = relative_pose.unbind(-1)
    ground = T_world_root[..., [0, 2], 3]
    ours, theirs = present & ~second, present & second

    def centre(group: Tensor) -> Tensor:
        people = group.sum(dim=1).clamp_min(1) * ground.shape[1]
        return (ground * group[:, None, :, None]).sum(dim=(1, 2)) / people[:, None]

    near, far = centre(ours), centre(theirs)
    turned = rotate_ground(yaw[:, None, None], ground - far[:, None, None])
    # At distance d along u, a pair is |d u - offset| apart: solve for the largest d where that is `clearance`.
    offset = (ground - near[:, None, None])[:, :, :, None] - turned[:, :, None]  # (B, T, P, P, 2)
    x, z = offset.unbind(-1)
    sin, cos = direction.sin()[:, None, None, None], direction.cos()[:, None, None, None]
    along, across = x * sin + z * cos, x * cos - z * sin
    reach = (clearance**2 - across**2).clamp_min(0.0).sqrt()
    matters = ours[:, None, :, None] & theirs[:, None, None, :] & (across.abs() < clearance)
    needed = torch.where(matters, along + reach, -torch.inf).flatten(1).amax(dim=1)
    distance = torch.maximum(distance, needed)

    heading = torch.stack([direction.sin(), direction.cos()], dim=-1)
    T_new_world = from_planar(yaw, near + distance[:, None] * heading - rotate_ground(yaw, far))
    return torch.where(theirs[:, None, :, None, None], T_new_world[:, None, None] @ T_world_root, T_world_root)
