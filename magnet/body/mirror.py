"""The mirror image of a scene."""

import torch

from magnet.body.joints import MIRROR
from magnet.motion.scene import Scene


def mirror_scene(scene: Scene) -> Scene:
    """The world reflected in the plane x = 0, with left and right joints exchanged. Same shape and presence.

    A reflection M = diag(-1, 1, 1) changes a rotation R to M R M, which only flips signs, so mirroring twice gives the
    same bits. Shape numbers stay, which is exact for a symmetric body.
    """
    sign = torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=scene.T_world_root.dtype, device=scene.device)
    flip = sign[:, None] * sign  # (4, 4): M R M for rotations, M t for translations
    swapped = scene.body_rot[..., [j - 1 for j in MIRROR[1:]], :, :]
    return scene.replace(body_rot=swapped * flip[:3, :3].to(swapped.dtype), T_world_root=scene.T_world_root * flip)
