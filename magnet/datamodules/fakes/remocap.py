"""A tiny ReMoCap: ReMoCap/LindyHop/{train,test}/SEQUENCE/{0,1}/ with BVH, csv and offsets, millimetres, y up, 50 fps.

The 69 joints hang on ours: the skeleton's rotations and offsets lead exactly to its positions.
"""

from __future__ import annotations

import itertools
import pickle
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import roma
import torch

from magnet.body.joints import HEAD, NECK, PELVIS, SPINE1, SPINE2, SPINE3
from magnet.datamodules.fakes.body import write_body
from magnet.datamodules.fakes.motion import ARM, LEG, FakeMotion, people, rest_joints, world_rotations
from magnet.datamodules.reading.remocap_track import RATE
from magnet.export.bvh import bvh_text
from magnet.motion.scene import FPS

SEQUENCES = (3, 8, 6, 5, 7, 9, 10, 16)
TESTED = (6,)
MILLIMETRES = 1000.0
CHANNELS = "ZXY"
"""Rotations in the order of the BVH; the csv lists X, Y and Z all the same."""


@dataclass
class Joint:
    """One joint of theirs, the joint of ours that it turns with, and its children."""

    name: str
    turns: int
    rest: np.ndarray  # (3,) metres
    children: list[Joint] = field(default_factory=list)

    @property
    def end(self) -> bool:
        return not self.children and self.name.endswith("End")

    def declared(self) -> Iterator[Joint]:
        """Depth first, as the BVH declares them."""
        yield self
        for child in self.children:
            yield from child.declared()

    def listed(self) -> Iterator[Joint]:
        """Depth first, the last child first, as bvh-converter's csv lists them."""
        yield self
        for child in reversed(self.children):
            yield from child.listed()


def skeleton(rest: np.ndarray) -> Joint:
    """The 69 joints of a person whose rest joints are (22, 3)."""

    def chain(names: list[str], joints: list[int], places: list[np.ndarray]) -> tuple[Joint, Joint]:
        made = [Joint(*each) for each in zip(names, joints, places, strict=True)]
        for above, below in itertools.pairwise(made):
            above.children.append(below)
        return made[0], made[-1]

    def beyond(joint: int, dx: float, dy: float = 0.0, dz: float = 0.0) -> np.ndarray:
        return rest[joint] + np.array([dx, dy, dz])

    def leg(side: str, joints: list[int]) -> Joint:
        names = [f"{side}{part}" for part in ("UpLeg", "Leg", "Foot", "ToeBase", "ToeBaseEnd")]
        places = [*(rest[j] for j in joints), beyond(joints[-1], 0, 0, 0.06)]
        return chain(names, [*joints, joints[-1]], places)[0]

    def arm(side: str, joints: list[int], out: float) -> Joint:
        names = [f"{side}{part}" for part in ("Shoulder", "Arm", "ForeArm", "Hand")]
        top, hand = chain(names, joints, [rest[j] for j in joints])
        wrist = joints[-1]
        for spread, finger in enumerate(("Thumb", "Index", "Middle", "Ring", "Pinky")):
            names = [f"{side}Hand{finger}{part}" for part in ("1", "2", "3", "3End")]
            places = [beyond(wrist, out * (0.08 + 0.025 * k), 0, 0.04 - 0.02 * spread) for k in range(4)]
            hand.children.append(chain(names, [wrist] * 4, places)[0])
        hand.children.append(Joint(f"{side}HandEnd", wrist, beyond(wrist, out * 0.08)))
        return top

    between, above = (rest[SPINE1] + rest[SPINE2]) / 2, (rest[SPINE3] + rest[NECK]) / 2
    names, places = ["Spine", "Spine1", "Spine2", "Spine3"], [rest[SPINE1], between, rest[SPINE2], rest[SPINE3]]
    spine, chest = chain(names, [SPINE1, SPINE1, SPINE2, SPINE3], places)
    names, places = ["Spine4", "Neck", "Head", "HeadEnd"], [above, rest[NECK], rest[HEAD], beyond(HEAD, 0, 0.2)]
    head, _ = chain(names, [SPINE3, NECK, HEAD, HEAD], places)
    legs, arms = (list(zip(*pairs, strict=True)) for pairs in (LEG, ARM))
    chest.children += [head, arm("Left", list(arms[0]), 1.0), arm("Right", list(arms[1]), -1.0)]
    return Joint("Hips", PELVIS, rest[PELVIS], [spine, leg("Left", list(legs[0])), leg("Right", list(legs[1]))])


