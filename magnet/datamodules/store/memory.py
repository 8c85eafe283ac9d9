"""All clips of a split in memory: flat rows of all frames, from which batches of windows are gathered."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body.mirror import mirror_scene
from magnet.datamodules.clip import Clip, Ints
from magnet.motion.frames import from_planar
from magnet.motion.planar import rotate_ground
from magnet.motion.scene import BODY_JOINTS, Scene

COMPOSED, BESIDE = "composed: ", " + "
"""What the label of a scene of two clips begins with, and what stands between their labels."""


@dataclass(frozen=True)
class WindowIndex:
    """What a batch of B windows shows: up to two clips each and who stands in which of the P slots."""

    clips: Ints  # (B, 2) index of the clip; the second is -1 unless the scene is composed
    starts: Ints  # (B, 2) first frame
    members: Ints  # (B, P) which person of the clip a slot shows, -1: nobody
    groups: Ints  # (B, P) which of the two clips the person comes from
    mirrored: NDArray[np.bool_]  # (B,)
    relative_pose: NDArray[np.float64]  # (B, 3) of the second group: yaw, direction in radians, distance in metres

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, part: slice | Ints) -> WindowIndex:
        return WindowIndex(*(getattr(self, f)[part] for f in self.__dataclass_fields__))

    @staticmethod
    def concatenate(draws: Sequence[WindowIndex]) -> WindowIndex:
        return WindowIndex(*(np.concatenate([getattr(d, f) for d in draws]) for f in WindowIndex.__dataclass_fields__))


class MemoryStore:
    """All clips of a split as flat tensors on one device; rows are frames of one person.

    Row 0 is an absent person, so that a batch is one `index_select` a tensor. A subclass that keeps frames elsewhere
    overrides `gather`, `good`, `to` and `__init__`, and calls `_index`.

    Args:
        clips: at least one, all of one fps and body.
        max_agents: slots P of every batch.

    Raises:
        ValueError: a clip has more people than slots, or another fps or body than the first.
    """

    on_disk: ClassVar[bool] = False  # `fetch` reads files, and is worth doing ahead

    def __init__(self, clips: Sequence[Clip], max_agents: int) -> None:
        self.clips = list(clips)
        first = self.clips[0]
        for clip in self.clips:
            for field in ("fps", "body"):
                got, want = getattr(clip.scene, field), getattr(first.scene, field)
                if got != want:
                    raise ValueError(f"clip {clip.name}: {field} is {got}, but clip {first.name} has {want}")
        goods = [clip.good() for clip in self.clips]
        self._index(
            names=[clip.name for clip in self.clips],
            sources=[clip.source for clip in self.clips],
            length=[clip.frames for clip in self.clips],
            people=[clip.agents for clip in self.clips],
            whole=[bool(good.all()) for good in goods],
            max_agents=max_agents,
            fps=first.scene.fps,
            body=first.scene.body,
        )
        self.tensors = {"valid": torch.from_numpy(np.concatenate(goods)), **self._first_rows(), **self._flatten()}
        self.device = self.tensors["body_rot"].device

    def _index(
        self,
        names: Sequence[str],
        sources: Sequence[str],
        length: Sequence[int] | Ints,
        people: Sequence[int] | Ints,
        whole: Sequence[bool] | NDArray[np.bool_],
        max_agents: int,
        fps: float,
        body: str,
    ) -> None:
        """Keep all facts of each clip but its frames, and check the number of people."""
        self.names, self.sources = told_apart(names), np.array(sources, dtype=object)
        self.length, self.people = np.array(length, dtype=np.int64), np.array(people, dtype=np.int64)
        self.whole = np.array(whole, dtype=bool)  # every frame is valid
        self.max_agents, self.fps, self.body = max_agents, fps, body
        most = int(self.people.argmax())
        if self.people[most] > max_agents:
            raise ValueError(
                f"clip {self.names[most]} has {self.people[most]} people, but max_agents is {max_agents}; "
                f"say --data.max_agents {self.people[most]}, in Python max_agents={self.people[most]}"
            )

    def _first_rows(self) -> dict[str, Tensor]:
        """Where each clip's people begin: person after person, one row a frame, from row 1 on."""
        rows = self.length * self.people
        slot = np.arange(self.max_agents)
        there = slot < self.people[:, None]
        first_row = 1 + (np.cumsum(rows) - rows)[:, None] + slot * self.length[:, None]
        person = 1 + (np.cumsum(self.people) - self.people)[:, None] + slot
        return {
            "first_row": torch.from_numpy(np.where(there, first_row, 0)),
            "person": torch.from_numpy(np.where(there, person, 0)),
            "length": torch.from_numpy(self.length),
            "first_frame": torch.from_numpy(np.cumsum(self.length) - self.length),
        }

    def _flatten(self) -> dict[str, Tensor]:
        eye = torch.eye(4)
        rot = [eye[:3, :3].expand(1, BODY_JOINTS - 1, 3, 3)]
        root, betas = [eye[None]], [torch.zeros(1, 10)]
        for clip in self.clips:
            scene = clip.scene.to("cpu")
            for p in range(clip.agents):
                rot.append(scene.body_rot[0, :, p].float())
                root.append(scene.T_world_root[0, :, p].float())
                betas.append(scene.betas[:, p].float())
        return {"body_rot": torch.cat(rot), "T_world_root": torch.cat(root), "betas": torch.cat(betas)}

    def good(self, clip: int) -> NDArray[np.bool_]:
        """Which frames of a clip are valid. (T,) bool"""
        return self.clips[clip].good()

    def owners(self, mass: NDArray[np.float64], world: int) -> Ints | None:
        """Which of `world` processes draws from each clip, given how likely each is; None: all draw from all. (C,)"""
        return None

    def to(self, device: torch.device | str) -> MemoryStore:
        """The same clips on another device; itself when they are there already."""
        if torch.device(device) == self.device:
            return self
        other = copy.copy(self)
        other.device = torch.device(device)
        other.tensors = {name: tensor.to(device) for name, tensor in self.tensors.items()}
        return other

    def fetch(self, windows: WindowIndex, frames: int, clearance: float = 0.0) -> Any:
        """The part of a batch's work that a thread may do ahead; here all of it."""
        return self.gather(windows, frames, clearance)

    def finish(self, fetched: Any, clearance: float = 0.0) -> Scene:
        """The batch on the store's device from the result of `fetch`."""
        return fetched

    def gather(self, windows: WindowIndex, frames: int, clearance: float = 0.0) -> Scene:
        """The windows, each `frames` long. -> Scene (B, frames, max_agents) on the store's device

        Beyond a clip's end its last frame is repeated with `valid` False.
        """
        t = self.tensors

        clips, starts = self.sent(np.maximum(windows.clips, 0)), self.sent(windows.starts)
        members, groups = self.sent(windows.members), self.sent(windows.groups)
        there, member = members >= 0, members.clamp_min(0)

        wanted = starts[..., None] + torch.arange(frames, device=self.device)  # (B, 2, T)
        last = t["length"][clips][..., None] - 1
        frame = torch.minimum(wanted, last)
        good = (wanted <= last) & t["valid"][t["first_frame"][clips][..., None] + frame]
        valid = (good | self.sent(windows.clips)[..., None].lt(0)).all(dim=1)

        clip = clips.gather(1, groups)  # (B, P)
        frame_of_slot = frame.gather(1, groups[..., None].expand(-1, -1, frames))  # (B, P, T)
        rows = torch.where(there[..., None], t["first_row"][clip, member][..., None] + frame_of_slot, 0)
        rows = rows.transpose(1, 2)
        T_world_root = t["T_world_root"].index_select(0, rows.flatten()).unflatten(0, rows.shape)
        scene = Scene(
            body_rot=t["body_rot"].index_select(0, rows.flatten()).unflatten(0, rows.shape),
            T_world_root=self._compose(T_world_root, there, groups, windows, clearance),
            betas=t["betas"][torch.where(there, t["person"][clip, member], 0)],
            present=there,
            fps=self.fps,
            body=self.body,
            valid=valid,
            names=self.labels(windows, frames),
        )
        return self._mirror(scene, windows)

    def sent(self, array: NDArray[Any], dtype: torch.dtype | None = None) -> Tensor:
        """An array on the store's device, for which nobody waits: a GPU may still be busy with the step before."""
        return torch.from_numpy(array).to(dtype=dtype).to(self.device, non_blocking=True)

    def _compose(
        self, T_world_root: Tensor, there: Tensor, groups: Tensor, windows: WindowIndex, clearance: float
    ) -> Tensor:
        chosen = self.sent(np.flatnonzero(windows.clips[:, 1] >= 0))
        if not len(chosen):
            return T_world_root
        relative_pose = self.sent(windows.relative_pose, T_world_root.dtype)[chosen]
        moved = place_apart(T_world_root[chosen], there[chosen], groups[chosen] == 1, relative_pose, clearance)
        return T_world_root.index_copy_(0, chosen, moved)

    def _mirror(self, scene: Scene, windows: WindowIndex) -> Scene:
        # Only the chosen half is computed, in place: on a CPU, moving the numbers is what a batch costs.
        chosen = np.flatnonzero(windows.mirrored)
        if len(chosen):
            index = self.sent(chosen)
            half = mirror_scene(scene.replace(**{n: v[index] for n, v in scene.tensors().items()}, names=()))
            scene.body_rot.index_copy_(0, index, half.body_rot)
            scene.T_world_root.index_copy_(0, index, half.T_world_root)
        return scene

    def labels(self, windows: WindowIndex, frames: int) -> tuple[str, ...]:
        """A label a scene: clip and frames, such as "60_05+61_05 [120:302]"; composed ones say so."""

        def label(clip: int, start: int) -> str:
            return f"{self.names[clip]} [{start}:{min(start + frames, self.length[clip])}]"

        return tuple(
            label(a, s) if b < 0 else f"{COMPOSED}{label(a, s)}{BESIDE}{label(b, z)}"
            for (a, b), (s, z) in zip(windows.clips.tolist(), windows.starts.tolist(), strict=True)
        )

    @cached_property
    def _source_of(self) -> dict[str, str]:
        return dict(zip(self.names, self.sources.tolist(), strict=True))

    def sources_of(self, labels: Sequence[str]) -> tuple[str, ...]:
        """The source of each scene's clip, by its label; both, joined by +, where it is composed; "": unknown."""

        def of(label: str) -> str:
            parts = label.removeprefix(COMPOSED).split(BESIDE) if label.startswith(COMPOSED) else [label]
            return "+".join(self._source_of.get(part.rsplit(" [", 1)[0], "") for part in parts)

        return tuple(map(of, labels))


