"""Recognises joints of other programs' skeletons by common naming schemes."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from magnet.body.joints import (  # isort: skip
    ANKLES, ELBOWS, HEAD, HIPS, JOINT_NAMES, KNEES, L_ANKLE, L_COLLAR, L_ELBOW, L_FOOT, L_HIP, L_KNEE, L_SHOULDER,
    L_WRIST, NECK, SHOULDERS, WRISTS,
)  # fmt: skip

SIDED: dict[str, int] = {
    "hip": L_HIP, "knee": L_KNEE, "ankle": L_ANKLE, "foot": L_FOOT, "collar": L_COLLAR, "shoulder": L_SHOULDER,
    "elbow": L_ELBOW, "wrist": L_WRIST,
}  # fmt: skip
"""Our left joint of each role; the right one follows it."""
MIDDLE: dict[str, int] = {"neck": NECK, "head": HEAD}
NEEDED = (*HIPS, *KNEES, *ANKLES, *SHOULDERS, *ELBOWS, *WRISTS)
"""Limb joints without which nobody can be posed; the spine is found in the hierarchy, the rest may be missing."""

SCHEMES: dict[str, dict[str, tuple[str, ...]]] = {
    "SMPL-X, Biovision, Xsens": {
        "hip": ("hip",), "knee": ("knee",), "ankle": ("ankle",), "foot": ("foot", "toe", "toes", "toebase"),
        "collar": ("collar", "thorax", "clavicle"), "shoulder": ("shoulder",), "elbow": ("elbow",),
        "wrist": ("wrist",), "neck": ("neck", "neck1"), "head": ("head",),
    },
    "CMU": {
        "hip": ("upleg",), "knee": ("leg",), "ankle": ("foot",), "foot": ("toebase",), "collar": ("shoulder",),
        "shoulder": ("arm",), "elbow": ("forearm",), "wrist": ("fingerbase",), "neck": ("neck",), "head": ("head",),
    },
    "VRM, Unity": {
        "hip": ("upperleg",), "knee": ("lowerleg",), "ankle": ("foot",), "foot": ("toes", "toebase"),
        "collar": ("shoulder",), "shoulder": ("upperarm",), "elbow": ("lowerarm",), "wrist": ("hand",),
        "neck": ("neck",), "head": ("head",),
    },
    "Mixamo, MotionBuilder": {
        "hip": ("upleg", "upperleg", "thigh"), "knee": ("leg", "lowleg", "lowerleg", "shin"), "ankle": ("foot",),
        "foot": ("toebase", "toe", "toes"), "collar": ("shoulder", "collar"), "shoulder": ("arm", "uparm", "upperarm"),
        "elbow": ("forearm", "lowarm", "lowerarm"), "wrist": ("hand",), "neck": ("neck", "neck1"), "head": ("head",),
    },
    "3ds Max Biped, Unreal, Rigify, Character Creator": {
        "hip": ("thigh",), "knee": ("calf", "shin"), "ankle": ("foot",), "foot": ("toe0", "toe", "ball", "toebase"),
        "collar": ("clavicle", "shoulder"), "shoulder": ("upperarm",), "elbow": ("forearm", "lowerarm"),
        "wrist": ("hand",), "neck": ("neck", "neck01", "neck1", "necktwist01", "spine004"),
        "head": ("head", "spine006"),
    },
    "Motive": {
        "hip": ("thigh",), "knee": ("shin",), "ankle": ("foot",), "foot": ("toe",), "collar": ("shoulder",),
        "shoulder": ("uarm",), "elbow": ("farm",), "wrist": ("hand",), "neck": ("neck",), "head": ("head",),
    },
    "Acclaim": {
        "hip": ("femur",), "knee": ("tibia",), "ankle": ("foot",), "foot": ("toes",), "collar": ("clavicle",),
        "shoulder": ("humerus",), "elbow": ("radius",), "wrist": ("hand", "wrist"), "neck": ("lowerneck",),
        "head": ("head",),
    },
    "Daz": {
        "hip": ("thighbend",), "knee": ("shin",), "ankle": ("foot",), "foot": ("toe",), "collar": ("collar",),
        "shoulder": ("shldrbend",), "elbow": ("forearmbend",), "wrist": ("hand",), "neck": ("necklower",),
        "head": ("head",),
    },
    "MakeHuman": {
        "hip": ("upperleg01",), "knee": ("lowerleg01",), "ankle": ("foot",), "foot": ("toe11",),
        "collar": ("clavicle",), "shoulder": ("upperarm01",), "elbow": ("lowerarm01",), "wrist": ("wrist",),
        "neck": ("neck01",), "head": ("head",),
    },
    "Meta": {
        "hip": ("upperleg",), "knee": ("lowerleg",), "ankle": ("footankle",), "foot": ("football",),
        "collar": ("shoulder",), "shoulder": ("armupper",), "elbow": ("armlower",), "wrist": ("handwrist",),
        "neck": ("neck",), "head": ("head",),
    },
    "MikuMikuDance": {
        "hip": ("leg",), "knee": ("knee",), "ankle": ("ankle",), "foot": ("toe",), "collar": ("shoulder",),
        "shoulder": ("arm",), "elbow": ("elbow",), "wrist": ("wrist",), "neck": ("neck",), "head": ("head",),
    },
    "MikuMikuDance in Japanese": {
        "hip": ("足",), "knee": ("ひざ",), "ankle": ("足首",), "foot": ("つま先", "足先ex"), "collar": ("肩",),
        "shoulder": ("腕",), "elbow": ("ひじ",), "wrist": ("手首",), "neck": ("首",), "head": ("頭",),
    },
    "CAT": {
        "hip": ("legthigh", "legthigh1", "thigh", "thigh1"), "knee": ("legcalf", "legcalf1", "calf", "calf1"),
        "ankle": ("legfoot", "legankle", "foot", "ankle"), "foot": ("legtoe1", "legdigit11", "toe1", "toe", "digit11"),
        "collar": ("armcollarbone", "collarbone"), "shoulder": ("armupperarm", "armupperarm1", "upperarm", "upperarm1"),
        "elbow": ("armforearm", "armforearm1", "forearm", "forearm1"), "wrist": ("armpalm", "palm"),
        "neck": ("neck", "neck1"), "head": ("head",),
    },
    "Theia": {
        "hip": ("thigh",), "knee": ("shank",), "ankle": ("foot",), "foot": ("toes",), "shoulder": ("uarm",),
        "elbow": ("larm",), "wrist": ("hand",), "neck": ("neck",), "head": ("head",),
    },
    "German": {
        "hip": ("oberschenkel",), "knee": ("unterschenkel",), "ankle": ("fuss", "fuß"),
        "collar": ("schulter",), "shoulder": ("oberarm",), "elbow": ("unterarm",), "wrist": ("hand",),
        "neck": ("hals",), "head": ("kopf",),
    },
    "no one program": {
        "knee": ("knee", "shin", "calf", "lowerleg", "lowleg", "leg", "legstretch"),
        "hip": ("upleg", "upperleg", "thigh", "hip", "leg", "thighstretch"),
        "ankle": ("ankle", "foot"), "foot": ("ball", "toebase", "toe", "toes", "toe0", "toes01", "foot"),
        "shoulder": ("upperarm", "uparm", "arm", "armstretch", "shldr", "shoulder"),
        "collar": ("clavicle", "collar", "shoulder"),
        "elbow": ("elbow", "forearm", "lowerarm", "lowarm", "forearmstretch"), "wrist": ("wrist", "hand", "palm"),
        "neck": ("neck", "neck1", "neck01"), "head": ("head", "head1"),
    },
}  # fmt: skip
"""Names of each role without the side, spaces or punctuation. One word means another joint in another scheme.