def length(frames: int) -> int:
    """Frames of a file at 50 fps."""
    return round(frames * RATE / FPS)


def motion(number: int, frames: int, seed: int = 0) -> FakeMotion:
    """What the take `number` shows, y up at 50 fps."""
    return people(length(frames), 2, RATE, seed + number)


def sequence(number: int) -> int:
    """Number of the take `number` in its data set."""
    return SEQUENCES[number] if number < len(SEQUENCES) else number + 10


def scenes(takes: int, frames: int, seed: int) -> dict[str, FakeMotion]:
    """What is written, by take."""
    return {f"lindyhop_{sequence(number):03}": motion(number, frames, seed) for number in range(takes)}


def write_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Any motions by take; of four, two train, one validates and one tests, by either split."""
    write_body(out / "body.npz")
    for name, shown in scenes.items():
        number = int(name.rpartition("_")[2])
        half = "test" if number in TESTED else "train"
        for person in range(2):
            folder = out / "ReMoCap/LindyHop" / half / str(number) / str(person)
            folder.mkdir(parents=True, exist_ok=True)
            _write_person(folder, shown, person)


def _write_person(folder: Path, shown: FakeMotion, person: int) -> None:
    rest = rest_joints(shown.betas, shown.kind)[person]
    root = skeleton(rest)
    declared, listed = list(root.declared()), list(root.listed())
    above = {child.name: joint for joint in declared for child in joint.children}
    world = world_rotations(shown.poses[:, person])
    offset = {j.name: j.rest - above[j.name].rest if j.name in above else np.zeros(3) for j in declared}
    place, local = {root.name: shown.positions[:, person, 0]}, {root.name: world[:, 0]}
    for joint in declared[1:]:
        parent = above[joint.name]
        place[joint.name] = place[parent.name] + world[:, parent.turns] @ offset[joint.name]
        local[joint.name] = np.swapaxes(world[:, parent.turns], -1, -2) @ world[:, joint.turns]
    degrees = roma.rotmat_to_euler(CHANNELS, torch.from_numpy(np.stack(list(local.values()))), degrees=True).numpy()
    turn = dict(zip(local, degrees[..., [CHANNELS.index(axis) for axis in "XYZ"]], strict=True))
    millimetres = {name: MILLIMETRES * at for name, at in place.items()}
    _write_csv(folder / "motion_worldpos.csv", [j.name for j in listed], millimetres)
    _write_csv(folder / "motion_rotations.csv", [j.name for j in listed], turn)
    offsets = {name: MILLIMETRES * at for name, at in offset.items()}
    (folder / "motion_offsets.pkl").write_bytes(pickle.dumps(offsets))
    columns = [np.round(millimetres[root.name], 6)]
    columns += [turn[j.name][:, ["XYZ".index(axis) for axis in CHANNELS]] for j in declared if not j.end]
    rows = [" ".join(f"{x:.6f}" for x in row) for row in np.concatenate(columns, axis=1).tolist()]
    joints = [j.name for j in declared if not j.end]
    parents = [joints.index(above[name].name) if name in above else -1 for name in joints]
    tips = {joints.index(above[j.name].name): offsets[j.name] for j in declared if j.end}
    text = bvh_text(joints, parents, np.stack([offsets[name] for name in joints]), tips, CHANNELS, rows, RATE)
    (folder / "motion.bvh").write_text(text, encoding="utf-8")


def _write_csv(path: Path, names: list[str], columns: dict[str, np.ndarray]) -> None:
    values = np.stack([columns[name] for name in names], axis=1).reshape(len(columns[names[0]]), -1)
    lines = [",".join(["Time", *(f"{name}.{axis}" for name in names for axis in "XYZ")])]
    lines += [",".join([f"{t / RATE:.6f}", *(f"{x:.6f}" for x in row)]) for t, row in enumerate(values.tolist())]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
