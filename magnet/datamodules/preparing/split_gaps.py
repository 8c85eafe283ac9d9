"""Warnings of splits that are empty, or that lack a number of people which another split has."""

from __future__ import annotations

from collections.abc import Mapping

from magnet.datamodules.clip import SPLITS, Split

WITHOUT: dict[Split, str] = {
    "train": "nothing can be trained on it",
    "val": "training goes without validation",
    "test": "magnet test has no scenes",
}
YOURS = "a split of your own is given to prepare with --splits FILE, lines NAME SPLIT; --limit may be too low"


def split_gaps(clips: Mapping[Split, Mapping[int, int]]) -> list[str]:
    """A sentence for every gap, then what to do; none where every split has clips of every number of people.

    Somebody alone is no gap where others are together: data sets hold such clips to learn bodies from.

    Args:
        clips: number of clips by number of people, of each split that has any.
    """
    counts = {split: {n: count for n, count in clips.get(split, {}).items() if count} for split in SPLITS}
    if not any(counts.values()):
        return []
    said = [f"split {split} is EMPTY: {WITHOUT[split]}" for split in SPLITS if not counts[split]]
    sizes = sorted({n for of in counts.values() for n in of})
    for people in sizes if sizes == [1] else [n for n in sizes if n > 1]:
        lacking = [split for split in SPLITS if counts[split] and people not in counts[split]]
        if lacking:
            has = ", ".join(f"{split} {of[people]}" for split, of in counts.items() if people in of)
            said.append(f"no clip of {people} people in {' and '.join(lacking)} ({has})")
    return [*said, YOURS] if said else []
