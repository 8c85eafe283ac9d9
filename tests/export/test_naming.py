"""Joints of many programs' skeletons, by the names that those programs give them."""

from __future__ import annotations

import pytest

from magnet.body.joints import JOINT_NAMES
from magnet.export.naming import plain, recognised, split_side

MIXAMO = [
    *("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
    *("LeftHandThumb1", "RightShoulder", "RightArm", "RightForeArm", "RightHand", "LeftUpLeg", "LeftLeg", "LeftFoot"),
    *("LeftToeBase", "RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
]
USUAL = "LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftShoulder LeftArm LeftForeArm LeftHand Neck Head"
SKELETONS: dict[str, tuple[str, str]] = {
    "Mixamo": (" ".join(f"mixamorig:{name}" for name in MIXAMO), " ".join(f"mixamorig:{x}" for x in USUAL.split())),
    "Mixamo in glTF": (
        " ".join(f"mixamorig{name}" for name in MIXAMO),
        " ".join(f"mixamorig{x}" for x in USUAL.split()),
    ),
    "OptiTrack": (
        " ".join(f"Skeleton001_{name}" for name in MIXAMO),
        " ".join(f"Skeleton001_{x}" for x in USUAL.split()),
    ),
    "HumanIK with name spaces": (
        " ".join(f"anna:rig:{x}" for x in MIXAMO),
        " ".join(f"anna:rig:{x}" for x in USUAL.split()),
    ),
    "paths in Maya": (
        " ".join(f"|anna|{x}" for x in MIXAMO),
        " ".join(f"|anna|{x}" for x in USUAL.split()),
    ),
    "Sketchfab": (
        " ".join(f"mixamorig:{name}_{k:02}" for k, name in enumerate(MIXAMO)),
        " ".join(f"mixamorig:{name}_{MIXAMO.index(name):02}" for name in USUAL.split()),
    ),
    "VRoid": (
        "Root J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head J_Sec_L_Bust1 "
        "J_Bip_L_Shoulder J_Bip_L_UpperArm J_Bip_L_LowerArm J_Bip_L_Hand J_Bip_L_Index1 J_Bip_R_Shoulder "
        "J_Bip_R_UpperArm J_Bip_R_LowerArm J_Bip_R_Hand J_Bip_L_UpperLeg J_Bip_L_LowerLeg J_Bip_L_Foot "
        "J_Bip_L_ToeBase J_Bip_R_UpperLeg J_Bip_R_LowerLeg J_Bip_R_Foot J_Bip_R_ToeBase",
        "J_Bip_L_UpperLeg J_Bip_L_LowerLeg J_Bip_L_Foot J_Bip_L_ToeBase J_Bip_L_Shoulder J_Bip_L_UpperArm "
        "J_Bip_L_LowerArm J_Bip_L_Hand J_Bip_C_Neck J_Bip_C_Head",
    ),
    "VRM": (
        "hips spine chest upperChest neck head leftUpperLeg leftLowerLeg leftFoot leftToes rightUpperLeg rightLowerLeg "
        "rightFoot rightToes leftShoulder leftUpperArm leftLowerArm leftHand rightShoulder rightUpperArm "
        "rightLowerArm rightHand",
        "leftUpperLeg leftLowerLeg leftFoot leftToes leftShoulder leftUpperArm leftLowerArm leftHand neck head",
    ),
    "Character Creator": (
        "RL_BoneRoot CC_Base_Hip CC_Base_Pelvis CC_Base_L_Thigh CC_Base_L_Calf CC_Base_L_Foot CC_Base_L_ToeBase "
        "CC_Base_L_CalfTwist01 CC_Base_R_Thigh CC_Base_R_Calf CC_Base_R_Foot CC_Base_R_ToeBase CC_Base_Waist "
        "CC_Base_Spine01 CC_Base_Spine02 CC_Base_NeckTwist01 CC_Base_NeckTwist02 CC_Base_Head CC_Base_L_Clavicle "
        "CC_Base_L_Upperarm CC_Base_L_Forearm CC_Base_L_Hand CC_Base_R_Clavicle CC_Base_R_Upperarm "
        "CC_Base_R_Forearm CC_Base_R_Hand",
        "CC_Base_L_Thigh CC_Base_L_Calf CC_Base_L_Foot CC_Base_L_ToeBase CC_Base_L_Clavicle CC_Base_L_Upperarm "
        "CC_Base_L_Forearm CC_Base_L_Hand CC_Base_NeckTwist01 CC_Base_Head",
    ),
    "Unreal's Manny": (
        "root pelvis spine_01 spine_02 spine_03 spine_04 spine_05 neck_01 neck_02 head clavicle_l upperarm_l "
        "upperarm_twist_01_l lowerarm_l hand_l index_01_l clavicle_r upperarm_r lowerarm_r hand_r thigh_l "
        "thigh_twist_01_l calf_l foot_l ball_l thigh_r calf_r foot_r ball_r ik_foot_root ik_foot_l ik_hand_root "
        "ik_hand_gun ik_hand_l",
        "thigh_l calf_l foot_l ball_l clavicle_l upperarm_l lowerarm_l hand_l neck_01 head",
    ),
    "Daz Genesis 8": (
        "hip pelvis lThighBend lThighTwist lShin lFoot lMetatarsals lToe rThighBend rThighTwist rShin rFoot "
        "rMetatarsals rToe abdomenLower abdomenUpper chestLower chestUpper lCollar lShldrBend lShldrTwist "
        "lForearmBend lForearmTwist lHand rCollar rShldrBend rShldrTwist rForearmBend rForearmTwist rHand neckLower "
        "neckUpper head",
        "lThighBend lShin lFoot lToe lCollar lShldrBend lForearmBend lHand neckLower head",
    ),
    "MakeHuman": (
        "root pelvis.L upperleg01.L upperleg02.L lowerleg01.L lowerleg02.L foot.L toe1-1.L pelvis.R upperleg01.R "
        "upperleg02.R lowerleg01.R lowerleg02.R foot.R toe1-1.R spine05 spine04 spine03 spine02 spine01 neck01 "
        "neck02 neck03 head clavicle.L shoulder01.L upperarm01.L upperarm02.L lowerarm01.L lowerarm02.L wrist.L "
        "clavicle.R shoulder01.R upperarm01.R upperarm02.R lowerarm01.R lowerarm02.R wrist.R",
        "upperleg01.L lowerleg01.L foot.L toe1-1.L clavicle.L upperarm01.L lowerarm01.L wrist.L neck01 head",
    ),
    "Meta's body tracking": (
        "Root Hips SpineLower SpineMiddle SpineUpper Chest Neck Head LeftShoulder LeftScapula LeftArmUpper "
        "LeftArmLower LeftHandWristTwist LeftHandPalm LeftHandWrist RightShoulder RightScapula RightArmUpper "
        "RightArmLower RightHandWrist LeftUpperLeg LeftLowerLeg LeftFootAnkle LeftFootBall RightUpperLeg "
        "RightLowerLeg RightFootAnkle RightFootBall",
        "LeftUpperLeg LeftLowerLeg LeftFootAnkle LeftFootBall LeftShoulder LeftArmUpper LeftArmLower LeftHandWrist "
        "Neck Head",
    ),
    "MikuMikuDance": (
        "center lower_body upper_body upper_body2 neck head leg_L knee_L ankle_L toe_L leg_R knee_R ankle_R toe_R "
        "shoulder_L arm_L elbow_L wrist_L shoulder_R arm_R elbow_R wrist_R",
        "leg_L knee_L ankle_L toe_L shoulder_L arm_L elbow_L wrist_L neck head",
    ),
    "Rigify's bones that deform": (
        "DEF-spine DEF-pelvis.L DEF-pelvis.R DEF-thigh.L DEF-thigh.L.001 DEF-shin.L DEF-shin.L.001 DEF-foot.L "
        "DEF-toe.L DEF-thigh.R DEF-thigh.R.001 DEF-shin.R DEF-shin.R.001 DEF-foot.R DEF-toe.R DEF-spine.001 "
        "DEF-spine.002 DEF-spine.003 DEF-spine.004 DEF-spine.005 DEF-spine.006 DEF-breast.L DEF-breast.R "
        "DEF-shoulder.L DEF-upper_arm.L DEF-upper_arm.L.001 DEF-forearm.L DEF-forearm.L.001 DEF-hand.L DEF-palm.01.L "
        "DEF-f_index.01.L DEF-thumb.01.L DEF-shoulder.R DEF-upper_arm.R DEF-upper_arm.R.001 DEF-forearm.R "
        "DEF-forearm.R.001 DEF-hand.R",
        "DEF-thigh.L DEF-shin.L DEF-foot.L DEF-toe.L DEF-shoulder.L DEF-upper_arm.L DEF-forearm.L DEF-hand.L "
        "DEF-spine.004 DEF-spine.006",
    ),
    "Rigify's human": (
        "spine spine.001 spine.002 spine.003 spine.004 spine.005 spine.006 face nose ear.L jaw pelvis.L pelvis.R "
        "breast.L breast.R shoulder.L upper_arm.L forearm.L hand.L palm.01.L f_index.01.L thumb.01.L shoulder.R "
        "upper_arm.R forearm.R hand.R thigh.L shin.L foot.L toe.L heel.02.L thigh.R shin.R foot.R toe.R heel.02.R",
        "thigh.L shin.L foot.L toe.L shoulder.L upper_arm.L forearm.L hand.L spine.004 spine.006",
    ),
    "Advanced Skeleton": (
        "Root_M Hip_R Knee_R Ankle_R Toes_R Spine1_M Chest_M Neck_M Head_M Collar_R Shoulder_R Elbow_R Wrist_R "
        "Collar_L Shoulder_L Elbow_L Wrist_L Hip_L Knee_L Ankle_L Toes_L",
        "Hip_L Knee_L Ankle_L Toes_L Collar_L Shoulder_L Elbow_L Wrist_L Neck_M Head_M",
    ),
    "DeepMotion": (
        "Armature hips_JNT spine_JNT spine1_JNT spine2_JNT neck_JNT head_JNT l_shoulder_JNT l_arm_JNT l_forearm_JNT "
        "l_hand_JNT l_handThumb1_JNT r_shoulder_JNT r_arm_JNT r_forearm_JNT r_hand_JNT l_upleg_JNT l_leg_JNT "
        "l_foot_JNT l_toebase_JNT r_upleg_JNT r_leg_JNT r_foot_JNT r_toebase_JNT",
        "l_upleg_JNT l_leg_JNT l_foot_JNT l_toebase_JNT l_shoulder_JNT l_arm_JNT l_forearm_JNT l_hand_JNT neck_JNT "
        "head_JNT",
    ),
    "ARKit": (
        "root hips_joint left_upLeg_joint left_leg_joint left_foot_joint left_toes_joint right_upLeg_joint "
        "right_leg_joint right_foot_joint right_toes_joint spine_1_joint spine_7_joint left_shoulder_joint "
        "left_arm_joint left_forearm_joint left_hand_joint right_shoulder_joint right_arm_joint right_forearm_joint "
        "right_hand_joint neck_1_joint neck_2_joint head_joint",
        "left_upLeg_joint left_leg_joint left_foot_joint left_toes_joint left_shoulder_joint left_arm_joint "
        "left_forearm_joint left_hand_joint neck_1_joint head_joint",
    ),
    "Poser": (
        "hip abdomen chest neck head lCollar lShldr lForeArm lHand rCollar rShldr rForeArm rHand lButtock lThigh lShin "
        "lFoot lToe rButtock rThigh rShin rFoot rToe",
        "lThigh lShin lFoot lToe lCollar lShldr lForeArm lHand neck head",
    ),
    "Auto-Rig Pro": (
        "root.x spine_01.x spine_02.x neck.x head.x shoulder.l arm_stretch.l arm_twist.l forearm_stretch.l "
        "forearm_twist.l hand.l shoulder.r arm_stretch.r forearm_stretch.r hand.r thigh_stretch.l thigh_twist.l "
        "leg_stretch.l leg_twist.l foot.l toes_01.l thigh_stretch.r leg_stretch.r foot.r toes_01.r",
        "thigh_stretch.l leg_stretch.l foot.l toes_01.l shoulder.l arm_stretch.l forearm_stretch.l hand.l neck.x "
        "head.x",
    ),
    "SOMA": (
        "Root Hips Spine1 Spine2 Chest Neck1 Neck2 Head Jaw LeftEye LeftShoulder LeftArm LeftForeArm LeftHand "
        "LeftHandThumb1 RightShoulder RightArm RightForeArm RightHand LeftLeg LeftShin LeftFoot LeftToeBase RightLeg "
        "RightShin RightFoot RightToeBase",
        "LeftLeg LeftShin LeftFoot LeftToeBase LeftShoulder LeftArm LeftForeArm LeftHand Neck1 Head",
    ),
    "Synty": (
        "Root Hips Spine_01 Spine_02 Spine_03 Neck Head Clavicle_L Shoulder_L Elbow_L Hand_L Clavicle_R Shoulder_R "
        "Elbow_R Hand_R UpperLeg_L LowerLeg_L Ankle_L Ball_L UpperLeg_R LowerLeg_R Ankle_R Ball_R",
        "UpperLeg_L LowerLeg_L Ankle_L Ball_L Clavicle_L Shoulder_L Elbow_L Hand_L Neck Head",
    ),
    "Second Life": (
        "mPelvis mTorso mChest mNeck mHead mSkull mEyeLeft mEyeRight mCollarLeft mShoulderLeft mElbowLeft mWristLeft "
        "mHandThumb1Left mHandIndex1Left mCollarRight mShoulderRight mElbowRight mWristRight mHipLeft mKneeLeft "
        "mAnkleLeft mFootLeft mToeLeft mHipRight mKneeRight mAnkleRight mFootRight mToeRight",
        "mHipLeft mKneeLeft mAnkleLeft mFootLeft mCollarLeft mShoulderLeft mElbowLeft mWristLeft mNeck mHead",
    ),
    "CAT, a figure called Garg": (
        "GargPelvis GargSpine1 GargSpine2 GargRibcage GargNeck1 GargHead GargLArmCollarbone GargLArmUpperarm1 "
        "GargLArmUpperarm2 GargLArmForearm1 GargLArmForearm2 GargLArmPalm GargRCollarbone GargRUpperarm1 "
        "GargRForearm1 GargRPalm GargLLegThigh1 GargLLegThigh2 GargLLegCalf1 GargLLegAnkle GargLLegToe1 GargRThigh1 "
        "GargRThigh2 GargRCalf1 GargRAnkle GargRToe1",
        "GargLLegThigh1 GargLLegCalf1 GargLLegAnkle GargLLegToe1 GargLArmCollarbone GargLArmUpperarm1 "
        "GargLArmForearm1 GargLArmPalm GargNeck1 GargHead",
    ),
    "CAT's Base Human": (
        "Base_HumanPelvis Base_HumanSpine1 Base_HumanRibcage Base_HumanNeck Base_HumanHead "
        "Base_HumanRArmCollarbone Base_HumanRArmUpperarm Base_HumanRArmForearm Base_HumanRArmPalm "
        "Base_HumanLArmCollarbone Base_HumanLArmUpperarm Base_HumanLArmForearm Base_HumanLArmPalm Base_HumanRThigh "
        "Base_HumanRCalf Base_HumanRFoot Base_HumanRDigit11 Base_HumanLLegThigh Base_HumanLLegCalf "
        "Base_HumanLLegFoot Base_HumanLLegDigit11",
        "Base_HumanLLegThigh Base_HumanLLegCalf Base_HumanLLegFoot Base_HumanLLegDigit11 Base_HumanLArmCollarbone "
        "Base_HumanLArmUpperarm Base_HumanLArmForearm Base_HumanLArmPalm Base_HumanNeck Base_HumanHead",
    ),
    "MikuMikuDance in Japanese": (
        "全ての親 センター グルーブ 腰 下半身 上半身 上半身2 首 頭 左目 左肩P 左肩 左肩C 左腕 左腕捩 左ひじ "
        "左手捩 左手首 左親指０ 左人指１ 右肩P 右肩 右肩C 右腕 右腕捩 右ひじ 右手捩 右手首 左足 左ひざ "
        "左足首 左つま先 右足 右ひざ 右足首 右つま先 左足D 左ひざD 左足首D 左足先EX 左足ＩＫ",
        "左足 左ひざ 左足首 左つま先 左肩 左腕 左ひじ 左手首 首 頭",
    ),
    "MikuMikuDance in Blender": (
        "センター 下半身 上半身 上半身2 首 頭 肩.L 腕.L ひじ.L 手首.L 肩.R 腕.R ひじ.R 手首.R 足.L "
        "ひざ.L 足首.L つま先.L 足.R ひざ.R 足首.R つま先.R",
        "足.L ひざ.L 足首.L つま先.L 肩.L 腕.L ひじ.L 手首.L 首 頭",
    ),
    "German": (
        "Becken Bauch Brust Hals Kopf Schulter.L Oberarm.L Unterarm.L Hand.L Schulter.R Oberarm.R Unterarm.R Hand.R "
        "Oberschenkel.L Unterschenkel.L Fuss.L Oberschenkel.R Unterschenkel.R Fuss.R",
        "Oberschenkel.L Unterschenkel.L Fuss.L - Schulter.L Oberarm.L Unterarm.L Hand.L Hals Kopf",
    ),
    "Theia": (
        "pelvis abdomen thorax neck head l_uarm l_larm l_hand r_uarm r_larm r_hand l_thigh l_shank l_foot l_toes "
        "r_thigh r_shank r_foot r_toes",
        "l_thigh l_shank l_foot l_toes - l_uarm l_larm l_hand neck head",
    ),
    "a prefix that the root has not": (
        "Reference " + " ".join(f"Anna_{name}" for name in MIXAMO),
        " ".join(f"Anna_{name}" for name in USUAL.split()),
    ),
}
LEFT = ("left_hip", "left_knee", "left_ankle", "left_foot", "left_collar", "left_shoulder", "left_elbow", "left_wrist")
NEEDED = tuple(ours for ours in LEFT if ours not in ("left_foot", "left_collar"))


@pytest.mark.parametrize("program", SKELETONS)
def test_joints_are_recognised_by_the_names_of_programs(program: str) -> None:
    names, expected = (said.split() for said in SKELETONS[program])
    found = recognised(names)
    assert not found.missing
    for ours, theirs in zip((*LEFT, "neck", "head"), expected, strict=True):
        joint = found.joints.get(JOINT_NAMES.index(ours))
        assert ("-" if joint is None else names[joint]) == theirs, ours
    right = [found.joints[JOINT_NAMES.index(ours.replace("left", "right"))] for ours in LEFT if ours in NEEDED]
    assert not {names[k] for k in right} & set(expected) and len(set(right)) == len(NEEDED)


@pytest.mark.parametrize(
    ("program", "scheme"),
    [("VRM", "VRM, Unity"), ("VRoid", "VRM, Unity"), ("Mixamo", "Mixamo, MotionBuilder")],
)
def test_the_program_whose_names_they_are_is_told(program: str, scheme: str) -> None:
    assert recognised(SKELETONS[program][0].split()).scheme == scheme


def test_numbers_that_tell_joints_apart_stay() -> None:
    assert plain(["spine_01", "spine_02", "head", "thigh_l", "thigh_r"])[:2] == ["spine_01", "spine_02"]
    bare = ["hip", "knee", "ankle", "neck", "head"]
    assert plain([f"{name}_{k}" for k, name in enumerate(bare)]) == bare


def test_the_middle_of_a_body_is_no_side() -> None:
    assert split_side("C_Hips") == split_side("Hips_M") == ("", {"hips"})
    assert split_side("L_Hip")[0] == "left" and split_side("chest") == ("", {"chest"})
