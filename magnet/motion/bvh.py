"""Headers of BVH files of any origin: joints with their channels, number of frames and their duration."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

AXES = "XYZ"
CHANNELS = frozenset(f"{axis}{kind}" for axis in AXES for kind in ("position", "rotation"))
STRANGE = "not a BVH file: it does not begin with HIERARCHY"


@dataclass
class BvhJoint:
    """A joint or an End Site, as written."""

    name: str  # of an End Site: empty
    parent: int  # the root's is -1
    end: bool = False
    offset: tuple[float, float, float] = (math.nan,) * 3  # in the file's unit; an End Site may lack it
    channels: tuple[str, ...] = ()  # such as "Zrotation", in the order of the numbers


@dataclass(frozen=True)
class BvhHeader:
    """K joints and End Sites in the file's order, parents first, and what is said of the frames that follow."""

    joints: tuple[BvhJoint, ...]
    frames: int
    seconds: float  # a frame lasts
    first: int  # line of the first frame, from 0
    digits: int  # behind the point, that `seconds` is written with

    @property
    def width(self) -> int:
        """Numbers a frame."""
        return sum(len(joint.channels) for joint in self.joints)


def bvh_header(lines: Sequence[str], path: object) -> BvhHeader:
    """Read a BVH file's hierarchy and the two lines after MOTION.

    Args:
        lines: of the file.
        path: what errors call it.

    Raises:
        ValueError: no BVH, cut short, or a line that makes no sense; names file and line.
    """
    _first(path, lines)
    begin = next((i for i, line in enumerate(lines) if line.strip().upper() == "MOTION"), None)
    if begin is None:
        raise ValueError(f"{path}: has no MOTION part; the file may be truncated: export it again")
    joints = parse_hierarchy(path, lines[:begin])
    head: dict[str, str] = {}
    at = begin + 1
    while at < len(lines) and len(head) < 2:
        key, colon, value = lines[at].partition(":")
        if lines[at].strip() and not colon:
            break
        if colon:
            head[" ".join(key.lower().split())] = value.strip()
        at += 1
    try:
        frames, seconds = int(head["frames"]), float(head["frame time"])
    except (KeyError, ValueError) as error:
        if comma := decimal_comma([head.get("frame time", "")]):
            raise ValueError(f"{path}:{begin + 3}: Frame Time: {comma}") from error
        raise ValueError(f"{path}:{begin + 2}: expected the lines 'Frames: N' and 'Frame Time: SECONDS'") from error
    if not 0 < seconds < 10 or frames < 1:
        raise ValueError(f"{path}:{begin + 2}: {frames} frames of {seconds:g} s; expected at least one of 0 to 10 s")
    return BvhHeader(tuple(joints), frames, seconds, at, len(head["frame time"].partition(".")[2]))


class _Hierarchy:
    """Joints, and the blocks that are open."""

    def __init__(self) -> None:
        self.joints: list[BvhJoint] = []
        self.open: list[int] = []

    def take(self, where: str, words: Sequence[str]) -> None:
        key = words[0].upper()
        if key in ("ROOT", "JOINT", "END"):
            self._begin(where, key, " ".join(words[1:]))
        elif key == "{":
            if not self.joints:
                raise ValueError(f"{where}: a brace before the ROOT")
            self.open.append(len(self.joints) - 1)
        elif key == "}":
            if not self.open:
                raise ValueError(f"{where}: a closing brace too many")
            self.open.pop()
        elif key in ("OFFSET", "CHANNELS"):
            if not self.open:
                raise ValueError(f"{where}: {key} outside a joint")
            joint = self.joints[self.open[-1]]
            if key == "OFFSET":
                joint.offset = _three(where, words[1:])
            elif not joint.end:
                joint.channels = _channels(where, words[1:])
        else:
            raise ValueError(f"{where}: {words[0]!r}: expected ROOT, JOINT, End Site, OFFSET, CHANNELS or a brace")

    def _begin(self, where: str, key: str, name: str) -> None:
        if key == "ROOT" and self.joints:
            raise ValueError(f"{where}: a second ROOT; write each person to a BVH file of their own")
        if key != "ROOT" and not self.open:
            raise ValueError(f"{where}: {_said(key)} outside the ROOT")
        if self.open and self.joints[self.open[-1]].end:
            raise ValueError(f"{where}: {_said(key)} inside an End Site, where nothing can be; is a line lost?")
        end = key == "END"
        parent = self.open[-1] if self.open else -1
        self.joints.append(BvhJoint("" if end else name or f"joint{len(self.joints)}", parent, end))


def _said(key: str) -> str:
    return {"ROOT": "a ROOT", "JOINT": "a JOINT"}.get(key, "an End Site")


def parse_hierarchy(path: object, lines: Sequence[str]) -> list[BvhJoint]:
    """Joints and End Sites of the lines before MOTION, parents first.

    Raises:
        ValueError: no BVH, incomplete, or a line that makes no sense; names file and line.
    """
    first = _first(path, lines) + 1
    reading = _Hierarchy()
    for number, line in enumerate(lines[first:], start=first + 1):
        for words in _statements(line):
            reading.take(f"{path}:{number}", words)
    whole = reading.joints and all(math.isfinite(joint.offset[0]) or joint.end for joint in reading.joints)
    if not whole or reading.open:
        raise ValueError(f"{path}: the HIERARCHY is incomplete; the file may be truncated: export it again")
    return reading.joints


def _first(path: object, lines: Sequence[str]) -> int:
    """The line of HIERARCHY, from 0; blank lines may come before it, and a byte-order mark."""
    at = next((i for i, line in enumerate(lines) if line.strip("\ufeff \t\r\n")), 0)
    if not lines or not lines[at].strip().upper().endswith("HIERARCHY"):
        raise ValueError(f"{path}: {STRANGE}")
    return at


def _statements(line: str) -> list[list[str]]:
    """Words of a line, with braces as statements of their own."""
    return [words for part in line.replace("{", "\n{\n").replace("}", "\n}\n").split("\n") if (words := part.split())]


def _channels(where: str, words: Sequence[str]) -> tuple[str, ...]:
    try:
        count = int(words[0])
    except (IndexError, ValueError) as error:
        raise ValueError(f"{where}: CHANNELS without a number of them") from error
    channels = tuple(word[:1].upper() + word[1:].lower() for word in words[1:])
    if len(channels) != count or not CHANNELS.issuperset(channels):
        raise ValueError(f"{where}: CHANNELS {' '.join(words)}: expected {count} of Xposition ... Zrotation")
    return channels


def _three(where: str, words: Sequence[str]) -> tuple[float, float, float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f"{where}: {decimal_comma(words) or f'{error}; expected 3 numbers'}") from error
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{where}: got {' '.join(words) or 'nothing'}, expected 3 finite numbers")
    return numbers[0], numbers[1], numbers[2]


def decimal_comma(words: Sequence[str]) -> str | None:
    """What to do about the first of many words that is a number with a decimal comma; None: there is none."""
    word = next((word for word in words if re.fullmatch(r"[-+]?\d*,\d+([eE][-+]?\d+)?", word)), None)
    point = "expected a point as in 0.0333333: mend the file's numbers, or export it again with points"
    return None if word is None else f"{word} has a decimal comma, {point}"
