"""What pictures are drawn with: letters that are in the font, colours that people can tell apart."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest

from magnet.export.drawing import AGENTS, HELD, SPELLED, drawable, font


@pytest.mark.parametrize(
    ("text", "drawn"),
    [
        ("Tänzerin Zoë — 2 \u00d7 Łódź, Straße", "Tanzerin Zoe - 2 x Lodz, Strasse"),
        ("Zoe\u0308 «1·2» …", "Zoe «1·2» …"),
        ("ǿ ﬁ 5\u00a0€ 東", "o fi 5 EUR ?"),
        ("two\nlines", "two\nlines"),
    ],
)
def test_titles_are_drawn_in_letters_that_the_font_has(text: str, drawn: str) -> None:
    assert drawable(text) == drawn


def test_no_letter_of_what_is_drawn_is_missing_from_the_font() -> None:
    face = font(20)
    missing = bytes(face.getmask("\uffff"))
    every = "".join(map(chr, range(0xA0, min(0x3000, sys.maxunicode)))) + "".join(SPELLED)
    for letter in {*drawable(every), *HELD} - {" ", "\n"}:
        if letter.isprintable():
            assert bytes(face.getmask(letter)) != missing, repr(letter)


SEEN = {
    "by most": np.eye(3),
    "without red cones": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "without green cones": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "without blue cones": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
}
"""What becomes of linear red, green and blue (Machado, Oliveira and Fernandes 2009, table 1, severity 1.0)."""
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(linear: np.ndarray) -> np.ndarray:
    """CIELAB of linear sRGB, 0 to 1. (3,) -> (3,)"""
    xyz = TO_XYZ @ linear.clip(0, 1) / TO_XYZ.sum(axis=1)
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("eyes", SEEN)
def test_colours_of_people_are_apart_also_for_the_colour_blind(eyes: str) -> None:
    """A difference of 2 is seen when colours touch, of 10 at a glance."""
    linear = [(np.array(colour) / 255) ** 2.2 for colour in AGENTS]
    seen = [lab(np.array(SEEN[eyes]) @ each) for each in linear]
    assert min(np.linalg.norm(one - other) for one, other in itertools.combinations(seen, 2)) > 12
