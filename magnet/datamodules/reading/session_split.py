"""Whole sessions divided into train, val and test so that each split has its share of every number of people."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import product
from typing import cast

from magnet.datamodules.clip import Split
from magnet.datamodules.reading.arrays import hashed_split

Amounts = Mapping[int, int]
"""Frames by number of people."""
ANY = 0
"""Stands for all scenes of two or more people: no split should be empty."""
Change = Mapping[str, Split]
"""Sessions and where they go."""
HELD: tuple[Split, ...] = ("test", "val")
ORDER: tuple[Split, ...] = (*HELD, "train")
WHOLE, TENTH = 10_000, 1_000
"""Shares are whole numbers of ten-thousandths, so that every machine finds the same split."""
LACKS = 10 * WHOLE**2
"""Cost of a split that lacks a number of people, more than shares can cost."""


def split_sessions(sessions: Mapping[str, Amounts], fixed: Mapping[str, Split] | None = None) -> dict[str, Split]:
    """The split of each session.

    A hash of its name draws a tenth of the sessions for test and a tenth for val. Then single sessions move, or two
    change places, always the one that helps most, until none helps: each of test and val should hold a tenth of the
    frames of every number of people and of all, and no split may lack a number of people that three sessions have
    (train and test one that two have, train one that only one has). Above all, none may be empty.

    Args:
        sessions: frames of scenes by number of people, of each session.
        fixed: sessions whose split is settled already; they count, but do not move.
    """
    fixed = {name: split for name, split in (fixed or {}).items() if name in sessions}
    names = sorted(sessions, key=lambda name: (hashlib.sha256(name.encode(errors="replace")).digest(), name))
    free = [name for name in names if name not in fixed]
    splits: dict[str, Split] = {name: fixed.get(name) or hashed_split(name) for name in names}
    quotas = _Quotas(sessions, splits)
    while True:
        moves = ({name: split} for name in free for split in ORDER if split != splits[name])
        gain, change = quotas.best(moves)
        if gain <= 0:
            gain, change = quotas.best(_swaps(free, splits))
        if gain <= 0:
            return splits
        quotas.change(change)


def _swaps(free: list[str], splits: Mapping[str, Split]) -> Iterable[Change]:
    held = [name for name in free if splits[name] != "train"]
    others = [name for name in free if splits[name] != "test"]
    return ({a: splits[b], b: splits[a]} for a, b in product(held, others) if splits[a] != splits[b])


class _Quotas:
    """How far splits are from what each number of people should have of them, kept up to date as sessions move."""

    def __init__(self, sessions: Mapping[str, Amounts], splits: dict[str, Split]) -> None:
        self.sessions = {name: {n: count for n, count in of.items() if count > 0} for name, of in sessions.items()}
        fewest = min(2, max((n for of in self.sessions.values() for n in of), default=0))
        for of in self.sessions.values():
            if together := sum(count for n, count in of.items() if n >= fewest):
                of[ANY] = together
        self.splits = splits
        having = Counter(size for amounts in self.sessions.values() for size in amounts)
        order: tuple[Split, ...] = ("train", "test", "val")
        self.wanted = {size: order[:count] for size, count in having.items()}
        self.frames: dict[int, dict[Split, int]] = {size: dict.fromkeys(ORDER, 0) for size in having}
        for name, amounts in self.sessions.items():
            for size, count in amounts.items():
                self.frames[size][splits[name]] += count

    def best(self, changes: Iterable[Change]) -> tuple[int, Change]:
        """The first of the changes that lower the cost most, and by how much."""
        gain, found = 0, cast(Change, {})
        for change in changes:
            if (now := self._gain(change)) > gain:
                gain, found = now, change
        return gain, found

    def change(self, change: Change) -> None:
        """Sessions to their new splits."""
        self._move(change)
        self.splits.update(change)

    def _gain(self, change: Change) -> int:
        sizes = {size for name in change for size in self.sessions[name]}
        before = sum(map(self._cost, sizes))
        self._move(change)
        after = sum(map(self._cost, sizes))
        self._move(change, -1)
        return before - after

    def _move(self, change: Change, sign: int = 1) -> None:
        for name, split in change.items():
            for size, count in self.sessions[name].items():
                self.frames[size][self.splits[name]] -= sign * count
                self.frames[size][split] += sign * count

    def _cost(self, size: int) -> int:
        frames = self.frames[size]
        total = sum(frames.values())
        lacking = sum(not frames[split] for split in self.wanted[size]) * (100 if size == ANY else 1)
        return LACKS * lacking + sum((WHOLE * frames[split] // total - TENTH) ** 2 for split in HELD)
