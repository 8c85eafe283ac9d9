"""Names and hierarchy of bones in files for game engines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from magnet.body.joints import JOINT_NAMES
from magnet.checks import require_choice

Names = Literal["smplx", "vrm", "mixamo"]
Root = Literal["floor", "none"]
Clips = Literal["scene", "person"]

TORSO: dict[str, tuple[str, str]] = {
    "pelvis": ("hips", "Hips"),
    "spine1": ("spine", "Spine"),
    "spine2": ("chest", "Spine1"),
    "spine3": ("upperChest", "Spine2"),
    "neck": ("neck", "Neck"),
    "head": ("head", "Head"),
}
LIMBS: dict[str, tuple[str, str]] = {
    "hip": ("UpperLeg", "UpLeg"),
    "knee": ("LowerLeg", "Leg"),
    "ankle": ("Foot", "Foot"),
    "foot": ("Toes", "ToeBase"),
    "collar": ("Shoulder", "Shoulder"),
    "shoulder": ("UpperArm", "Arm"),
    "elbow": ("LowerArm", "ForeArm"),
    "wrist": ("Hand", "Hand"),
}
"""SMPL-X's joint, and the name of the bone that begins there in VRM's humanoid (and Unity), and in Mixamo."""


def bone_names(names: Names) -> tuple[str, ...]:
    """Names of the 22 bones, in the order of `JOINT_NAMES`.

    >>> bone_names("vrm")[:3], bone_names("mixamo")[-1]
    (('hips', 'leftUpperLeg', 'rightUpperLeg'), 'mixamorig:RightHand')
    """
    require_choice("names", names, Names)
    return JOINT_NAMES if names == "smplx" else tuple(_renamed(joint, names) for joint in JOINT_NAMES)


def _renamed(joint: str, names: Names) -> str:
    which = 0 if names == "vrm" else 1
    prefix = "" if names == "vrm" else "mixamorig:"
    if joint in TORSO:
        return prefix + TORSO[joint][which]
    side, _, limb = joint.partition("_")
    return prefix + (side if names == "vrm" else side.capitalize()) + LIMBS[limb][which]


@dataclass(frozen=True)
class BoneOptions:
    """How bones are named and arranged in GLB, FBX and USD files.

    Args:
        names: bone names of SMPL-X, of VRM's humanoid, which Unity also knows, or of Mixamo.
        root: `floor`: a bone `root` on the floor under the pelvis carries place and heading, as engines expect for root
            motion; `none`: the pelvis carries them.
        clips: one animation for the whole `scene`, or one per `person`, for engines that play people separately.
    """

    names: Names = "smplx"
    root: Root = "floor"
    clips: Clips = "scene"

    def __post_init__(self) -> None:
        require_choice("names", self.names, Names)
        require_choice("root", self.root, Root)
        require_choice("clips", self.clips, Clips)
