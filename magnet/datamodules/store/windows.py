"""Windows of a batch: random ones for training, fixed ones for evaluation, composed ones of either kind."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from lightning.pytorch.utilities import rank_zero_warn
from numpy.typing import NDArray

from magnet.checks import require_whole
from magnet.datamodules.clip import Ints
from magnet.datamodules.options import Augmentation
from magnet.datamodules.store.memory import MemoryStore, WindowIndex
from magnet.seeding import derive

Floats = NDArray[np.float64]


def uniforms(seed: int, epoch: int, first: int, count: int, columns: int) -> Floats:
    """Uniform numbers of samples `first` to `first + count` of an epoch, a row each. -> (count, columns) in [0, 1)

    A counter-based generator: row i is the same whichever rows it is drawn with.
    """
    blocks = -(-columns // 4)  # one count of Philox yields four numbers
    philox = np.random.Philox(key=np.array([seed % 2**64, epoch], dtype=np.uint64))
    philox.advance(first * blocks)
    return np.random.Generator(philox).random((count, 4 * blocks))[:, :columns]


class RandomWindows:
    """Training windows: sample i of epoch e depends only on (seed, e, i) and the clips.

    If the store divides its clips among processes, each process draws from its own clips only. Sample k of process r is
    then sample k * world + r of the epoch and depends on (seed, e, k, r, world).

    Args:
        store: the training clips.
        frames: window length.
        weights: share of each source; None: every valid window is equally likely.
        augment: what happens to the windows.
        seed: of all randomness.
        rank: of this process.
        world: number of processes.

    Raises:
        ValueError: no clip has a valid frame, a weight names no source, or all weights are zero.
    """

    COLUMNS = 12

    def __init__(
        self,
        store: MemoryStore,
        frames: int,
        weights: Mapping[str, float] | None,
        augment: Augmentation,
        seed: int,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        self.store, self.augment, self.seed = store, augment, seed
        self.count = np.maximum(store.length - frames + 1, 1)
        self.starts, self.first = self._listed(frames)
        share = self.count * self._weigh(weights)
        if not share.sum() > 0:
            raise ValueError(f"split train: no valid window of {frames} frames is left by weights={weights}")
        owners = store.owners(share / share.sum(), world) if world > 1 else None
        self.shared = owners is not None
        if owners is not None:
            self.seed = derive(seed, "share", rank, world)
            share = np.where(owners == rank, share, 0.0)
        self.cdf = np.cumsum(share) / share.sum()

    def _listed(self, frames: int) -> tuple[Ints, Ints]:
        """Starts of clips with invalid frames, and where each clip's begin among them; -1: any start will do."""
        first = np.full(len(self.count), -1, dtype=np.int64)
        starts: list[Ints] = [np.zeros(0, dtype=np.int64)]
        total = 0
        for clip in np.flatnonzero(~self.store.whole):
            starts.append(all_starts(self.store.good(int(clip)), frames))
            first[clip], self.count[clip] = total, len(starts[-1])
            total += len(starts[-1])
        return np.concatenate(starts), first

    def _weigh(self, weights: Mapping[str, float] | None) -> Floats:
        """Weight of one window of each clip."""
        if weights is None:
            return np.ones(len(self.count))
        source = self.store.sources
        unknown = sorted(set(weights) - set(source))
        if unknown:
            raise ValueError(f"weights: no training clip has the source {unknown}; there are {sorted(set(source))}")
        if min(weights.values(), default=0) < 0 or not any(weights.values()):
            raise ValueError(f"weights: got {dict(weights)}, expected no negative number and one over 0")
        if left := sorted(set(source) - set(weights)):
            rank_zero_warn(f"weights: nothing of {', '.join(left)} is trained on: say a weight, or 0", stacklevel=2)
        windows = {s: self.count[source == s].sum() for s in weights}
        return np.array([weights.get(s, 0.0) / max(windows.get(s, 1), 1) for s in source])

    def __call__(self, epoch: int, first: int, count: int) -> WindowIndex:
        """Samples `first` to `first + count` of an epoch; of this process's share, if there are shares."""
        slots = self.store.max_agents
        u = uniforms(self.seed, epoch, first, count, self.COLUMNS + slots)
        augment = self.augment
        a, start_a = self._window(u[:, 0], u[:, 1])
        b, start_b = self._window(u[:, 2], u[:, 3])
        people = self.store.people
        joining = np.where((u[:, 4] < augment.compose) & (a != b), np.minimum(people[b], slots - people[a]), 0)
        joining[people[a] + joining < 3] = 0
        members, groups = slot_assignment(people[a], joining, people[b], (u[:, 5] * people[b]).astype(np.int64), slots)

        total = people[a] + joining
        for scene in np.flatnonzero((u[:, 6] < augment.drop) & (total >= 2)):
            share = u[scene, 6] / augment.drop  # uniform again, among the scenes that lose somebody
            members[scene, dropped(int(total[scene]), augment.drop_at_most, share, u[scene, 7])] = -1
        if augment.shuffle:
            order = u[:, self.COLUMNS :].argsort(axis=1, kind="stable")
            members, groups = np.take_along_axis(members, order, 1), np.take_along_axis(groups, order, 1)

        clips = np.stack([a, np.where(joining > 0, b, -1)], axis=1)
        windows = WindowIndex(
            clips,
            np.stack([start_a, start_b], axis=1),
            members,
            groups,
            u[:, 11] < (0.5 if augment.mirror else 0.0),
            relative_poses(u[:, 8:11], augment.compose_apart),
        )
        return without_empty_groups(windows)

    def _window(self, u: Floats, v: Floats) -> tuple[Ints, Ints]:
        clip = np.minimum(np.searchsorted(self.cdf, u, side="right"), len(self.cdf) - 1)
        start = (v * self.count[clip]).astype(np.int64)
        listed = np.flatnonzero(self.first[clip] >= 0)
        start[listed] = self.starts[self.first[clip[listed]] + start[listed]]
        return clip, start


