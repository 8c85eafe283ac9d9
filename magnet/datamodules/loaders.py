"""Loaders that yield whole batches as `Scene`; random access is one gather, so there are no worker processes.

They are plain iterables rather than torch DataLoaders: gathering from tensors in memory is far faster than
passing batches between processes, Lightning leaves the shards that they cut themselves alone
(`use_distributed_sampler` has no effect on them), and their state is one number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

from magnet.datamodules.windows import Draw
from magnet.motion.scene import Scene

Gather = Callable[[Draw], Scene]


class TrainLoader:
    """An endless stream of epochs: each pass yields the rest of the current epoch, the next pass the next epoch.

    Global batch g of an epoch covers its samples g * world * batch_size and on; each rank takes its own part
    of them, so that the samples seen do not depend on how many processes share the work. Where every process
    draws from clips of its own, its samples are numbered on their own.

    Args:
        draw: (epoch, first sample, count) to the windows drawn.
        gather: windows drawn to the batch.
        batch_size: scenes a batch and process.
        epoch_size: samples an epoch, over all processes; rounded down to whole batches, at least one.
        rank: of this process.
        world: number of processes.
        shared: `draw` numbers the samples of this process alone.
    """

    def __init__(
        self,
        draw: Callable[[int, int, int], Draw],
        gather: Gather,
        batch_size: int,
        epoch_size: int,
        rank: int = 0,
        world: int = 1,
        shared: bool = False,
    ) -> None:
        self.draw, self.gather, self.shared = draw, gather, shared
        self.batch_size, self.rank, self.world = batch_size, rank, world
        self.batches = max(1, epoch_size // (batch_size * world))
        self.epoch, self.batch = 0, 0

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[Scene]:
        # Lightning makes the iterator before it restores anything: read the place only when asked for a batch.
        while True:
            block = self.batch if self.shared else self.batch * self.world + self.rank
            first = block * self.batch_size
            batch = self.gather(self.draw(self.epoch, first, self.batch_size))
            self.batch += 1
            last = self.batch >= self.batches
            if last:
                self.epoch, self.batch = self.epoch + 1, 0
            yield batch
            if last:
                return

    def state_dict(self) -> dict[str, int]:
        """Where the stream stands: what comes next is this sample of this epoch."""
        return {"epoch": self.epoch, "sample": self.batch * self.batch_size * self.world}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on from there; with another number of processes or batch size, from the batch that it lies in."""
        self.epoch, self.batch = state["epoch"], state["sample"] // (self.batch_size * self.world)
        if self.batch >= self.batches:
            self.epoch, self.batch = self.epoch + 1, 0


class FixedLoader:
    """The same windows in the same order at every pass; process r of n takes every n-th, none twice.

    All processes get equally many batches, at least one each: a model that talks to its copies in every
    step (DDP does, where there are buffers) would otherwise wait for ever.

    Args:
        draw: all windows.
        gather: windows drawn to the batch.
        batch_size: scenes a batch and process at most; one more where shards of odd sizes need it.
        rank: of this process.
        world: number of processes.

    Raises:
        ValueError: fewer windows than processes.
    """

    def __init__(self, draw: Draw, gather: Gather, batch_size: int, rank: int = 0, world: int = 1) -> None:
        if len(draw) < world:
            raise ValueError(f"{len(draw)} windows for {world} processes; use at most {len(draw)} devices")
        self.mine, self.gather = draw[slice(rank, None, world)], gather
        smallest, largest = len(draw) // world, -(-len(draw) // world)
        self.batches = min(smallest, -(-largest // batch_size))

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[Scene]:
        ends = [len(self.mine) * k // self.batches for k in range(self.batches + 1)]
        for first, end in pairwise(ends):
            yield self.gather(self.mine[first:end])