CMU's bone `wrist`, which its conversions call Hand, is the last third of the forearm: the wrist is where the next one
begins. The last scheme is for what mixes words of the others: a word is of the first role there that it is left for, so
that a leg beside a shin begins at the hip.
"""
PREFIX = re.compile(r"(?i)^(bip\d+|mixamorig\d*|skeleton\d*|character\d*|def|org|j_bip|j_sec|cc_base)[ _.\-]*(?=.)")
"""What names of only some of a skeleton's joints begin with."""
NUMBERED, MOST = re.compile(r"_(\d+)$"), 0.8
"""The number of a node behind a joint's name, and the share of names that end in another one each where it is that; or
that begin or end with the same word where it says nothing."""
BEGUN = re.compile(r"(?<=[a-z])(?=[A-Z])")
"""Where a word begins in a name without spaces, such as FredLThigh or mHipLeft."""
SIDES = {"左": "left", "右": "right"}
FIRST, LAST = re.compile(r"[^ _.\-]+[ _.\-]+(?=.)"), re.compile(r"[ _.\-]+[^ _.\-]+$")
SIGNS = {"CMU": "left:hipjoint"}
"""A joint that identifies a scheme whose other names also occur in another scheme."""


@dataclass(frozen=True)
class Naming:
    """The naming scheme of a skeleton, and which of its joints each of ours is."""

    scheme: str
    joints: dict[int, int]

    @property
    def missing(self) -> list[str]:
        """Joints of ours that are needed and that no name matches."""
        return [JOINT_NAMES[j] for j in NEEDED if j not in self.joints]


