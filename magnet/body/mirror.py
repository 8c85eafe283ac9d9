"""The mirror image of a scene."""

from magnet.body.indices import indices
from magnet.body.joints import MIRROR
from magnet.motion.scene import Scene
from magnet.waiting import constant

OTHER_SIDE = tuple(joint - 1 for joint in MIRROR[1:])


def mirror_scene(scene: Scene) -> Scene:
    """The world reflected in the plane x = 0, with left and right joints exchanged. Same shape and presence.

    A reflection M = diag(-1, 1, 1) changes a rotation R to M R M, which only flips signs, so mirroring twice gives the
    same bits. Shape numbers stay, which is exact for a symmetric body.
    """
    sign = constant((-1.0, 1.0, 1.0, 1.0), scene.T_world_root)
    flip = sign[:, None] * sign  # (4, 4): M R M for rotations, M t for translations
    swapped = scene.body_rot[..., indices(OTHER_SIDE, scene.device), :, :]
    return scene.replace(body_rot=swapped * flip[:3, :3].to(swapped.dtype), T_world_root=scene.T_world_root * flip)