def place_apart(
    T_world_root: Tensor, present: Tensor, second: Tensor, relative_pose: Tensor, clearance: float
) -> Tensor:
    """Turn each scene's second group about its own centre and put it beside the first.

    A group's centre is the mean of its pelvises over people and frames. Where pelvises of the two groups
    would come closer than `clearance` at any frame, the groups move further apart in the same direction.
    Heights do not change.

    Args:
        T_world_root: (B, T, P, 4, 4) pelvis poses; each group in its own recording's world.
        present: (B, P) bool.
        second: (B, P) bool, True for people of the second group.
        relative_pose: (B, 3) radians that the second group turns; direction in radians, 0 along +z, of its centre as
            seen from the first group's; least metres between the centres.
        clearance: metres between pelvises of different groups, at every frame.

    Returns:
        (B, T, P, 4, 4) in the first group's world.
    """
    yaw, direction, distance = relative_pose.unbind(-1)
    ground = T_world_root[..., 0:3:2, 3]
    ours, theirs = present & ~second, present & second

    def centre(group: Tensor) -> Tensor:
        people = group.sum(dim=1).clamp_min(1) * ground.shape[1]
        return (ground * group[:, None, :, None]).sum(dim=(1, 2)) / people[:, None]

    near, far = centre(ours), centre(theirs)
    turned = rotate_ground(yaw[:, None, None], ground - far[:, None, None])
    # At distance d along u, a pair is |d u - offset| apart: solve for the largest d where that is `clearance`.
    offset = (ground - near[:, None, None])[:, :, :, None] - turned[:, :, None]  # (B, T, P, P, 2)
    x, z = offset.unbind(-1)
    sin, cos = direction.sin()[:, None, None, None], direction.cos()[:, None, None, None]
    along, across = x * sin + z * cos, x * cos - z * sin
    reach = (clearance**2 - across**2).clamp_min(0.0).sqrt()
    matters = ours[:, None, :, None] & theirs[:, None, None, :] & (across.abs() < clearance)
    needed = torch.where(matters, along + reach, -torch.inf).flatten(1).amax(dim=1)
    distance = torch.maximum(distance, needed)

    heading = torch.stack([direction.sin(), direction.cos()], dim=-1)
    T_new_world = from_planar(yaw, near + distance[:, None] * heading - rotate_ground(yaw, far))
    return torch.where(theirs[:, None, :, None, None], T_new_world[:, None, None] @ T_world_root, T_world_root)


def told_apart(names: Sequence[str]) -> list[str]:
    """Names of clips, of which those that are there already get a number: data sets that are mixed may share some.

    >>> told_apart(["walk", "wave", "walk", "walk"])
    ['walk', 'wave', 'walk (2)', 'walk (3)']
    """
    if len(set(names)) == len(names):
        return list(names)
    taken, given = set(names), []
    seen: dict[str, int] = {}
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        title = name
        while seen[name] > 1 and (title := f"{name} ({seen[name]})") in taken:
            seen[name] += 1
        taken.add(title)
        given.append(title)
    return given
