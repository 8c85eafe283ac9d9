"""A split of prepared stores as training sees it: frames stay on disk, a batch touches only its own rows."""

from __future__ import annotations

import copy
from contextlib import nullcontext
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body.indices import indices
from magnet.body.mirror import OTHER_SIDE
from magnet.datamodules.clip import Ints
from magnet.datamodules.store.memory import MemoryStore, WindowIndex
from magnet.datamodules.store.reader import StoreSplit
from magnet.datamodules.store.rows import ROW, SCALE, matrices
from magnet.motion.frames import rigid
from magnet.motion.scene import BODY_JOINTS, Scene
from magnet.waiting import constant

UNEVEN = 0.1
"""Largest difference between the shares of processes; if it is larger, all processes draw from all clips."""
QUAT = 4 * ROW["rotations"].subdtype[0].itemsize  # type: ignore[index]
"""Bytes of a rotation."""
PELVIS: int = ROW.fields["pelvis"][1]  # type: ignore[index]
"""Byte of a row at which the pelvis's place begins."""


@dataclass(frozen=True)
class RawBatch:
    """A batch as it lies on disk: read ahead on the CPU, decoded on the device."""

    windows: WindowIndex
    raw: Tensor  # (B, T, P, bytes of a row) uint8
    betas: Tensor  # (B, P, 10)
    present: Tensor  # (B, P) bool
    valid: Tensor  # (B, T) bool
    names: tuple[str, ...]


