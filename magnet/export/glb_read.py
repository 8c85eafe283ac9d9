"""Reader of glTF files: every skinned skeleton is a person, sampled at one rate, from a rest pose as BVH has them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from magnet.export.cutting import kept_frames
from magnet.export.gltf_file import DEFAULTS, GltfFile, matrices, sampled
from magnet.export.rig import people_of
from magnet.export.rig_motion import LONGEST, Floats, RigMotion, rest_of, usual_rate
from magnet.motion.scene import FPS

FEWEST_BONES = 12
"""Nodes that a skeleton without a skin has at least."""
SPARSE = 10.0
"""Keys a second under which they are poses to go between, and not frames."""
EVEN = 0.03
"""Share of a frame by which keys of frames may be off."""
ALONG = 0.05
"""Largest entry by which a rotation may differ from one of axes onto axes to be taken for it."""
SKEWED = 1e-5
"""Largest scalar product of two axes of a rotation; what is over it is brought to the nearest rotation."""


@dataclass(frozen=True)
class Track:
    """What moves one node in one way."""

    keys: Floats  # (N,) seconds
    values: Floats  # (N, C), or (3 N, C)
    how: str


Tracks = dict[tuple[int, str], Track]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # damaged numbers are refused, without numpy's warnings
def read_glb(path: str | Path, start: int = 0, end: int | None = None, clip: str | None = None) -> list[RigMotion]:
    """Read all people of one file of `GLTF`.

    A person is a skin's skeleton, and the skins of clothes and hair on it; in a file without skins, every tree of nodes
    that moves. They rest as they were bound to their skins. Keyframes are read at their own rate, and those that are
    uneven, or fewer than ten a second, at 30 a second. Of animations that move the same nodes the first is read that is
    no pose.

    Args:
        path: the file.
        start, end: the frames that are kept, from 0, without `end`; None: to the last.
        clip: the animation that is read, by its name; None: see above.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no glTF, damaged, no skeletons, no such frames or animation.
    """
    path = Path(path)
    file = GltfFile(path)
    with in_one_line(path):
        people = _people(file)
        tracks, notes = _tracks(file, clip)
        at, fps, also = _clock([track for (node, _), track in tracks.items() if _moves(file, node, people)])
        kept = kept_frames(path, len(at), start, end)
        world, first = _World(file, tracks, at[kept]), _World(file, tracks, at[:1])
        rigs = [_person(file, world, joints, fps, (*notes, *also), len(people) > 1) for joints in people]
        same = [_rests_as(file, first, joints) for joints in people]
        return [replace(rig, posed=is_same and len(at) > 1) for rig, is_same in zip(rigs, same, strict=True)]


@contextmanager
def in_one_line(path: Path) -> Iterator[None]:
    """Errors of damaged files, with the file's name."""
    try:
        yield
    except (KeyError, IndexError, TypeError, AttributeError, np.linalg.LinAlgError) as error:
        raise ValueError(f"{path}: its parts do not go together ({error!r}): export it again") from error
    except ValueError as error:
        raise ValueError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from error


@dataclass(frozen=True)
class GlbRig:
    """A character: its file, its skeleton as it rests, and where its joints are in the file.

    Attributes:
        joints: nodes of the skeleton's joints.
        turn: (K, 3, 3) world rotations of these nodes in the skeleton's rest pose.
    """

    file: GltfFile
    rig: RigMotion
    joints: tuple[int, ...]
    turn: Floats


def read_rig(path: str | Path, given: Mapping[str, str] | None = None) -> GlbRig:
    """The one character of a glTF file, which need not move.

    given: our joint's name to its own, for names that no scheme knows.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: as `read_glb`, or several people.
    """
    file = GltfFile(Path(path))
    with in_one_line(file.path), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        groups, still = _people(file, needs_motion=False), _World(file, {}, np.zeros(1))
        rigs = [_person(file, still, joints, FPS, (), len(groups) > 1) for joints in groups]
        people = people_of(rigs, given)
        if len(people) > 1:
            said = ", ".join(rig.person for rig in people)
            raise ValueError(f"holds {said}: expected one character; export each to a file of its own")
        k = next(k for k, rig in enumerate(rigs) if rig.names == people[0].names)
        return GlbRig(file, rigs[k], tuple(groups[k]), _turn(_bound(file, groups[k])[:, :3, :3]))


