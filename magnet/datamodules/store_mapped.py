"""A split of a prepared store as training sees it: frames stay on disk, a batch touches only its own rows."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.datamodules.store import ROW, SCALE, Folder, decode
from magnet.datamodules.windows import Ints, Split, Store

UNEVEN = 0.1
"""Shares of processes may differ by so much; else everybody draws from everything."""


class MappedStore(Store):
    """Like `Store`, with rows read through memory maps and decoded on `device`.

    Only the index is held in memory: some hundred bytes a clip. Rows travel to the device as they lie on disk.

    Args:
        folder: the prepared store.
        split: which one.
        max_agents: slots P of every batch.
        spread: let each process read a length of the store of its own, where there are enough clips.

    Raises:
        ValueError: the split is empty, or a clip has more people than slots.
        StoreError: a file is missing or damaged.
    """

    def __init__(self, folder: Folder, split: Split, max_agents: int, spread: bool = True) -> None:
        self.part = part = folder.split(split)
        if not part.name:
            has = [name for name, facts in folder.manifest["splits"].items() if facts["clips"]]
            raise ValueError(
                f"{folder.path}: split {split} is empty, the store has {', '.join(has)}; prepare it with a list of "
                f"splits of your own (--splits FILE), or leave out what needs it"
            )
        self._index(
            names=part.name,
            sources=[folder.manifest["name"]] * len(part.name),
            length=part.frames,
            people=part.people,
            whole=np.ones(len(part.name), dtype=bool),
            max_agents=max_agents,
            fps=folder.fps,
            body=folder.body,
        )
        self.tensors["betas"] = torch.cat([torch.zeros(1, 10), torch.from_numpy(np.array(part.betas))])
        self.device = torch.device("cpu")
        self.spread = spread
        for number in range(len(part.files)):  # missing files are found now, not in the middle of an epoch
            part.shard(number)

    def to(self, device: torch.device | str) -> MappedStore:
        """The same clips, decoded on another device."""
        other = copy.copy(self)
        other.device = torch.device(device)
        return other

    def good(self, clip: int) -> NDArray[np.bool_]:
        """All frames: clips were cut where tracking failed. (T,) bool"""
        return np.ones(int(self.length[clip]), dtype=bool)

    def owners(self, mass: NDArray[np.float64], world: int) -> Ints | None:
        """Which process reads each clip: the store cut into equally likely lengths, one a process. (C,)

        A process maps the shards of its length alone, of which it shares the first and the last with its neighbours.
        None where clips are too few for lengths within a tenth of each other: then all draw from all.
        """
        middle = np.cumsum(mass) - mass / 2
        owner = np.minimum((middle * world).astype(np.int64), world - 1)
        load = np.bincount(owner, mass, world)
        return owner if self.spread and np.ptp(load) <= UNEVEN / world else None

    def _frames(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        B, T, P = rows.shape
        wanted = rows.permute(0, 2, 1).reshape(B * P, T).numpy() - 1  # row 0 is nobody
        found = np.empty((B * P, T), dtype=ROW)
        begin = wanted[:, 0]
        nobody = begin < 0
        if nobody.any():
            found[nobody] = np.zeros((), dtype=ROW)
            found["rotations"][nobody, :, :, 3] = SCALE
        shard = np.where(nobody, -1, np.searchsorted(self.part.ends, begin, side="right"))
        for number in np.unique(shard[~nobody]):
            windows = np.flatnonzero(shard == number)
            before = int(self.part.ends[number - 1]) if number else 0
            found[windows] = self.part.shard(int(number))[wanted[windows] - before]
        raw = torch.from_numpy(found.view(np.uint8).reshape(B, P, T, ROW.itemsize)).to(self.device, non_blocking=True)
        raw = raw.transpose(1, 2).contiguous()
        split = ROW.fields["pelvis"][1]  # type: ignore[index]
        rotations = raw[..., :split].contiguous().view(torch.int16).unflatten(-1, (-1, 4))
        return decode(rotations, raw[..., split:].contiguous().view(torch.float32))
