"""Names of joints: each number has the name that the table gives it, and the tree is that of SMPL's family."""

from __future__ import annotations

from magnet.body import joints
from magnet.motion.scene import BODY_JOINTS


def test_every_joint_is_named_and_numbered_alike():
    assert len(joints.JOINT_NAMES) == len(joints.PARENTS) == len(joints.MIRROR) == BODY_JOINTS
    for number, name in enumerate(joints.JOINT_NAMES):
        constant = name.upper().replace("LEFT_", "L_").replace("RIGHT_", "R_")
        assert getattr(joints, constant) == number


def test_groups_hold_left_before_right():
    for group in ("HIPS", "KNEES", "ANKLES", "TOES", "COLLARS", "SHOULDERS", "ELBOWS", "WRISTS"):
        left, right = getattr(joints, group)
        assert joints.JOINT_NAMES[left].startswith("left_") and joints.MIRROR[left] == right
        assert joints.JOINT_NAMES[right].startswith("right_")


def test_the_tree_is_that_of_smpl():
    """The first 22 of `kintree_table` in SMPL's files."""
    assert joints.PARENTS == (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
    assert all(joints.MIRROR[joints.PARENTS[j]] == joints.PARENTS[joints.MIRROR[j]] for j in range(1, BODY_JOINTS))
