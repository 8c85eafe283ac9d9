"""The 22 joints of scenes: the pelvis and the body joints that SMPL, SMPL-H and SMPL-X share."""

JOINT_NAMES: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip

PELVIS, L_HIP, R_HIP, SPINE1, L_KNEE, R_KNEE, SPINE2, L_ANKLE, R_ANKLE, SPINE3, L_FOOT, R_FOOT = range(12)
NECK, L_COLLAR, R_COLLAR, HEAD, L_SHOULDER, R_SHOULDER, L_ELBOW, R_ELBOW, L_WRIST, R_WRIST = range(12, 22)

HIPS, KNEES, ANKLES, TOES = (L_HIP, R_HIP), (L_KNEE, R_KNEE), (L_ANKLE, R_ANKLE), (L_FOOT, R_FOOT)
COLLARS, SHOULDERS = (L_COLLAR, R_COLLAR), (L_SHOULDER, R_SHOULDER)
ELBOWS, WRISTS = (L_ELBOW, R_ELBOW), (L_WRIST, R_WRIST)
SPINE = (PELVIS, SPINE1, SPINE2, SPINE3)
FEET = (*ANKLES, *TOES)
"""Left before right. SMPL's joint `foot` is the ball of the foot, here called toe."""

PARENTS: tuple[int, ...] = (
    -1, PELVIS, PELVIS, PELVIS, L_HIP, R_HIP, SPINE1, L_KNEE, R_KNEE, SPINE2, L_ANKLE, R_ANKLE, SPINE3, SPINE3, SPINE3,
    NECK, L_COLLAR, R_COLLAR, L_SHOULDER, R_SHOULDER, L_ELBOW, R_ELBOW,
)  # fmt: skip
"""Each joint's parent."""

MIRROR: tuple[int, ...] = (
    PELVIS, R_HIP, L_HIP, SPINE1, R_KNEE, L_KNEE, SPINE2, R_ANKLE, L_ANKLE, SPINE3, R_FOOT, L_FOOT, NECK, R_COLLAR,
    L_COLLAR, HEAD, R_SHOULDER, L_SHOULDER, R_ELBOW, L_ELBOW, R_WRIST, L_WRIST,
)  # fmt: skip
"""Each joint's counterpart on the other side; joints on the midline are their own."""
