"""Pictures of mask schedules: the noise level of every token of every agent over denoising (paper Fig. A.3)."""

from __future__ import annotations

import string
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from magnet.export.drawing import AGENTS, CONTEXT, INK, PALE, Colour, drawable, font
from magnet.files import whole
from magnet.sampling.noise import LEVELS
from magnet.sampling.schedule import MaskSchedule, initial_levels

PAGE: Colour = (255, 255, 255)
GIVEN: Colour = CONTEXT[0]
DASH: Colour = (176, 182, 194)
WINDOW: Colour = (104, 114, 134)
NOISE_SHARE = 0.07  # of its agent's colour that a box of pure noise keeps
MAX_COLUMNS = 480


@dataclass(frozen=True, eq=False)
class Moment:
    """The grid before one denoising step, as seen by the agents that the step updates.

    Attributes:
        number: denoising steps done.
        level: (N, P) int in 0..K.
        unseen: (P, N, P) bool, [p, i, q]: agent p is being updated and must not see agent q's token i.
        empty: (N, P) bool, no agent that is being updated sees the token, or it never leaves pure noise.
        window: token steps that the model sees, from start to stop; None after the last step.
    """

    number: int
    level: NDArray[np.int64]
    unseen: NDArray[np.bool_]
    empty: NDArray[np.bool_]
    window: tuple[int, int] | None


def moments(schedule: MaskSchedule, count: int = 16) -> list[Moment]:
    """At most `count` moments, the first and the last among them.

    All steps if they are few; else more of the first stage, and one of later stages each, which shows the window
    moving on.

    Raises:
        ValueError: fewer than four moments.
    """
    if count < 4:
        raise ValueError(f"moments: got {count}, expected 4 or more")
    wanted = _numbers([stage.levels.shape[0] - 1 for stage in schedule.stages], count)
    level = initial_levels(schedule.known).numpy().copy()
    never = schedule.final_levels().numpy() == LEVELS
    agents, done, found = schedule.agents, 0, []
    for stage in schedule.stages:
        steps, inside = stage.levels.shape[0] - 1, slice(stage.start, stage.stop)
        rows = stage.levels.numpy()
        visibility = None if stage.visibility is None else stage.visibility.numpy()
        for step in sorted(number - done for number in wanted if done <= number < done + steps):
            level[inside] = rows[step]
            updated = (rows[step] != rows[step + 1]).any(axis=0)
            unseen = np.zeros((agents, schedule.tokens, agents), dtype=bool)
            if visibility is not None:
                unseen[:, inside] = ~visibility & updated[:, None, None]
            empty = never | unseen[updated].all(axis=0)
            empty[: stage.start] = empty[stage.stop :] = True
            found.append(Moment(done + step, level.copy(), unseen, empty, (stage.start, stage.stop)))
        level[inside] = rows[-1]
        done += steps
    nothing = np.zeros((agents, schedule.tokens, agents), dtype=bool)
    return [*found, Moment(done, level, nothing, never, None)]


