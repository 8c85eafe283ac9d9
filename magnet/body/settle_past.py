"""What a correction goes on from: the frames before those that are corrected."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Past(NamedTuple):
    """What is known of the frames before, which stay. With nothing known corrections grow from 0."""

    offset: Tensor | None = None  # (B, 2, P, DOFS) corrections of the last two, which are continued
    holding: Tensor | None = None  # (B, Q, 2, 2) bool, hands that held in the last one
    plain: Tensor | None = None  # (B, 1, P, 22, 3) joints in the last one, uncorrected
    shown: Tensor | None = None  # (B, 1, P, 22, 3) the same, corrected; with `plain`: standing feet stay where they are


def past_of(past: Past | None, some: slice | Tensor) -> Past | None:
    """The past of some scenes. some (S,) int, (B,) bool, or a slice"""
    return None if past is None else Past(*(None if each is None else each[some] for each in past))
