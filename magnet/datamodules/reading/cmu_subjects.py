"""Who of CMU's database was recorded together, and at which frame rates: what its files do not say."""

from __future__ import annotations

COUPLES: tuple[tuple[int, int], ...] = ((60, 61), (18, 19), (20, 21), (22, 23), (33, 34))
"""Subjects recorded together, in one world: salsa (leader first); then two people who shake hands, pull, talk, quarrel
or walk side by side (18 to 23), and who throw a ball (33 and 34)."""
RATES = {33: 60.0, 34: 60.0, 60: 60.0, 61: 60.0, 143: 60.0}
"""Frames a second by subject where they are not 120. Subject 143 jumps in 143_35 and falls with 10.2 m/s2 at 60 fps; at
120 it would be four times that."""
USUAL_RATE = 120.0


def couple_of(subject: int | str) -> tuple[int, int] | None:
    """The couple that a subject is one of."""
    return next((couple for couple in COUPLES if int(subject) in couple), None)


def folder_of(subject: int | str) -> str:
    """The folder that a subject's files are downloaded to."""
    couple = couple_of(subject)
    return "singles" if couple is None else "salsa" if couple == COUPLES[0] else "couples"
