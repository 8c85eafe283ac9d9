"""Joints of training windows, for baselines and measures that read positions alone."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from magnet.baselines.retrieval import assignments
from magnet.body import Body
from magnet.body.mirror import mirror_scene
from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.scene import Scene


@dataclass(frozen=True)
class Windows:
    """M windows of recorded motion, each a context and what followed it; a third of the memory of scenes."""

    joints: Tensor  # (M, T, P, 22, 3) metres, in the world of the recording
    T_world_can: Tensor  # (M, P, 4, 4) canonical frames at the last context frame; at the first where there is none
    present: Tensor  # (M, P) bool
    context: int
    body: Body
    fps: float
    recordings: tuple[str, ...]  # which recording each window is of
    mirrored: Tensor  # (M,) bool, left and right exchanged
    _ordered: dict[tuple[int, int], Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    @staticmethod
    def of(scenes: Iterable[Scene], body: Body, context: int, mirror: bool = False) -> Windows:
        """Windows of batches of scenes, alike in frames, slots, fps and body.

        Windows with a masked frame are left out. A scene without a name is a recording of its own; see `recording`.

        Args:
            scenes: batches.
            body: the body model of them all.
            context: frames of each window that come before its future.
            mirror: each scene's mirror image as well.

        Raises:
            ValueError: no scenes.
        """
        parts: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        recordings: list[str] = []
        scene = None
        for scene in scenes:
            kept = torch.ones_like(scene.present[:, 0]) if scene.valid is None else scene.valid.all(dim=1)
            part = scene if bool(kept.all()) else scene.select(kept)
            names = part.names or tuple(f"{len(recordings)}:{k}" for k in range(part.scenes))
            for turned in (False, True) if mirror else (False,):
                seen = mirror_scene(part) if turned else part
                T_world_can = canonical_frame(seen.T_world_root[:, [max(context - 1, 0)]])[:, 0]
                parts.append(
                    (body.joints(seen), T_world_can, part.present, torch.full_like(part.present[:, 0], turned))
                )
                recordings += map(recording, names)
        if scene is None:
            raise ValueError("no training windows: got no scenes, expected at least one batch")
        joints, T_world_can, present, mirrored = (torch.cat(each) for each in zip(*parts, strict=True))
        return Windows(joints, T_world_can, present, context, body, scene.fps, tuple(recordings), mirrored)

    @property
    def horizon(self) -> int:
        """Frames after the context."""
        return self.joints.shape[1] - self.context

    def of_people(self, people: int, mirrored: bool = True) -> Tensor:
        """Windows with so many people; none where there are none. (m,) int

        Args:
            people: how many.
            mirrored: mirror images too.
        """
        found = self.present.sum(dim=1) == people
        return (found if mirrored else found & ~self.mirrored).nonzero()[:, 0]

    def joints_of(self, chosen: Tensor, people: int, frames: Tensor) -> Tensor:
        """Joints of those present in windows of so many people. (m,), (F,) int -> (m, n, F, 22, 3)"""
        slots = self.present[chosen].nonzero()[:, 1].view(-1, people)
        return self.joints[chosen[:, None, None], frames, slots[..., None]]

    def frames_of(self, chosen: Tensor, people: int) -> Tensor:
        """Their canonical frames at the last context frame. (m,) int -> (m, n, 4, 4)"""
        slots = self.present[chosen].nonzero()[:, 1].view(-1, people)
        return self.T_world_can[chosen[:, None], slots]

    def shared(self, chosen: Tensor, people: int, frames: Tensor, order: Tensor | None = None) -> Tensor:
        """Joints in the world that scenes share: origin between the people at the last context frame, facing as the
        first of them. (m,), (F,) int, order (n,) int of the people -> (m, n, F, 22, 3)
        """
        joints, T_world_can = self.joints_of(chosen, people, frames), self.frames_of(chosen, people)
        if order is not None:
            joints, T_world_can = joints[:, order], T_world_can[:, order]
        yaw, ground = to_planar(T_world_can)
        return moved_points(inverse(from_planar(yaw[:, 0], ground.mean(dim=1))), joints)

    def futures_in_every_order(self, people: int, every: int) -> Tensor:
        """Futures of windows with so many people in the world that scenes share, once for each order of the people.

        Every so many frames. Worked out once and kept. -> (M * orders, F, n, 22, 3)
        """
        if (people, every) not in self._ordered:
            chosen = self.of_people(people)
            frames = torch.arange(self.context, self.joints.shape[1], every, device=chosen.device)
            placed = [self.shared(chosen, people, frames, order) for order in assignments(people, chosen.device)]
            self._ordered[people, every] = torch.cat(placed).transpose(1, 2)
        return self._ordered[people, every]


MADE_OF_IT = re.compile(r" (x[\d.]+|reshaped \d+|mirror|opposite|pass|beside|behind)$")
"""Ends of the names of clips that data sets make of a recording."""


def recording(label: str) -> str:
    """Name of the recording that a window was cut from, by the window's label, such as "60_05+61_05 x1.1 [120:302]".

    A recording has one name at all its speeds (`CMU.speeds`), on all bodies (`Reshaped`) and in all its `SoloPairs`.
    """
    name, before = label.partition(" [")[0], ""
    while name != before:
        name, before = MADE_OF_IT.sub("", name), name
    return name


def moved_points(T_a_b: Tensor, points: Tensor) -> Tensor:
    """Points of frame b as frame a sees them. (m, 4, 4), (m, ..., 3) -> (m, ..., 3)"""
    flat = points.flatten(1, -2).to(T_a_b)
    return (flat @ T_a_b[:, :3, :3].transpose(-1, -2) + T_a_b[:, None, :3, 3]).view_as(points)