# -- who is there ------------------------------------------------------------------------------


def _people(file: GltfFile, needs_motion: bool = True) -> list[list[int]]:
    """The joints of each person, each behind its parent, one root first."""
    groups: list[set[int]] = []
    for skin in file.document.get("skins", []):
        own = set(skin["joints"])
        same = [group for group in groups if _hang_together(file, own, group)]
        at = groups.index(same[0]) if same else len(groups)
        groups = [group for group in groups if group not in same]
        groups.insert(at, own.union(*same))
    if not groups:
        tops = [k for k in range(len(file.nodes)) if k not in file.parents]
        moved = {channel["target"].get("node") for each in _animations(file) for channel in each["channels"]}
        trees = [set(file.below(top)) for top in tops]
        groups = [tree for tree in trees if len(tree) >= FEWEST_BONES and (tree & moved or not needs_motion)]
    if not groups:
        raise ValueError("holds no skeleton: neither a skin with joints, nor a tree of nodes that moves")
    return [_in_order(file, group) for group in groups]


def _hang_together(file: GltfFile, one: set[int], other: set[int]) -> bool:
    """Whether joints of one skin are, or hang on, those of another."""
    below = [(one, other), (other, one)]
    return bool(one & other) or any(upper & set(file.above(k)) for lower, upper in below for k in lower)


def _in_order(file: GltfFile, joints: set[int]) -> list[int]:
    tops = [k for k in joints if not joints.intersection(file.above(k))]
    if len(tops) > 1:  # such as a rig's controls beside its hips: what they all hang on is the root
        shared = set(file.above(tops[0])).intersection(*(file.above(k) for k in tops))
        if not shared:
            raise ValueError(f"bones of one skin hang on nothing together: {', '.join(map(file.name, sorted(tops)))}")
        tops = [next(k for k in file.above(tops[0]) if k in shared)]
    return [k for k in file.below(tops[0]) if k in joints or k == tops[0]]


def _moves(file: GltfFile, node: int, people: Iterable[Sequence[int]]) -> bool:
    """Whether a node is a person's, or one on which a person hangs."""
    return any(node in joints or node in file.above(joints[0]) for joints in people)


# -- how they move -----------------------------------------------------------------------------


def _animations(file: GltfFile) -> list[dict[str, Any]]:
    return list(file.document.get("animations", []))


def _tracks(file: GltfFile, clip: str | None) -> tuple[Tracks, list[str]]:
    """What moves nodes, and notes on animations that are left out."""
    tracks: Tracks = {}
    taken: dict[tuple[int, str], str] = {}
    left: list[str] = []
    named = [(str(each.get("name") or f"animation {k}"), each) for k, each in enumerate(_animations(file))]
    chosen = [(name, each) for name, each in named if clip in (None, name)]
    if clip is not None and not chosen:
        raise ValueError(f"has no animation {clip!r}; it has {', '.join(name for name, _ in named) or 'none'}")
    # A pose comes last: many files have one before their motion, such as Mixamo's empty take.
    for name, animation in sorted(chosen, key=lambda each: _is_pose(file, each[1])):
        channels = [each for each in animation["channels"] if each["target"].get("path") in DEFAULTS]
        own = {(each["target"]["node"], each["target"]["path"]): each for each in channels if "node" in each["target"]}
        if both := own.keys() & taken:
            left.append(f"animation {name!r} is not read: it moves what {taken[min(both)]!r} moves; --clip chooses")
            continue
        taken |= dict.fromkeys(own, name)
        for (node, what), channel in own.items():
            tracks[node, what] = _track(file, animation["samplers"][channel["sampler"]], what)
    return tracks, left


