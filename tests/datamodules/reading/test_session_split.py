"""Whole sessions to splits: nobody's number of people is left out, and shares are what they should be."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Mapping

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magnet.datamodules.clip import Split
from magnet.datamodules.reading.arrays import hashed_split
from magnet.datamodules.reading.session_split import split_sessions

SPLITS = ("train", "val", "test")


def shares(sessions: Mapping[str, Mapping[int, int]], splits: Mapping[str, Split]) -> dict[tuple[int, str], float]:
    """Share of a number of people's frames that a split has."""
    total: Counter[int] = Counter()
    part: Counter[tuple[int, str]] = Counter()
    for name, amounts in sessions.items():
        for size, frames in amounts.items():
            total[size] += frames
            part[size, splits[name]] += frames
    return {(size, split): part[size, split] / total[size] for size in total for split in SPLITS}


def made(seed: int, sessions: int, having: Mapping[int, int]) -> dict[str, dict[int, int]]:
    """Sessions of which so many have scenes of so many people, of unequal lengths."""
    rng = random.Random(seed)
    names = [f"2025{1 + k % 12:02}{1 + k // 12:02}--{rng.randrange(800, 1800):04}" for k in range(sessions)]
    found: dict[str, dict[int, int]] = {name: {} for name in names}
    for size, count in having.items():
        for name in rng.sample(names, count):
            found[name][size] = rng.randrange(900, 60_000)
    return found


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.integers(0, 10**6), st.integers(12, 60), st.data())
def test_each_number_of_people_is_in_every_split_where_enough_sessions_have_it(
    seed: int, sessions: int, data: st.DataObject
) -> None:
    having = {size: data.draw(st.integers(5, sessions)) for size in (2, 3, 4)}
    lists = made(seed, sessions, having)
    splits = split_sessions(lists)
    assert list(splits) and set(splits) == set(lists)
    found = shares(lists, splits)
    assert all(share > 0 for share in found.values())
    assert all(found[size, "train"] >= found[size, split] for size in having for split in ("val", "test"))


def test_of_many_sessions_every_number_of_people_has_a_tenth_in_val_and_in_test() -> None:
    found = shares(lists := made(1, 150, {2: 90, 3: 60, 4: 150}), split_sessions(lists))
    for (size, split), share in found.items():
        assert share == pytest.approx(0.8 if split == "train" else 0.1, abs=0.01), (size, split)


@pytest.mark.parametrize("sessions", range(3, 9))
def test_three_sessions_are_enough_for_no_split_to_be_empty(sessions: int) -> None:
    for seed in range(20):
        lists = made(seed, sessions, {})
        for k, name in enumerate(lists):
            lists[name][2 + (k + seed) % 3] = 1000
        assert set(split_sessions(lists).values()) == set(SPLITS)


def test_two_sessions_train_and_test_and_one_trains() -> None:
    assert sorted(split_sessions({"a": {2: 10}, "b": {2: 9}}).values()) == ["test", "train"]
    assert split_sessions({"a": {2: 10}}) == {"a": "train"}
    assert split_sessions({}) == {}


def test_nothing_but_the_sessions_themselves_decides() -> None:
    lists = made(3, 22, {2: 6, 3: 5, 4: 22})
    again = split_sessions(dict(reversed(lists.items())))
    assert again == split_sessions(lists)


def test_settled_sessions_stay_and_are_counted() -> None:
    lists = made(4, 30, {2: 30, 4: 20})
    names = sorted(lists)
    fixed: dict[str, Split] = {names[0]: "test", names[1]: "val", names[2]: "train", "elsewhere": "test"}
    splits = split_sessions(lists, fixed)
    assert "elsewhere" not in splits and all(splits[name] == fixed[name] for name in names[:3])
    held: dict[str, Split] = dict.fromkeys(names[:12], "test")
    assert set(split_sessions(lists, held).values()) == set(SPLITS)
    assert not [name for name in names[12:] if split_sessions(lists, held)[name] == "test"]  # test has enough


def test_where_a_hash_does_as_well_nothing_moves() -> None:
    """Sessions of equal length in the tenths that the hash drew: it is kept."""
    pools: dict[str, list[str]] = {split: [] for split in SPLITS}
    for k in range(400):
        pools[hashed_split(f"s{k}")].append(f"s{k}")
    names = pools["train"][:80] + pools["val"][:10] + pools["test"][:10]
    splits = split_sessions({name: {2: 100} for name in names})
    assert splits == {name: hashed_split(name) for name in names}