def slot_assignment(first: Ints, joining: Ints, second: Ints, turn: Ints, slots: int) -> tuple[Ints, Ints]:
    """Slots in order: all `first` people, then `joining` of the `second` ones, from person `turn` on. -> (B, P) x 2"""
    slot = np.arange(slots)
    later = slot - first[:, None]
    members = np.where(later < joining[:, None], (later + turn[:, None]) % second[:, None], -1)
    return np.where(later < 0, slot, members), (later >= 0).astype(np.int64)


def relative_poses(u: Floats, apart: tuple[float, float]) -> Floats:
    """Where second groups stand: yaw, direction, and a distance within `apart`. (B, 3) uniform -> (B, 3)"""
    low, high = apart
    return np.stack([u[:, 0] * 2 * np.pi, u[:, 1] * 2 * np.pi, low + u[:, 2] * (high - low)], axis=1)


def dropped(people: int, at_most: int, share: float, which: float) -> list[int]:
    """Which people are masked: 1 to `at_most`, each number equally likely, but never everybody.

    share, which: uniform numbers in [0, 1), for how many and for who.
    """
    limit = min(at_most, people - 1)
    count = min(1 + int(share * limit), limit)
    groups = list(itertools.combinations(range(people), count))
    return list(groups[int(which * len(groups))])


def without_empty_groups(windows: WindowIndex) -> WindowIndex:
    """Composed scenes of which all people of one group were dropped, as plain scenes of the other group; in place."""
    for group in (0, 1):
        gone = (windows.clips[:, 1] >= 0) & ~((windows.members >= 0) & (windows.groups == group)).any(axis=1)
        if group == 0:
            windows.clips[gone, 0], windows.starts[gone, 0] = windows.clips[gone, 1], windows.starts[gone, 1]
            windows.groups[gone] = 0
        windows.clips[gone, 1] = -1
    return windows


def all_starts(good: NDArray[np.bool_], frames: int) -> Ints:
    """First frames of every window of a clip to train on. good: (T,) bool

    Windows that hold an invalid frame are left out, unless the clip has no other: then the best ones stay.
    A clip shorter than the window has one, which starts at 0.
    """
    if len(good) <= frames:
        return np.zeros(1 if good.any() else 0, dtype=np.int64)
    total = np.concatenate([[0], np.cumsum(good)])
    count = total[frames:] - total[:-frames]
    best = count.max()
    return np.flatnonzero(count == best) if best else np.zeros(0, dtype=np.int64)


