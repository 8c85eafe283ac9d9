"""Body models: shape, joints, vertices and capsules of a person; scenes mirrored, and put on the floor."""

from magnet.body.base import Body, load_body
from magnet.body.capsules import CAPSULES, Capsule, capsule_segments
from magnet.body.floor import on_floor
from magnet.body.joints import JOINT_NAMES, MIRROR, PARENTS
from magnet.body.mirror import mirror_scene

__all__ = [
    "CAPSULES",
    "JOINT_NAMES",
    "MIRROR",
    "PARENTS",
    "Body",
    "Capsule",
    "capsule_segments",
    "load_body",
    "mirror_scene",
    "on_floor",
]
