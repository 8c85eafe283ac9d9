"""Pictures of mask schedules for the terminal."""

from __future__ import annotations

from rich.text import Text

from magnet.export.drawing import AGENTS, INK, Colour
from magnet.export.schedule import GIVEN, Key, Moment, agent_name, legend, mix, moments, thinned
from magnet.sampling.noise import LEVELS
from magnet.sampling.schedule import MaskSchedule

GREY: Colour = (120, 124, 132)
PLAIN = {
    "given": "o given",
    "noise": "9 pure noise to 0 generated",
    "empty": ". not available",
    "done": "- known, but out of sight",
    "hidden": "' hidden from other agents under way",
}


def schedule_text(schedule: MaskSchedule, width: int = 80, colour: bool = True, count: int = 16) -> Text:
    """A schedule for the terminal, in coloured half blocks, or in plain characters, with its legend.

    Args:
        width: letters of a line; token steps are left out where they are more.
        colour: two agents share a line, one in its upper and one in its lower half; else a line each.
        count: how many moments of the denoising at most.
    """
    rows = moments(schedule, count)
    names = [agent_name(agent) for agent in range(schedule.agents)]
    pairs = [names[p : p + (2 if colour else 1)] for p in range(0, len(names), 2 if colour else 1)]
    left = len(str(rows[-1].number)) + 5
    columns = thinned(schedule.tokens, max(1, width - left))
    wide = 2 if left + 2 * len(columns) <= width else 1
    known = schedule.known.numpy()
    text = Text()
    for moment in rows:
        for line, pair in enumerate(pairs):
            number = str(moment.number) if line == 0 else ""
            text.append(f"{number:>{left - 4}} ", "dim")
            agents = [2 * line + i if colour else line for i in range(len(pair))]
            for agent, name in zip(agents, pair, strict=True):
                text.append(name, _rgb(AGENTS[agent % len(AGENTS)]))
            text.append(" " * (3 - len(pair)))
            for token in columns:
                if colour:
                    _blocks(text, [_halves(moment, int(token), p, bool(known[token, p])) for p in agents], wide)
                else:
                    text.append(_plain(moment, int(token), agents[0], bool(known[token, agents[0]]))[:wide])
            text.rstrip()
            text.append("\n")
        if len(pairs) > 1:
            text.append("\n")
    _append_legend(text, legend(schedule, rows), width, colour)
    if len(columns) < schedule.tokens:
        text.append(f"\n{len(columns)} of {schedule.tokens} token steps are shown", "dim")
    return text


def _halves(moment: Moment, token: int, agent: int, known: bool) -> tuple[Colour | None, Colour | None]:
    """Colours of a box's left and right halves; a half is missing where the token is hidden from some."""
    own = GIVEN if known else AGENTS[agent % len(AGENTS)]
    level = int(moment.level[token, agent])
    if moment.empty[token, agent]:
        return (None, None) if level == LEVELS else (mix(own, 0.3, GREY),) * 2
    full = mix(own, 0.15 + 0.85 * (1 - level / LEVELS))
    return full, None if moment.unseen[:, token, agent].any() else full


def _blocks(text: Text, boxes: list[tuple[Colour | None, Colour | None]], wide: int) -> None:
    for half in range(wide):
        upper, lower = boxes[0][half], boxes[1][half] if len(boxes) > 1 else None
        if upper and lower:
            text.append("▀", f"{_rgb(upper)} on {_rgb(lower)}")
        elif upper or lower:
            text.append("▀" if upper else "▄", _rgb(upper or lower or INK))
        else:
            text.append("·" if half == 0 else " ", "dim")


def _plain(moment: Moment, token: int, agent: int, known: bool) -> str:
    level = int(moment.level[token, agent])
    if moment.empty[token, agent]:
        return ". " if level == LEVELS else "- "
    mark = "o" if known else str(max(9 * level // LEVELS, int(level > 0)))
    return mark + ("'" if moment.unseen[:, token, agent].any() else " ")


def _append_legend(text: Text, keys: list[Key], width: int, colour: bool) -> None:
    used = 0
    for kind, meaning in keys:
        if kind not in PLAIN:
            continue
        part = _swatch(kind, meaning) if colour else Text(PLAIN[kind])
        if used and used + 3 + len(part) > width:
            text.append("\n")
            used = 0
        text.append_text(Text("   " if used else "") + part)
        used += len(part) + (3 if used else 0)


def _swatch(kind: str, meaning: str) -> Text:
    text = Text()
    if kind == "noise":
        for share in (0.15, 0.4, 0.7, 1.0):
            text.append("█", _rgb(mix(AGENTS[0], share)))
    elif kind == "given":
        text.append("██", _rgb(GIVEN))
    elif kind == "done":
        text.append("██", _rgb(mix(AGENTS[0], 0.3, GREY)))
    elif kind == "empty":
        text.append("· ", "dim")
    else:
        text.append("█ ", _rgb(AGENTS[0]))
        meaning = "hidden from other agents under way"
    return text.append(f" {meaning}")


def _rgb(colour: Colour) -> str:
    return "rgb({},{},{})".format(*colour)
