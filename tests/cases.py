"""Which cases of a law are slow."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def some_slow(cases: Iterable[Any], *slow: Any) -> list[Any]:
    """All cases for `parametrize`, tuples those of several arguments, of which some run with the slow tests alone."""
    every = list(cases)
    assert set(slow) <= set(every), f"no cases {sorted(set(slow) - set(every))}"

    def values(case: Any) -> tuple[Any, ...]:
        return case if isinstance(case, tuple) else (case,)

    return [pytest.param(*values(case), marks=pytest.mark.slow) if case in slow else case for case in every]