def _is_pose(file: GltfFile, animation: dict[str, Any]) -> bool:
    """Whether nothing changes in an animation."""
    outputs = (file.numbers(sampler["output"]) for sampler in animation["samplers"])
    return all(bool((values[1:] == values[:-1]).all()) for values in outputs)


def _track(file: GltfFile, sampler: dict[str, Any], what: str) -> Track:
    keys, values = file.numbers(sampler["input"])[:, 0], file.numbers(sampler["output"])
    if not len(keys):
        raise ValueError(f"a {what} has no frames: export it again")
    if values.shape[1] != len(DEFAULTS[what]):
        raise ValueError(f"a {what} has {values.shape[1]} numbers, expected {len(DEFAULTS[what])}: export it again")
    return Track(keys, values, sampler.get("interpolation", "LINEAR"))


def _clock(tracks: Sequence[Track]) -> tuple[Floats, float, list[str]]:
    """The times of frames (T,), how many there are a second, and a note where that is not the file's own rate."""
    moving = [track for track in tracks if len(track.keys) > 1]
    if not moving:
        return np.zeros(1), FPS, ["nothing moves in it: a pose"]
    keys = max(moving, key=lambda track: len(track.keys)).keys
    if not (np.diff(keys) > 0).all():
        raise ValueError("its keys are not in order")
    step = float(np.median(np.diff(keys)))
    frames = np.diff(keys) / step
    first, last = (float(end([end(track.keys) for track in moving])) for end in (min, max))
    even = bool((np.abs(frames - frames.round()) < EVEN).all()) and step <= 1 / SPARSE
    fps = usual_rate(1 / step) if even else FPS
    if not (last - first) * fps < LONGEST:
        raise ValueError(f"it lasts {last - first:.3g} seconds, more than is read")
    count = math.floor((last - first) * fps + 0.5 if even else (last - first) * fps + 1e-3) + 1
    note = [] if even else [f"its keys are uneven or few: read at {FPS:g} frames a second"]
    return first + np.arange(count) / fps, fps, note


class _World:
    """Where nodes are in the world, frame by frame. at (T,) seconds"""

    def __init__(self, file: GltfFile, tracks: Tracks, at: Floats) -> None:
        self.file, self.tracks, self.at = file, tracks, at
        self.moved: dict[int, Floats] = {}

    def __call__(self, node: int) -> Floats:
        """(T, 4, 4), or (1, 4, 4) where nothing moves it"""
        for each in (*reversed(self.file.above(node)), node):
            if each not in self.moved:
                parent = self.file.parents.get(each)
                self.moved[each] = self._own(each) if parent is None else self.moved[parent] @ self._own(each)
        return self.moved[node]

    def _own(self, node: int) -> Floats:
        parts = []
        for what, usual in self.file.resting(node).items():
            track = self.tracks.get((node, what))
            turns = what == "rotation"
            parts.append(usual[None] if track is None else sampled(track.keys, track.values, track.how, self.at, turns))
        return matrices(*parts)


# -- a person ----------------------------------------------------------------------------------


def _person(
    file: GltfFile, world: _World, joints: Sequence[int], fps: float, notes: Sequence[str], several: bool
) -> RigMotion:
    """One person's skeleton, from its rest pose."""
    number = {node: k for k, node in enumerate(joints)}
    nearest = [next((number[up] for up in file.above(node) if up in number), -1) for node in joints]
    T = len(world.at)
    moved = np.stack([np.broadcast_to(world(node), (T, 4, 4)) for node in joints], axis=1)  # (T, K, 4, 4)
    bound = _bound(file, joints)
    turned = _turn(moved[..., :3, :3]) @ np.swapaxes(_turn(bound[:, :3, :3]), -1, -2)
    at, rest = moved[..., :3, 3], bound[:, :3, 3]
    local, place, offsets = turned.copy(), at.copy(), rest.copy()
    for k, parent in enumerate(nearest):
        if parent >= 0:
            back = np.swapaxes(turned[:, parent], -1, -2)
            local[:, k] = back @ turned[:, k]
            place[:, k] = (back @ (at[:, k] - at[:, parent])[..., None])[..., 0]
            offsets[k] = rest[k] - rest[parent]
    offsets *= _scale(place, offsets, nearest)
    person = _named(file, joints) if several else ""
    names = tuple(map(file.name, joints))
    told: dict[str, Any] = {"up": "y", "unit": "m", "person": person, "notes": tuple(notes)}
    return RigMotion(names, tuple(nearest), offsets, place, local, fps, file.path, **told)