def recognised(names: Sequence[str], given: Mapping[str, str] | None = None) -> Naming:
    """The scheme that explains most of a skeleton's names.

    given: our joint's name to theirs, if names alone do not tell; it overrides any scheme.

    Raises:
        ValueError: `given` names a joint that does not exist.
    """
    words = [split_side(name) for name in plain(names)]
    best = Naming("none", {})
    for scheme, roles in SCHEMES.items():
        if scheme in SIGNS and not any(SIGNS[scheme] in rests for _, rests in words):
            continue
        found = _matched(words, roles)
        if _score(found) > _score(best.joints):
            best = Naming(scheme, found)
    if not given:
        return best
    return Naming(best.scheme, best.joints | dict(_told(names, given)))


def _told(names: Sequence[str], given: Mapping[str, str]) -> list[tuple[int, int]]:
    told = []
    for ours, theirs in given.items():
        if ours not in JOINT_NAMES or theirs not in names:
            what = f"we have {', '.join(JOINT_NAMES)}" if ours not in JOINT_NAMES else f"it has {', '.join(names)}"
            raise ValueError(f"joint {ours}={theirs}: expected OUR_NAME=THEIR_NAME; {what}")
        told.append((JOINT_NAMES.index(ours), names.index(theirs)))
    return told


def _score(joints: Mapping[int, int]) -> tuple[int, int]:
    return sum(j in joints for j in NEEDED), len(joints)


def _matched(words: Sequence[tuple[str, set[str]]], roles: Mapping[str, tuple[str, ...]]) -> dict[int, int]:
    found: dict[int, int] = {}
    for role, known in roles.items():
        sides = (("left", SIDED[role]), ("right", SIDED[role] + 1)) if role in SIDED else (("", MIDDLE[role]),)
        for side, joint in sides:
            for word in (f"{side}:{name}" if side else name for name in known):
                free = ((k, *each) for k, each in enumerate(words) if k not in found.values())
                numbers = [k for k, its, rests in free if its in (side, "?") and word in rests]
                if numbers and joint not in found:
                    found[joint] = numbers[0]
    return found


def plain(names: Sequence[str]) -> list[str]:
    """Names without what most of them begin or end with: a namespace, a character's name, Bip01, joint; and without the
    number of the node that most end in, as Sketchfab writes it."""
    short = [re.split(r"[:|](?=.)", name)[-1] for name in names]
    numbers = [found[1] for name in short if (found := NUMBERED.search(name))]
    if len(set(numbers)) > MOST * len(names):
        short = [NUMBERED.sub("", name) for name in short]
    before: list[str] = []
    while short != before:
        before, short = short, [PREFIX.sub("", name) for name in short]
        for word in (FIRST, LAST):
            short = _without_shared(short, word)
    return _without_character(short)


def _without_character(names: Sequence[str]) -> list[str]:
    """Names without the longest beginning up to a capital that most share, as of CAT's and of Second Life's joints."""
    begins = Counter(name[: found.start()] for name in names for found in BEGUN.finditer(name))
    shared = [each for each, count in begins.items() if count >= MOST * len(names)]
    if not shared:
        return list(names)
    return [name.removeprefix(max(shared, key=len)) for name in names]


def _without_shared(names: Sequence[str], word: re.Pattern[str]) -> list[str]:
    """Names without their first or last word, where most have the same and it is no side."""
    ends = [found[0] if (found := word.search(name)) else "" for name in names]
    shared, count = next(iter(Counter(ends).most_common(1)), ("", 0))
    if not shared or count < MOST * len(names) or shared.strip(" _.-").lower() in ("l", "r", "left", "right"):
        return list(names)
    return [word.sub("", name, count=1) if end == shared else name for name, end in zip(names, ends, strict=True)]


def split_side(name: str) -> tuple[str, set[str]]:
    """The side of the body in a name ("left", "right", "" for none), and candidates for the rest of it.

    "LeftUpLeg", "upleg_l", "L UpLeg" and "lUpLeg" all give ("left", {"left:upleg"}); a name that merely begins with
    an l or r, such as "lowerback", may also be taken whole, and has side "?".
    """
    name = unicodedata.normalize("NFKC", name)
    letters = re.sub(r"[\W_]", "", name.lower())
    if name[:1] in SIDES:
        side = SIDES[name[0]]
        return side, {f"{side}:{letters[1:]}"}
    for side in ("left", "right"):
        if letters.startswith(side):
            return side, {f"{side}:{letters[len(side) :]}"}
        if letters.endswith(side):
            return side, {f"{side}:{letters[: -len(side)]}"}
    words = [word.lower() for word in re.split(r"[ _.\-]+", name) if word]
    for middle in ("c", "m", "x"):  # centre, middle, and Auto-Rig Pro's
        if middle in words and len(words) > 1:
            words.remove(middle)
            return "", {"".join(words)}
    for letter, side in (("l", "left"), ("r", "right")):
        if letter in words and len(words) > 1:
            words.remove(letter)
            return side, {f"{side}:{''.join(words)}"}
    first = {"l": "left", "r": "right"}.get(letters[:1])
    if first:
        return "?", {letters, f"{first}:{letters[1:]}"}
    return "", {letters}