class MappedStore(MemoryStore):
    """Like `MemoryStore`, with rows read through memory maps and decoded on `device`.

    Only the index is kept in memory, some hundred bytes per clip. Rows go to the device in the format on disk.

    Args:
        part: the clips; at least one.
        max_agents: slots P of every batch.
        spread: let each process read its own part of every source, where there are enough clips.

    Raises:
        ValueError: a clip has more people than slots.
        StoreError: a file is missing or damaged.
    """

    on_disk: ClassVar[bool] = True

    def __init__(self, part: StoreSplit, max_agents: int, spread: bool = True) -> None:
        self.part, self.bad = part, part.bad
        self._index(
            names=part.name,
            sources=part.source,
            length=part.frames,
            people=part.people,
            whole=[c not in self.bad for c in range(len(part.name))],
            max_agents=max_agents,
            fps=part.fps,
            body=part.body,
        )
        self.shards: dict[int, NDArray[np.void]] = {}
        self.device = torch.device("cpu")
        self.spread = spread
        # Missing files are found now, not in the middle of an epoch. A map takes addresses alone until it is read.
        for number in range(len(part.files)):
            part.shard(number)

    def to(self, device: torch.device | str) -> MappedStore:
        """The same clips, decoded on another device."""
        other = copy.copy(self)
        other.device = torch.device(device)
        return other

    def good(self, clip: int) -> NDArray[np.bool_]:
        """Which frames of a clip are valid; stores hold no others. (T,) bool"""
        return self.bad[clip] if clip in self.bad else np.ones(int(self.length[clip]), dtype=bool)

    def owners(self, mass: NDArray[np.float64], world: int) -> Ints | None:
        """Which process reads each clip: every source is cut into parts of equal probability, one per process. (C,)

        A process only reads the shards of its parts; it shares the first and the last with its neighbours. None if
        there are too few clips for shares that differ by less than a tenth: then all processes draw from all clips.
        """
        owner = np.zeros(len(mass), dtype=np.int64)
        for source in set(self.sources):
            mine = np.where(self.sources == source, mass, 0.0)
            middle = (np.cumsum(mine) - mine / 2) / (mine.sum() or 1.0)
            owner = np.where(self.sources == source, np.minimum((middle * world).astype(np.int64), world - 1), owner)
        load = np.bincount(owner, mass, world)
        return owner if self.spread and np.ptp(load) <= UNEVEN / world else None

    # -- from disk -----------------------------------------------------------------------------

    def fetch(self, windows: WindowIndex, frames: int, clearance: float = 0.0) -> RawBatch | Scene:
        """The CPU's part of a batch: rows in pinned memory for a GPU; the whole batch without a GPU."""
        rows = self.read(windows, frames)
        return self.decoded(rows, clearance) if self.device.type == "cpu" else rows

    def finish(self, fetched: RawBatch | Scene, clearance: float = 0.0) -> Scene:
        """The batch on `device` from the result of `fetch`."""
        return fetched if isinstance(fetched, Scene) else self.decoded(fetched, clearance)

    def gather(self, windows: WindowIndex, frames: int, clearance: float = 0.0) -> Scene:
        """The windows, each `frames` long. -> Scene (B, frames, max_agents) on the store's device

        Beyond a clip's end its last frame is repeated with `valid` False.
        """
        return self.finish(self.fetch(windows, frames, clearance), clearance)

    def read(self, windows: WindowIndex, frames: int) -> RawBatch:
        """Copy windows out of the memory maps, without computing anything."""
        B, P = windows.members.shape
        present = windows.members >= 0
        clip = np.take_along_axis(np.maximum(windows.clips, 0), windows.groups, 1)  # (B, P)
        start = np.take_along_axis(windows.starts, windows.groups, 1)
        member = self.part.slot_order[clip, np.maximum(windows.members, 0)]
        row = self.part.first[clip] + member * self.length[clip] + start
        count = np.minimum(frames, self.length[clip] - start)
        shard = np.searchsorted(self.part.ends, row, side="right")
        row -= np.concatenate([[0], self.part.ends])[shard]

        raw = self._room(B, frames, P)
        out = raw.numpy().view(BYTES)[..., 0]
        if not present.all():
            out.transpose(0, 2, 1)[~present] = NOBODY
        scenes, slots = present.nonzero()
        copies = zip(scenes.tolist(), slots.tolist(), *(x[present].tolist() for x in (shard, row, count)), strict=True)
        for b, p, number, first, n in copies:
            out[b, :n, p] = self.shard(number)[first : first + n]
            if n < frames:
                out[b, n:, p] = out[b, n - 1, p]

        person = self.part.last_person[clip] - self.part.people[clip] + member
        betas = np.where(present[..., None], self.part.betas[person], np.float32(0))
        return RawBatch(
            windows=windows,
            raw=raw,
            betas=torch.from_numpy(betas),
            present=torch.from_numpy(present),
            valid=torch.from_numpy(self._valid(windows, frames)),
            names=self.labels(windows, frames),
        )

    def shard(self, number: int) -> NDArray[np.void]:
        if number not in self.shards:
            self.shards[number] = np.asarray(self.part.shard(number)).view(BYTES)
        return self.shards[number]

    def _room(self, *shape: int) -> Tensor:
        on_gpu = self.device.type == "cuda"
        # A thread that pins memory would else open a context on the first GPU, whichever this process computes on.
        with torch.cuda.device(self.device) if on_gpu else nullcontext():
            return torch.empty(*shape, ROW.itemsize, dtype=torch.uint8, pin_memory=on_gpu)

    def _valid(self, windows: WindowIndex, frames: int) -> NDArray[np.bool_]:
        """Frames at which all clips of a scene are there and valid. (B, T)"""
        clips = np.maximum(windows.clips, 0)
        frame = windows.starts[..., None] + np.arange(frames)  # (B, 2, T)
        good = (frame < self.length[clips][..., None]) | (windows.clips < 0)[..., None]
        if self.bad:
            for b, k in np.argwhere(~self.whole[clips] & (windows.clips >= 0)).tolist():
                mask = self.bad[int(clips[b, k])]
                good[b, k] &= mask[np.minimum(frame[b, k], len(mask) - 1)]
        return np.logical_and(good[:, 0], good[:, 1])

    # -- on the device -------------------------------------------------------------------------

    def decoded(self, rows: RawBatch, clearance: float) -> Scene:
        """Decode rows to a batch on `device`."""
        raw = rows.raw.to(self.device, non_blocking=True)
        present, groups = rows.present.to(self.device, non_blocking=True), self.sent(rows.windows.groups)
        root = raw[..., :QUAT].contiguous().view(torch.int16)
        pelvis = raw[..., PELVIS:].contiguous().view(torch.float32)
        body = raw[..., QUAT:PELVIS].contiguous().view(torch.int16).unflatten(-1, (BODY_JOINTS - 1, 4))
        T_world_root = self._compose(rigid(matrices(root), pelvis), present, groups, rows.windows, clearance)
        chosen = np.flatnonzero(rows.windows.mirrored)
        if len(chosen):
            index = self.sent(chosen)
            body.index_copy_(0, index, mirrored(body[index]))
            flip = constant((-1.0, 1.0, 1.0, 1.0), T_world_root)
            T_world_root.index_copy_(0, index, T_world_root[index] * (flip[:, None] * flip))
        return Scene(
            body_rot=matrices(body),
            T_world_root=T_world_root,
            betas=rows.betas.to(self.device, non_blocking=True),
            present=present,
            fps=self.fps,
            body=self.body,
            valid=rows.valid.to(self.device, non_blocking=True),
            names=rows.names,
        )


BYTES = np.dtype((np.void, ROW.itemsize))
NOBODY = np.zeros((), dtype=ROW)
NOBODY["rotations"][:, 3] = SCALE
NOBODY = NOBODY.view(BYTES)


def mirrored(body: Tensor) -> Tensor:
    """Joints' quaternions seen in the plane x = 0, left and right exchanged: `mirror_scene` on eight bytes a joint.

    (..., 21, 4) int16, xyzw -> same
    """
    whole = body.view(torch.int64)[..., 0]
    swapped = whole[..., indices(OTHER_SIDE, whole.device)].unsqueeze(-1).view(torch.int16)
    swapped[..., 1:3].neg_()
    return swapped