def _rests_as(file: GltfFile, first: _World, joints: Sequence[int]) -> bool:
    """Whether nodes without a skin rest as they are in the first frame: they were written as they were just then."""
    skins = file.document.get("skins", [])
    if any("inverseBindMatrices" in skin and set(joints) & set(skin["joints"]) for skin in skins):
        return False
    return all(np.allclose(first(node)[0], file.at_rest(node), rtol=1e-4, atol=1e-4) for node in joints)


def _named(file: GltfFile, joints: Sequence[int]) -> str:
    """What a person is called: after the highest node that holds nobody else."""
    skins = [set(skin["joints"]) for skin in file.document.get("skins", [])]
    name = file.name(joints[0])
    for node in file.above(joints[0]):
        if any(not skin & set(joints) and skin & set(file.below(node)) for skin in skins):
            break
        name = file.name(node)
    return name


def _bound(file: GltfFile, joints: Sequence[int]) -> Floats:
    """Joints as they were bound to their skins, as nodes rest where no skin says it. -> (K, 4, 4)"""
    bound: dict[int, Floats] = {}
    skins = [skin for skin in file.document.get("skins", []) if "inverseBindMatrices" in skin]
    for skin in sorted(skins, key=lambda skin: -len(skin["joints"])):
        given = file.numbers(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(-1, -2)
        for node, back in zip(skin["joints"], given, strict=True):
            if node in joints and node not in bound:
                bound[node] = np.linalg.inv(back).astype(np.float64)
    like = next((node for node in joints if node in bound), None)
    to_skin = np.eye(4) if like is None else bound[like] @ np.linalg.inv(file.at_rest(like))
    whole = np.stack([bound[node] if node in bound else to_skin @ file.at_rest(node) for node in joints])
    # Skins may have other axes than the world, such as z up; whoever lies is told from who stands by the rest pose.
    back = _turn(to_skin[:3, :3]).T
    if np.abs(back - back.round()).max() < ALONG:
        whole[:, :3] = back.round() @ whole[:, :3]
    return whole


def _turn(matrix: Floats) -> Floats:
    """The rotation in a transform's (..., 3, 3): the nearest one, without its scale.

    A parent that is scaled along one axis skews what turns below it; joints are still where the file has them.
    """
    length = np.linalg.norm(matrix, axis=-2, keepdims=True)
    turn = np.asarray(matrix / np.maximum(length, 1e-12), np.float64)
    if not (np.linalg.det(turn) > 0.5).all():
        raise ValueError("a bone is mirrored, flat or skewed: apply scales in your program, then export it again")
    skewed = np.abs(np.swapaxes(turn, -1, -2) @ turn - np.eye(3)).max(axis=(-1, -2)) > SKEWED
    if skewed.any():
        U, _, Vh = np.linalg.svd(turn[skewed])
        turn[skewed] = U @ Vh
    return turn


def _scale(place: Floats, offsets: Floats, parents: Sequence[int]) -> float:
    """How many units of the world one of the rest pose is, which may be bound in another. place (T, K, 3)"""
    bones = np.array([k for k, parent in enumerate(parents) if parent >= 0], dtype=int)
    rest = np.linalg.norm(offsets[bones], axis=-1)
    now = np.linalg.norm(place[0, bones], axis=-1)
    long = rest > 1e-3 * max(float(np.abs(rest_of(offsets, parents)).max()), 1e-12)
    return float(np.median(now[long] / rest[long])) if long.any() else 1.0
