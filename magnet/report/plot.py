"""Pictures of a table: each column a panel, each row a dot with its interval; curves of a long generation."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from html import escape
from textwrap import wrap

from magnet.report.statistics import Estimate

PANEL, GAP, TOP, BELOW, LINE = 150, 24, 34, 30, 14
"""Pixels of a panel's width, between panels, above and below one, and of a line of text."""
ACROSS = 4
"""Panels side by side: a page shows so many without making the text smaller."""
NAME, LETTER = 38, 7
"""Letters of a line of a row's name, and pixels of one."""
SHOWN = 1.6
"""How far a panel reaches for the ends of intervals, in times of the largest value; what ends beyond is an arrow."""
WIDTH, HEIGHT, LEFT = 640, 300, 60
BLUE, GREY = "#2563eb", "#8a8f98"
COLOURS = (BLUE, "#d97706", "#059669", "#7c3aed")
STYLE = (
    "text{font:12px sans-serif;fill:#333} .frame{fill:#fafafa;stroke:#ccc} .grid{stroke:#e3e3e3} "
    ".real{stroke:#059669;stroke-dasharray:4 3} .reach{stroke-width:2} polyline{fill:none;stroke-width:2}"
)


def dots(rows: Mapping[str, Mapping[str, Estimate]], columns: Mapping[str, str], floors: Collection[str] = ()) -> str:
    """SVG of values with intervals.

    Args:
        rows: title -> metric -> estimate; `ground truth`, where it is one, is a dashed line, too.
        columns: metric -> title.
        floors: titles of rows that are grey.
    """
    names = {title: wrap(title, NAME) for title in rows}
    row = 8 + LINE * max(len(lines) for lines in names.values())
    left = 16 + LETTER * max(len(line) for lines in names.values() for line in lines)
    band = TOP + row * len(rows) + BELOW
    colours = [GREY if title in floors else BLUE for title in rows]
    parts, cut = [], False
    for number, (metric, head) in enumerate(columns.items()):
        line, place = divmod(number, ACROSS)
        if place == 0:
            parts += _names(names.values(), left - 10, line * band + TOP, row)
        there = {place: each[metric] for place, each in enumerate(rows.values()) if metric in each}
        panel, beyond = _panel(head, there, colours, row, rows.get("ground truth", {}).get(metric))
        parts.append(f'<g transform="translate({left + place * (PANEL + GAP)},{line * band})">{"".join(panel)}</g>')
        cut |= beyond
    height = band * -(-len(columns) // ACROSS) + 18
    told = ["lines: 95 % intervals"]
    told += ["an arrow: it ends beyond the panel"] if cut else []
    told += ["dashed: as recorded"] if "ground truth" in rows else []
    parts.append(f'<text x="{left}" y="{height - 8}">{"; ".join(told)}</text>')
    return _svg(left + min(len(columns), ACROSS) * (PANEL + GAP) + 12, height, parts)


def is_end(metric: str) -> bool:
    """Whether it is a number of all that was generated up to a frame, which its name ends with."""
    return metric.startswith("fd@")


def curves(measured: Mapping[str, Mapping[str, Estimate]]) -> str:
    """SVG of `fd@FRAMES` over frames, a line a row; by powers of ten where they differ much. Rows without are left out.

    measured: title -> metric -> estimate
    """
    rows = {title: {name: each for name, each in row.items() if is_end(name)} for title, row in measured.items()}
    rows = {title: row for title, row in rows.items() if row}
    frames = sorted({int(name[3:]) for row in rows.values() for name in row})
    values = [each.value for row in rows.values() for each in row.values()]
    least, most = min(values, default=0.0), max(values, default=1.0)
    tens = least > 0 and most > 10 * least
    if tens:
        low, high = 10.0 ** math.floor(math.log10(least)), 10.0 ** math.ceil(math.log10(most))
        marks = [10.0**k for k in range(round(math.log10(low)), round(math.log10(high)) + 1)]
    else:
        low, high, marks = _axis([each for row in rows.values() for each in row.values()])
    bottom, wide, tall = HEIGHT - 50, WIDTH - LEFT - 30, HEIGHT - 50 - TOP

    def up(value: float) -> float:
        part = math.log10(max(value, low) / low) / math.log10(high / low) if tens else (value - low) / (high - low)
        return bottom - tall * min(max(part, 0.0), 1.0)

    parts = [f'<rect x="{LEFT}" y="{TOP}" width="{wide}" height="{tall}" class="frame"/>']
    for mark in marks:
        y = up(mark)
        parts.append(f'<line x1="{LEFT}" x2="{LEFT + wide}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{mark:g}</text>')
    at = {frame: LEFT + wide * frame / max(frames) for frame in frames}
    for frame in frames[:: max(1, -(-len(frames) // 12))]:
        parts.append(f'<text x="{at[frame]:.1f}" y="{bottom + 18}" text-anchor="middle">{frame}</text>')
    parts.append(f'<text x="{LEFT}" y="{HEIGHT - 10}">FD, over frames generated; lines: 95 % intervals</text>')
    head = LEFT
    for number, (title, row) in enumerate(rows.items()):
        colour = COLOURS[number % len(COLOURS)]
        aside = 4 * number - 2 * (len(rows) - 1)  # so that one interval does not hide another
        found = {at[frame] + aside: row[f"fd@{frame}"] for frame in frames if f"fd@{frame}" in row}
        points = " ".join(f"{x:.1f},{up(each.value):.1f}" for x, each in found.items())
        parts.append(f'<polyline points="{points}" stroke="{colour}"/>')
        for x, each in found.items():
            a, b = map(up, each.interval or (each.value, each.value))
            parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{a:.1f}" y2="{b:.1f}" stroke="{colour}"/>')
            parts.append(f'<circle cx="{x:.1f}" cy="{up(each.value):.1f}" r="4" fill="{colour}"/>')
        parts.append(f'<circle cx="{head + 6}" cy="{TOP - 16}" r="4" fill="{colour}"/>')
        parts.append(f'<text x="{head + 16}" y="{TOP - 12}">{escape(title)}</text>')
        head += 40 + LETTER * len(title)
    return _svg(WIDTH, HEIGHT, parts)


def _names(names: Iterable[Sequence[str]], right: float, top: float, row: float) -> list[str]:
    """Of rows, each in the middle of its height."""
    parts = []
    for number, lines in enumerate(names):
        y = top + row * (number + 0.5) - LINE * (len(lines) - 1) / 2 + 4
        parts += [
            f'<text x="{right}" y="{y + LINE * k:.1f}" text-anchor="end">{escape(line)}</text>'
            for k, line in enumerate(lines)
        ]
    return parts


def _panel(
    head: str, values: Mapping[int, Estimate], colours: Sequence[str], row: float, real: Estimate | None
) -> tuple[list[str], bool]:
    """Parts of a column's panel, from its own left top on, and whether an interval is cut. values: row -> estimate"""
    low, high, marks = _axis(list(values.values()))
    tall, cut = row * len(colours), False

    def across(value: float) -> float:
        return PANEL * (min(max(value, low), high) - low) / (high - low)

    parts = [f'<rect x="0" y="{TOP}" width="{PANEL}" height="{tall}" class="frame"/>']
    parts.append(f'<text x="0" y="{TOP - 10}">{escape(head)}</text>')
    for mark in marks:
        x = across(mark)
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{TOP + tall}" class="grid"/>')
        parts.append(f'<text x="{x:.1f}" y="{TOP + tall + 16}" text-anchor="middle">{mark:g}</text>')
    if real is not None:
        x = across(real.value)
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{TOP + tall}" class="real"/>')
    for place, each in values.items():
        y, colour = TOP + row * (place + 0.5), colours[place]
        ends = each.interval or (each.value, each.value)
        a, b = map(across, ends)
        parts.append(f'<line x1="{a:.1f}" x2="{b:.1f}" y1="{y}" y2="{y}" class="reach" stroke="{colour}"/>')
        beyond = [(0, 7) if ends[0] < low else None, (PANEL, -7) if ends[1] > high else None]
        for arrow in beyond:
            if arrow is not None:
                cut = True
                parts.append(f'<path d="M{arrow[0]} {y}l{arrow[1]} -4v8z" fill="{colour}"/>')
        parts.append(f'<circle cx="{across(each.value):.1f}" cy="{y}" r="4" fill="{colour}"/>')
    return parts, cut


def _axis(values: Sequence[Estimate]) -> tuple[float, float, list[float]]:
    """The ends of an axis that holds 0 and all values, and intervals as far as `SHOWN`; its marks at round numbers."""
    numbers = [each.value for each in values]
    ends = [end for each in values for end in each.interval or ()]
    least, most = min([0.0, *numbers]), max([0.0, *numbers])
    high = max(1.1 * most, min(1.05 * max([most, *ends]), SHOWN * most))
    low = min(1.1 * least, max(1.05 * min([least, *ends]), SHOWN * least))
    if high == low:
        high = 1.0
    step = _round_up((high - low) / 3)
    return low, high, [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _round_up(value: float) -> float:
    """1, 2 or 5 times a power of ten."""
    ten = 10.0 ** math.floor(math.log10(value))
    return next(times * ten for times in (1, 2, 5, 10) if times * ten >= value * (1 - 1e-9))


def _svg(width: int, height: int, parts: Sequence[str]) -> str:
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    ground = f'<rect width="{width}" height="{height}" fill="#fff"/>'
    style = f"<style>{STYLE}</style>"
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{style}{ground}{"".join(parts)}</svg>\n'
