"""Which cases of a law are slow."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def some_slow(cases: Iterable[Any], *slow: Any) -> list[Any]:
    """All cases for `parametrize`, of which some run with the slow tests alone."""
    every = list(cases)
    assert set(slow) <= set(every), f"no cases {sorted(set(slow) - set(every))}"
    return [pytest.param(case, marks=pytest.mark.slow) if case in slow else case for case in every]