def spaced_starts(good: NDArray[np.bool_], frames: int, stride: int) -> Ints:
    """First frames of clean whole windows, `stride` apart; an invalid frame is stepped over. good: (T,) bool

    Raises:
        ValueError: the stride is less than a frame.
    """
    require_whole("stride", stride, 1)
    starts, start = [], 0
    while start + frames <= len(good):
        bad = np.flatnonzero(~good[start : start + frames])
        if len(bad):
            start += int(bad[-1]) + 1
        else:
            starts.append(start)
            start += stride
    return np.array(starts, dtype=np.int64)


def longest_stretch(store: MemoryStore) -> int:
    """Frames of the longest clean stretch of any clip."""
    most = 0
    for c in range(len(store.length)):
        good = store.good(c)
        ends = np.concatenate([[-1], np.flatnonzero(~good), [len(good)]])
        most = max(most, int(np.diff(ends).max()) - 1)
    return most


def fixed_windows(store: MemoryStore, frames: int, stride: int, pad: bool = False) -> WindowIndex:
    """Clean windows of so many frames of every clip in order, `stride` frames apart.

    pad: a clip shorter than the window gives one, padded; otherwise none
    """
    pairs = []
    for c in range(len(store.length)):
        good = store.good(c)
        starts = all_starts(good, frames) if pad and len(good) < frames else spaced_starts(good, frames, stride)
        pairs += [(c, int(start)) for start in starts]
    return recorded_windows(store, pairs)


def recorded_windows(store: MemoryStore, pairs: Sequence[tuple[int, int]]) -> WindowIndex:
    """Windows (clip, start) as recorded, everybody in the first slots."""
    array = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    people = store.people[array[:, 0]]
    none = np.zeros_like(people)
    members, groups = slot_assignment(people, none, none + 1, none, store.max_agents)
    nowhere = np.full_like(people, -1)
    return WindowIndex(
        clips=np.stack([array[:, 0], nowhere], axis=1),
        starts=np.stack([array[:, 1], none], axis=1),
        members=members,
        groups=groups,
        mirrored=np.zeros(len(array), dtype=bool),
        relative_pose=np.zeros((len(array), 3)),
    )


def pairs_of_each(clips: Ints, people: Ints, size: int) -> Ints:
    """How many others each window can make up `size` people with: windows of another clip, with enough people. (n,)"""
    lacking = size - people
    enough = (people >= np.arange(size + 1)[:, None]).sum(axis=1)  # windows of so many people or more
    found = enough[np.maximum(lacking, 0)] - np.where(people >= lacking, np.bincount(clips)[clips], 0)
    return np.where(lacking > 0, found, 0)


def composed_windows(
    store: MemoryStore, plain: WindowIndex, count: int, apart: tuple[float, float], seed: int
) -> WindowIndex:
    """Scenes of three and four people in turn, each made of two of the plain windows of different clips.

    Where the second clip has more people than the scene still needs, some of them are left out.

    Raises:
        ValueError: the clips or slots do not allow such scenes.
    """
    clips = plain.clips[:, 0]
    people = store.people[clips]
    pairs = {size: pairs_of_each(clips, people, size) for size in (3, 4) if size <= store.max_agents}
    sizes = [size for size, each in pairs.items() if each.any()]
    if not sizes:
        raise ValueError(
            f"test.composed={count}: needs max_agents of 3 or more (got {store.max_agents}) and test windows of two"
            f" clips that make up three people (got {len(plain)} windows of {len(set(clips))} clips)"
        )
    u = uniforms(seed, 0, 0, count, 5)
    rows = []
    for k in range(count):
        size = sizes[k % len(sizes)]
        ends = np.cumsum(pairs[size])
        pick = int(u[k, 0] * ends[-1])
        i = int(np.searchsorted(ends, pick, side="right"))
        others = np.flatnonzero((clips != clips[i]) & (people >= size - people[i]))
        rows.append((i, others[pick - ends[i] + len(others)]))
    first, second = np.array(rows, dtype=np.int64).T
    wanted = np.array([sizes[k % len(sizes)] for k in range(count)], dtype=np.int64)
    turn = (u[:, 1] * people[second]).astype(np.int64)
    members, groups = slot_assignment(people[first], wanted - people[first], people[second], turn, store.max_agents)
    return WindowIndex(
        clips=np.stack([plain.clips[first, 0], plain.clips[second, 0]], axis=1),
        starts=np.stack([plain.starts[first, 0], plain.starts[second, 0]], axis=1),
        members=members,
        groups=groups,
        mirrored=np.zeros(count, dtype=bool),
        relative_pose=relative_poses(u[:, 2:5], apart),
    )
