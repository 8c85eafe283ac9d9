"""Pictures of a table: each column a panel, each row a dot with its interval; curves of a long generation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from magnet.report.statistics import Estimate

ROW, LEFT, PANEL, TOP, GAP = 22, 240, 150, 40, 18
"""Pixels of a line, of the margin of names, of a panel, above panels and between them."""
WIDTH, HEIGHT = 640, 280
COLOURS = ("#2563eb", "#d97706", "#059669", "#7c3aed")
STYLE = (
    "text{font:12px sans-serif;fill:#333} .frame{fill:#fafafa;stroke:#ccc} .reach{stroke:#2563eb;stroke-width:2} "
    ".dot{fill:#2563eb} polyline{fill:none;stroke-width:2}"
)


def dots(rows: Mapping[str, Mapping[str, Estimate]], columns: Mapping[str, str]) -> str:
    """SVG of values with intervals. rows: title -> metric -> estimate; columns: metric -> title."""
    parts = []
    height = TOP + ROW * len(rows) + 20
    for place, title in enumerate(rows):
        parts.append(f'<text x="{LEFT - 10}" y="{TOP + ROW * place + 15}" text-anchor="end">{escape(title)}</text>')
    for number, (metric, head) in enumerate(columns.items()):
        left = LEFT + number * (PANEL + GAP)
        there = {place: row[metric] for place, row in enumerate(rows.values()) if metric in row}
        ends = [end for each in there.values() for end in (each.interval or (each.value, each.value))]
        low, high = min([0.0, *ends]), max([1e-9, *(each.value for each in there.values())]) * 1.25
        parts.append(f'<rect x="{left}" y="{TOP}" width="{PANEL}" height="{ROW * len(rows)}" class="frame"/>')
        parts.append(f'<text x="{left}" y="{TOP - 10}">{escape(head)}</text>')
        parts.append(f'<text x="{left}" y="{height - 6}">{low:.2g}</text>')
        parts.append(f'<text x="{left + PANEL}" y="{height - 6}" text-anchor="end">{high:.2g}</text>')
        for place, each in there.items():
            y = TOP + ROW * place + ROW / 2
            a, b = (_across(end, low, high, left) for end in (each.interval or (each.value, each.value)))
            parts.append(f'<line x1="{a:.1f}" x2="{b:.1f}" y1="{y}" y2="{y}" class="reach"/>')
            parts.append(f'<circle cx="{_across(each.value, low, high, left):.1f}" cy="{y}" r="4" class="dot"/>')
    return _svg(LEFT + len(columns) * (PANEL + GAP), height, parts)


def curves(rows: Mapping[str, Mapping[str, Estimate]], frames: Sequence[int]) -> str:
    """SVG of `fd@FRAMES` over frames, a line a row."""
    parts = [f'<rect x="60" y="{TOP}" width="{WIDTH - 80}" height="{HEIGHT - TOP - 40}" class="frame"/>']
    most = max([each.value for row in rows.values() for each in row.values()], default=1.0) * 1.1
    parts.append(f'<text x="54" y="{TOP + 10}" text-anchor="end">{most:.3g}</text>')
    parts.append(f'<text x="54" y="{HEIGHT - 40}" text-anchor="end">0</text>')
    parts.append(f'<text x="60" y="{HEIGHT - 20}">FD over frames generated, to {max(frames, default=0)}</text>')
    for number, (title, row) in enumerate(rows.items()):
        colour = COLOURS[number % len(COLOURS)]
        points = []
        for frame in frames:
            if f"fd@{frame}" in row:
                x = 60 + (WIDTH - 80) * frame / max(frames)
                points.append(f"{x:.1f},{HEIGHT - 40 - (HEIGHT - TOP - 40) * row[f'fd@{frame}'].value / most:.1f}")
        parts.append(f'<polyline points="{" ".join(points)}" stroke="{colour}"/>')
        parts.append(f'<text x="{70 + 140 * number}" y="{TOP - 10}" fill="{colour}">{escape(title)}</text>')
    return _svg(WIDTH, HEIGHT, parts)


def _across(value: float, low: float, high: float, left: float) -> float:
    return left + PANEL * (min(max(value, low), high) - low) / (high - low)


def _svg(width: int, height: int, parts: Sequence[str]) -> str:
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}><style>{STYLE}</style>{"".join(parts)}</svg>\n'
