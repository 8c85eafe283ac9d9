"""Loaders that yield whole batches as `Scene`; random access is one gather, so there are no worker processes.

They are plain iterables rather than torch DataLoaders: gathering from tensors in memory is far faster than
passing batches between processes, Lightning leaves the shards that they cut themselves alone
(`use_distributed_sampler` has no effect on them), and their state is one number. What reads from disk reads ahead
in threads: copying out of maps holds no lock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import Any

from magnet.datamodules.store.memory import WindowIndex
from magnet.motion.scene import Scene

Gather = Callable[[WindowIndex], Scene]
Cursor = tuple[int, int]
"""Epoch, and batch in it."""


class Prefetcher:
    """Computes batches in threads before they are requested; those that are never requested are dropped.

    Args:
        make: a cursor's batch; depends on the cursor alone, and may be called by several threads at once.
        after: the cursor that follows.
        depth: batches in progress while the last one is used, each in a thread of its own.
    """

    def __init__(self, make: Callable[[Cursor], Any], after: Callable[[Cursor], Cursor], depth: int) -> None:
        self.make, self.after, self.depth = make, after, depth
        self.begun: deque[tuple[Cursor, Future[Any]]] = deque()
        self.threads: ThreadPoolExecutor | None = None

    def get(self, cursor: Cursor) -> Any:
        """The batch of a cursor. An error while it was made is raised here."""
        if self.begun and self.begun[0][0] != cursor:  # a state was loaded
            self._forget()
        self._begin(cursor, 1)
        _, future = self.begun.popleft()
        self._begin(self.after(cursor), self.depth)
        try:
            return future.result()
        except BaseException:
            self.begun.clear()
            raise

    def close(self) -> None:
        """End the threads after their current batches; the next batch that is asked for starts new ones."""
        self._forget()
        if self.threads is not None:
            self.threads.shutdown()
            self.threads = None

    def _forget(self) -> None:
        for _, future in self.begun:
            future.cancel()
        self.begun.clear()

    def _begin(self, cursor: Cursor, count: int) -> None:
        """Start reading batches, from `cursor` on, until `count` are in progress."""
        self.threads = self.threads or ThreadPoolExecutor(self.depth, thread_name_prefix="read-ahead")
        while len(self.begun) < count:
            cursor = self.after(self.begun[-1][0]) if self.begun else cursor
            self.begun.append((cursor, self.threads.submit(self.make, cursor)))


class TrainLoader:
    """An endless stream of epochs: each pass yields the rest of the current epoch, the next pass the next epoch.

    Global batch g of an epoch starts at sample g * world * batch_size; each rank takes its own part of it, so that the
    samples do not depend on the number of processes. If every process draws from its own clips, each numbers its own
    samples.

    Args:
        draw: the windows of some samples: (epoch, first sample, count) -> WindowIndex.
        fetch: reads what windows need; threads may run it ahead, so its result must depend on the windows alone.
        finish: turns the result of `fetch` into the batch.
        batch_size: scenes a batch and process.
        epoch_size: samples an epoch, over all processes; rounded down to whole batches, at least one.
        rank: of this process.
        world: number of processes.
        shared: `draw` numbers the samples of this process alone.
        ahead: batches fetched ahead; 0: none. They do not count as seen in the state.
        overfit: so many batches, or such a share of an epoch's, are yielded again and again, as the Trainer's
            `overfit_batches` asks; 0: every batch is new.
    """

    def __init__(
        self,
        draw: Callable[[int, int, int], WindowIndex],
        fetch: Callable[[WindowIndex], Any],
        finish: Callable[[Any], Scene],
        batch_size: int,
        epoch_size: int,
        rank: int = 0,
        world: int = 1,
        shared: bool = False,
        ahead: int = 0,
        overfit: float = 0,
    ) -> None:
        self.draw, self.fetch, self.finish, self.shared = draw, fetch, finish, shared
        self.ahead = Prefetcher(self._fetched, self._after, ahead) if ahead else None
        self.batch_size, self.rank, self.world = batch_size, rank, world
        self.batches = max(1, epoch_size // (batch_size * world))
        self.again = max(1, int(overfit * self.batches if isinstance(overfit, float) else overfit)) if overfit else 0
        self.epoch, self.batch = 0, 0

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[Scene]:
        # Lightning makes the iterator before it restores anything: read the cursor only when asked for a batch.
        while True:
            cursor = (self.epoch, self.batch)
            batch = self.finish(self.ahead.get(cursor) if self.ahead else self._fetched(cursor))
            self.epoch, self.batch = self._after(cursor)
            yield batch
            if self._after(cursor)[1] == 0:
                return

    def _fetched(self, cursor: Cursor) -> Any:
        epoch, batch = cursor
        if self.again:
            epoch, batch = 0, (epoch * self.batches + batch) % self.again
        block = batch if self.shared else batch * self.world + self.rank
        return self.fetch(self.draw(epoch, block * self.batch_size, self.batch_size))

    def _after(self, cursor: Cursor) -> Cursor:
        epoch, batch = cursor
        return (epoch, batch + 1) if batch + 1 < self.batches else (epoch + 1, 0)

    def close(self) -> None:
        """End the threads that read ahead."""
        if self.ahead:
            self.ahead.close()

    def state_dict(self) -> dict[str, int]:
        """Epoch and number of the next sample."""
        return {"epoch": self.epoch, "sample": self.batch * self.batch_size * self.world}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Continue there; with another batch size or number of processes, at the batch that holds the sample."""
        self.epoch, self.batch = state["epoch"], state["sample"] // (self.batch_size * self.world)
        if self.batch >= self.batches:
            self.epoch, self.batch = self.epoch + 1, 0


class FixedLoader:
    """The same windows in the same order at every pass; process r of n takes every n-th, none twice.

    All processes get equally many batches, at least one each: otherwise a model that communicates in every step (DDP
    does if it has buffers) would wait forever.

    Args:
        windows: all windows.
        gather: makes the batch of some windows.
        batch_size: scenes a batch and process at most; one more where shards of odd sizes need it.
        rank: of this process.
        world: number of processes.

    Raises:
        ValueError: fewer windows than processes.
    """

    def __init__(self, windows: WindowIndex, gather: Gather, batch_size: int, rank: int = 0, world: int = 1) -> None:
        if len(windows) < world:
            raise ValueError(f"{len(windows)} windows for {world} processes; use at most {len(windows)} devices")
        self.mine, self.gather = windows[slice(rank, None, world)], gather
        smallest, largest = len(windows) // world, -(-len(windows) // world)
        self.batches = min(smallest, -(-largest // batch_size))

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[Scene]:
        ends = [len(self.mine) * k // self.batches for k in range(self.batches + 1)]
        for first, end in pairwise(ends):
            yield self.gather(self.mine[first:end])
