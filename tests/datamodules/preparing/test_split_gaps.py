"""An empty split, and one without scenes of a number of people, are said."""

from __future__ import annotations

import pytest

from magnet.datamodules.preparing.check import LIMITED, YOURS, split_gaps

FULL = {"train": {2: 9, 3: 4}, "val": {2: 1, 3: 1}, "test": {2: 2, 3: 1}}


@pytest.mark.parametrize(
    ("clips", "said"),
    [
        (FULL, []),
        ({**FULL, "train": {1: 50, 2: 9, 3: 4}}, []),
        ({}, []),
        ({**FULL, "val": {}}, ["split val is EMPTY: training goes without validation"]),
        ({**FULL, "val": {2: 0}}, ["split val is EMPTY: training goes without validation"]),
        (
            {"train": {2: 3}},
            [
                "split val is EMPTY: training goes without validation",
                "split test is EMPTY: magnet test has no scenes",
            ],
        ),
        (
            {"test": {2: 1, 4: 1}},
            [
                "split train is EMPTY: nothing can be trained on it",
                "split val is EMPTY: training goes without validation",
            ],
        ),
        ({**FULL, "test": {3: 1}}, ["no clip of 2 people in test (train 9, val 1)"]),
        ({**FULL, "train": {2: 9, 4: 1}}, ["no clip of 3 people in train (val 1, test 1)",
                                           "no clip of 4 people in val and test (train 1)"]),
    ],
)  # fmt: skip
def test_every_gap_is_said_and_what_to_do(clips, said) -> None:
    assert split_gaps(clips) == ([*said, YOURS] if said else [])
    assert split_gaps(clips, limited=True) == ([*said, YOURS + LIMITED] if said else [])
