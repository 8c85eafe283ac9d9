"""Pictures of tables: whatever the numbers and names are, all of it can be read."""

from __future__ import annotations

import math
from itertools import pairwise
from xml.etree import ElementTree

import pytest

from magnet.report.plot import LETTER, NAME, PANEL, curves, dots
from magnet.report.statistics import Estimate

SVG = "{http://www.w3.org/2000/svg}"
LONG = "trained and sampled so: pairs as clean as their token, the given scored too"


def numbers(value: float, error: float) -> dict[str, Estimate]:
    return {metric: Estimate(value, error, 7) for metric in "abcde"}


def grown(factor: float) -> dict[str, Estimate]:
    """FD that grows with what was generated."""
    return {f"fd@{frames}": Estimate(factor * frames, 0.1, 7) for frames in (150, 300)}


def drawn(rows: dict[str, dict[str, Estimate]], metrics: str = "abcde") -> ElementTree.Element:
    return ElementTree.fromstring(dots(rows, {metric: metric.upper() for metric in metrics}, ("NN",)))


def test_long_names_are_lines_that_fit_between_the_edge_and_the_panels() -> None:
    picture = drawn({"NN": numbers(1.0, 0.1), LONG: numbers(2.0, 0.1)})
    names = [text for text in picture.iter(f"{SVG}text") if text.get("text-anchor") == "end"]
    said = [str(text.text) for text in names]
    assert " ".join(said[: len(said) // 2]) == f"NN {LONG}"  # of the first line of panels; the second names them again
    for text in names:
        assert len(str(text.text)) <= NAME
        assert float(text.get("x", 0)) - LETTER * len(str(text.text)) >= 0
    lines = [float(text.get("y", 0)) for text in names]
    assert min(b - a for a, b in pairwise(lines)) >= 12, "they lie on one another"


def test_five_panels_are_two_lines_no_wider_than_a_page() -> None:
    picture = drawn({"NN": numbers(1.0, 0.1)})
    places = [panel.get("transform") for panel in picture.iter(f"{SVG}g")]
    assert len(set(places)) == 5 and len({str(place).partition(",")[2] for place in places}) == 2
    assert float(picture.get("width", 0)) < 900


@pytest.mark.parametrize(("error", "arrows"), [(0.05, 0), (10.0, 20)])
def test_intervals_stay_in_their_panel_and_arrows_say_which_go_on(error: float, arrows: int) -> None:
    """Two rows of five, in the second case from -22 to 25: each goes on at both sides of a panel."""
    picture = drawn({"NN": numbers(1.0, 0.05), LONG: numbers(2.0, error), "ground truth": numbers(1.5, error)})
    for panel in picture.iter(f"{SVG}g"):
        for line in panel.iter(f"{SVG}line"):
            assert 0 <= float(line.get("x1", -1)) <= float(line.get("x2", -1)) <= PANEL
        for dot in panel.iter(f"{SVG}circle"):
            assert 0 < float(dot.get("cx", -1)) < PANEL
    assert len(list(picture.iter(f"{SVG}path"))) == arrows
    said = " ".join(str(text.text) for text in picture.iter(f"{SVG}text"))
    assert ("an arrow" in said) == bool(arrows) and "dashed: as recorded" in said


@pytest.mark.parametrize("value", [0.0, 3e-4, 0.07, 250.0])
def test_marks_of_an_axis_are_round_numbers_that_do_not_touch(value: float) -> None:
    picture = drawn({"NN": numbers(value, value / 10)}, "a")
    marks = [text for text in picture.iter(f"{SVG}text") if text.get("text-anchor") == "middle"]
    assert 2 <= len(marks) <= 5 and marks[0].text == "0"
    for mark in marks[1:]:
        assert math.isclose(float(str(mark.text)), float(f"{float(str(mark.text)):.1g}")), "one digit"
    for one, other in pairwise(marks):
        apart = float(other.get("x", 0)) - float(one.get("x", 0))
        assert apart > LETTER * (len(str(one.text)) + len(str(other.text))) / 2


def test_a_curve_has_the_colour_that_stands_beside_its_name() -> None:
    rows = {
        name: {f"fd@{k}": Estimate(f * k, 0.1, 7) for k in (150, 300)} for name, f in (("R2R", 1.0), ("Ours", 0.01))
    }
    picture = ElementTree.fromstring(curves(rows))
    lines = [line.get("stroke") for line in picture.iter(f"{SVG}polyline")]
    assert len(set(lines)) == 2
    children = list(picture)
    for colour, name in zip(lines, rows, strict=True):
        at = next(i for i, child in enumerate(children) if child.text == name)
        assert children[at - 1].get("fill") == colour


@pytest.mark.parametrize(("factor", "marks"), [(0.5, ["0"]), (0.01, ["1", "10", "100", "1000"])])
def test_curves_that_differ_much_stand_over_powers_of_ten(factor: float, marks: list[str]) -> None:
    """1.5 beside 300: on a scale from 0 the lower one would lie on the axis."""
    rows = {"a": grown(1.0), "b": grown(factor)}
    picture = ElementTree.fromstring(curves(rows))
    said = [text.text for text in picture.iter(f"{SVG}text") if text.get("text-anchor") == "end"]
    assert said[: len(marks)] == marks
    heights = [float(circle.get("cy", 0)) for circle in picture.iter(f"{SVG}circle")]
    assert all(0 < height < float(picture.get("height", 0)) for height in heights)


def test_a_row_without_a_number_of_some_end_has_no_curve_and_other_numbers_are_not_drawn() -> None:
    rows = {"recorded": {"ip_ratio": Estimate(9e9, 0.1, 7)}, "a": {**grown(1.0), "mi": Estimate(9e9, 0.1, 7)}}
    picture = ElementTree.fromstring(curves(rows))
    assert len(list(picture.iter(f"{SVG}polyline"))) == 1
    assert len(list(picture.iter(f"{SVG}circle"))) == 2 + 1, "two ends, and one beside the name"
    assert "recorded" not in [text.text for text in picture.iter(f"{SVG}text")]