def _numbers(steps: Sequence[int], count: int) -> set[int]:
    """Which of the steps to show."""
    total = sum(steps)
    if total < count:
        return set(range(total + 1))
    if len(steps) == 1:
        return set(_even(0, total, count))
    later = min(len(steps) - 1, (count - 1) // 2)
    chosen = [round(x) for x in np.linspace(1, len(steps) - 1, later + 1)[1:]] if later < len(steps) - 1 else None
    begins = np.cumsum([0, *steps])
    middles = [int(begins[i] + steps[i] * 5 // 8) for i in chosen or range(1, len(steps))]
    return {*_even(0, steps[0], count - 1 - later), *middles, total}


def _even(first: int, last: int, count: int) -> list[int]:
    return [round(x) for x in np.linspace(first, last, count)]


def agent_name(agent: int) -> str:
    """A, B, C, ..."""
    return string.ascii_uppercase[agent] if agent < 26 else str(agent)


def shade(colour: Colour, level: int) -> Colour:
    """A colour by noise level: full where a token is clean, paler the noisier it is."""
    return mix(colour, NOISE_SHARE + (1 - NOISE_SHARE) * (1 - level / LEVELS))


def mix(colour: Colour, share: float, ground: Colour = PAGE) -> Colour:
    """A share of a colour on a ground."""
    red, green, blue = (round(share * c + (1 - share) * g) for c, g in zip(colour, ground, strict=True))
    return red, green, blue


def thinned(tokens: int, most: int) -> NDArray[np.int64]:
    """At most so many token steps, evenly spread."""
    return np.unique(np.linspace(0, tokens - 1, min(tokens, most)).round().astype(np.int64))


# -- PNG ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layout:
    """Where things are, in pixels."""

    unit: int
    wide: int  # of a box, its gap included
    high: int
    left: int
    top: int
    between: int  # moments
    agents: int

    def box(self, row: int, column: int, agent: int) -> tuple[int, int, int, int]:
        gap = self.unit * (2 if self.fine else 0)
        x = self.left + column * self.wide
        y = self.top + row * (self.agents * self.high + self.between) + agent * self.high
        return x, y, x + self.wide - gap - 1, y + self.high - max(gap, self.unit) - 1

    @property
    def fine(self) -> bool:
        """Whether boxes are large enough for outlines."""
        return self.wide >= 9 * self.unit


def draw_schedule(
    schedule: MaskSchedule, path: str | Path, *, title: str = "", subtitle: str = "", count: int = 16, unit: int = 2
) -> Path:
    """Write a PNG of a schedule: token time to the right, denoising downwards, agents by colour.

    The more saturated a box, the cleaner its token. Pink was given. Dashed boxes are not available to the
    agents that are being updated; a filled box with dashes is hidden from the agents in whose colours they are.
    Returns the path written.

    Args:
        count: how many moments of the denoising at most.
        unit: pixels of the thinnest line.

    Raises:
        ValueError: not a .png, or too few moments.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path.name}: pictures are written as .png")
    title, subtitle = drawable(title), drawable(subtitle)
    rows = moments(schedule, count)
    columns = thinned(schedule.tokens, MAX_COLUMNS)
    wide = unit * max(2, min(26, 620 // len(columns)))
    head = (46 if title or subtitle else 8) + 24
    plan = Layout(
        unit, wide, unit * (15 if schedule.agents < 4 else 12), unit * 70, unit * head, unit * 8, schedule.agents
    )
    keys = legend(schedule, rows)
    least = max(font(17 * unit).getlength(title), font(12 * unit).getlength(subtitle)) + 28 * unit
    width = round(max(plan.left + len(columns) * wide + 16 * unit, least, 470 * unit))
    lines = _flow(keys, width - 28 * unit, unit)
    bottom = plan.top + len(rows) * (plan.agents * plan.high + plan.between)
    page = Image.new("RGB", (width, bottom + unit * (14 + 20 * len(lines))), PAGE)
    draw = ImageDraw.Draw(page)
    draw.text((14 * unit, 16 * unit), title, fill=INK, font=font(17 * unit), anchor="lm")
    draw.text((14 * unit, 37 * unit), subtitle, fill=PALE, font=font(12 * unit), anchor="lm")
    _axes(draw, plan, columns, rows)
    known = schedule.known.numpy()
    for row, moment in enumerate(rows):
        for agent in range(schedule.agents):
            for column, token in enumerate(columns):
                _box(draw, plan.box(row, column, agent), moment, int(token), agent, bool(known[token, agent]), plan)
        if moment.window:
            first, last = np.searchsorted(columns, moment.window)
            x0, y0, _, _ = plan.box(row, int(first), 0)
            _, _, x1, y1 = plan.box(row, int(last) - 1, schedule.agents - 1)
            frame = (x0 - 3 * unit, y0 - 3 * unit, x1 + 3 * unit, y1 + 3 * unit)
            draw.rounded_rectangle(frame, radius=4 * unit, outline=WINDOW, width=unit)
    for number, line in enumerate(lines):
        _key(draw, line, bottom + unit * (10 + 20 * number), plan)
    with whole(path) as part:
        page.quantize(128, dither=Image.Dither.NONE).save(part, optimize=True)
    return path


def _axes(draw: ImageDraw.ImageDraw, plan: Layout, columns: NDArray[np.int64], rows: list[Moment]) -> None:
    unit, small = plan.unit, font(10 * plan.unit)
    draw.text((14 * unit, plan.top - 12 * unit), "step", fill=PALE, font=small, anchor="lm")
    draw.text((plan.left - 8 * unit, plan.top - 12 * unit), "token", fill=PALE, font=small, anchor="rm")
    every = max(1, -(-26 * unit // plan.wide))
    every = next(nice for power in range(9) for nice in (10**power, 2 * 10**power, 5 * 10**power) if nice >= every)
    for column, token in enumerate(columns):
        if column % every == 0:
            x0, y0, x1, _ = plan.box(0, column, 0)
            draw.text(((x0 + x1) / 2, y0 - 12 * unit), str(token), fill=PALE, font=small, anchor="mm")
    for row, moment in enumerate(rows):
        _, y0, _, _ = plan.box(row, 0, 0)
        _, _, _, y1 = plan.box(row, 0, plan.agents - 1)
        draw.text((14 * unit, (y0 + y1) / 2), str(moment.number), fill=INK, font=font(11 * unit), anchor="lm")
        for agent in range(plan.agents):
            _, top, _, low = plan.box(row, 0, agent)
            place = (plan.left - 14 * unit, (top + low) / 2)
            draw.text(place, agent_name(agent), fill=AGENTS[agent % len(AGENTS)], font=font(10 * unit), anchor="mm")
    for row, (before, after) in enumerate(pairwise(rows)):
        if after.number > before.number + 1:  # steps left out
            _, y, _, _ = plan.box(row + 1, 0, 0)
            for dot in (-2, 0, 2):
                at = (18 * unit, y - plan.between / 2 + 2 * dot * unit - unit)
                draw.ellipse(
                    (at[0] - unit * 0.6, at[1] - unit * 0.6, at[0] + unit * 0.6, at[1] + unit * 0.6), fill=PALE
                )


def _box(
    draw: ImageDraw.ImageDraw,
    box: tuple[int, int, int, int],
    moment: Moment,
    token: int,
    agent: int,
    known: bool,
    plan: Layout,
) -> None:
    """One token of one agent."""
    own = GIVEN if known else AGENTS[agent % len(AGENTS)]
    level = int(moment.level[token, agent])
    unit = plan.unit
    if moment.empty[token, agent]:
        _unavailable(draw, box, own, level < LEVELS, plan)
        return
    if not plan.fine:
        draw.rectangle(box, fill=shade(own, level))
        return
    viewers = [AGENTS[p % len(AGENTS)] for p in np.flatnonzero(moment.unseen[:, token, agent])]
    draw.rounded_rectangle(box, radius=2 * unit, fill=shade(own, level), outline=mix(own, 0.6), width=unit)
    if viewers:
        draw.rectangle(box, outline=PAGE, width=2 * unit)
        _dashed(draw, box, viewers, 2 * unit)


def _unavailable(
    draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], own: Colour, clean: bool, plan: Layout
) -> None:
    """A token that no agent sees that is being updated, with a dot where it is clean."""
    if not plan.fine:
        draw.rectangle(box, fill=mix(own, 0.35, (214, 218, 226)) if clean else (244, 245, 248))
        return
    _dashed(draw, box, [DASH], plan.unit)
    if clean:
        x, y, r = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2, 2.2 * plan.unit
        draw.ellipse((x - r, y - r, x + r, y + r), fill=mix(own, 0.75))


def _dashed(draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], colours: Sequence[Colour], width: int) -> None:
    """A dashed outline whose dashes take turns in the colours."""
    x0, y0, x1, y1 = box
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    number, inset = 0, width - 1
    for (ax, ay), (bx, by) in pairwise(corners):
        length = abs(bx - ax) + abs(by - ay)
        dashes = max(2, round(length / (3.2 * (width + 4) / 2)))
        period = length / (dashes - 0.45)
        for dash in range(dashes):
            ends = [min(1.0, share * period / length) for share in (dash, dash + 0.55)]
            xs, ys = [ax + (bx - ax) * e for e in ends], [ay + (by - ay) * e for e in ends]
            # Grown into the box, so that thick dashes do not leave it.
            left, top = min(max(min(xs), x0), x1 - inset), min(max(min(ys), y0), y1 - inset)
            right, low = max(max(xs), left + inset), max(max(ys), top + inset)
            draw.rectangle((left, top, right, low), fill=colours[number % len(colours)])
            number += 1


Key = tuple[str, str]  # what is drawn, what it means


def legend(schedule: MaskSchedule, rows: list[Moment]) -> list[Key]:
    """Entries of the picture's legend."""
    keys = [("noise", "pure noise to generated")]
    known = schedule.known.numpy()
    if known.any():
        keys.insert(0, ("given", "given"))
    if any((moment.empty & (moment.level == LEVELS)).any() or (moment.empty & known).any() for moment in rows):
        keys.append(("empty", "not available"))
    if any((moment.empty & (moment.level < LEVELS)).any() for moment in rows):
        keys.append(("done", "known, but out of sight"))
    if any((moment.unseen.any(axis=0) & ~moment.empty).any() for moment in rows):
        keys.append(("hidden", "hidden from the agent of the dashes' colour"))
    return [*keys, ("window", "the model's window")]


def _flow(keys: list[Key], width: int, unit: int) -> list[list[Key]]:
    """Keys in lines that fit."""
    lines: list[list[Key]] = [[]]
    for key in keys:
        if lines[-1] and sum(_key_width(k, unit) for k in [*lines[-1], key]) > width:
            lines.append([])
        lines[-1].append(key)
    return lines


def _key_width(key: Key, unit: int) -> float:
    return font(11 * unit).getlength(key[1]) + unit * (92 if key[0] == "noise" else 46)


def _key(draw: ImageDraw.ImageDraw, keys: list[Key], y: int, plan: Layout) -> None:
    """One line of the legend."""
    unit = plan.unit
    x = 14 * unit
    for kind, meaning in keys:
        box = (x, y, x + 20 * unit, y + 11 * unit)
        if kind == "noise":
            for step in range(4):
                small = (x + 17 * step * unit, y, x + (17 * step + 15) * unit, y + 11 * unit)
                own = AGENTS[0]
                fill, edge = shade(own, LEVELS * (3 - step) // 3), mix(own, 0.6)
                draw.rounded_rectangle(small, radius=2 * unit, fill=fill, outline=edge, width=unit)
        elif kind == "window":
            draw.rounded_rectangle(box, radius=4 * unit, outline=WINDOW, width=unit)
        elif kind in ("empty", "done"):
            _unavailable(draw, box, AGENTS[0], kind == "done", plan)
        else:
            fill = GIVEN if kind == "given" else shade(AGENTS[0], LEVELS // 3)
            draw.rounded_rectangle(box, radius=2 * unit, fill=fill)
            if kind == "hidden":
                draw.rectangle(box, outline=PAGE, width=2 * unit)
                _dashed(draw, box, [AGENTS[1]], 2 * unit)
        after = x + unit * (74 if kind == "noise" else 27)
        draw.text((after, y + 5.5 * unit), meaning, fill=INK, font=font(11 * unit), anchor="lm")
        x += round(_key_width((kind, meaning), unit))
