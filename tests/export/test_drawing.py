"""Words in pictures: what is drawn is in the font."""

from __future__ import annotations

import sys

import pytest

from magnet.export.drawing import HELD, SPELLED, drawable, font


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
