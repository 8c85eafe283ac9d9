from __future__ import annotations

import itertools

import pytest

from magnet.motion.runs import true_runs


@pytest.mark.parametrize("least", [1, 2, 3])
def test_runs_are_those_that_a_walk_over_the_mask_finds(least: int):
    for mask in itertools.product([False, True], repeat=7):
        expected, start = [], 0
        for value, group in itertools.groupby(mask):
            length = len(list(group))
            if value and length >= least:
                expected.append((start, start + length))
            start += length
        assert true_runs(mask, least) == expected


def test_an_empty_mask_has_no_runs():
    assert true_runs([]) == []
