"""Which cases of a law are slow."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def some_slow(cases: Iterable[Any], *slow: Any) -> list[Any]:
    """All cases for `parametrize`, tuples those of several arguments, of which some run with the slow tests alone."""
    every = list(cases)
    assert set(slow) <= set(every), f"no cases {sorted(set(slow) - set(every))}"
    return [slow_case(case) if case in slow else case for case in every]


def some_quick(cases: Iterable[Any], *quick: Any) -> list[Any]:
    """All cases for `parametrize`, of which all but some run with the slow tests alone."""
    every = list(cases)
    assert all(case in every for case in quick), f"no cases {[case for case in quick if case not in every]}"
    return [case if case in quick else slow_case(case) for case in every]


def few(cases: Iterable[Any], quick: int = 2) -> list[Any]:
    """All cases for `parametrize`, of which so many, spread evenly, run with the quick tests; the others are slow."""
    every = list(cases)
    chosen = {number * len(every) // quick for number in range(quick)}
    return [case if number in chosen else slow_case(case) for number, case in enumerate(every)]


def slow_case(case: Any) -> Any:
    """A case that runs with the slow tests alone."""
    if not isinstance(case, type(pytest.param())):
        case = pytest.param(*(case if isinstance(case, tuple) else (case,)))
    return pytest.param(*case.values, id=case.id, marks=[*case.marks, pytest.mark.slow])
