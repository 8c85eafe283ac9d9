"""How the numbers of a metric are shown: each metric class describes its own, and tables read that."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

from torchmetrics import Metric, MetricCollection

Better = Literal["low", "high", "real", ""]
"""Which value is good: a low one, a high one, or one near the recorded motion's own; "" says nothing."""

Beside = Literal["recording", "samples", ""]
"""What a sample is compared with: the recording of its own scene, the other samples of that scene, or neither."""


class Column(NamedTuple):
    """Title, unit, direction and meaning of one number.

    Attributes:
        title: at the head of a table's column.
        unit: such as "m"; empty for shares and ratios.
        better: which value is good.
        meaning: what is measured, in a few words for the footnote.
        main: whether the short table shows it.
        beside: what a sample is compared with. Rows whose samples are not of the recorded scene, such as the training
            set's, leave out what they cannot be compared with.
    """

    title: str
    unit: str
    better: Better
    meaning: str
    main: bool = False
    beside: Beside = ""


class Part(NamedTuple):
    """A suffix `@...` of a number's name, and how it is shown."""

    pattern: str
    title: str
    meaning: str
    note: str


PARTS = (
    Part(r"(.+)s", "{}s", "up to {} s", "A time behind a name, such as {}: over the frames up to then."),
    Part(
        r"second(\d+)", "second {}", "within second {}", "A second behind a name, such as {}: over that second alone."
    ),
    Part(r"agent(\d+)", "agent {}", "of agent {}", "An agent behind a name, such as {}: of that slot alone."),
)


def columns_of(*metrics: Metric | MetricCollection) -> dict[str, Column]:
    """What metrics say of their numbers, by name; a metric without `columns` says nothing."""
    found: dict[str, Column] = {}
    for metric in metrics:
        for one in metric.values() if isinstance(metric, MetricCollection) else (metric,):
            found |= getattr(one, "columns", {})
    return found


def column(name: str, known: Mapping[str, Column]) -> Column:
    """How a number is shown; an unknown one by its own name.

    `<name>@1s`, `<name>@second3` and `<name>@agent0` are parts of `<name>` and shown as such. The short table
    shows a part only where it is known by its whole name.
    """
    if name in known:
        return known[name]
    base, at, part = name.partition("@")
    whole = known.get(base, Column(base, "", "", ""))
    if not at:
        return whole
    for kind in PARTS:
        if match := re.fullmatch(kind.pattern, part):
            title, meaning = kind.title.format(match[1]), kind.meaning.format(match[1])
            break
    else:
        title = meaning = part
    return whole._replace(title=f"{whole.title} {title}", meaning=f"{whole.meaning}, {meaning}", main=False)


def beside(name: str, known: Mapping[str, Column]) -> Beside:
    """What a number compares a sample with; a part and an end of an interval as the number itself does."""
    return column(name if name in known else re.sub("_(low|high)$", "", name), known).beside


def part_notes(names: Iterable[str]) -> list[str]:
    """Explanations of the suffixes `@...` in names, each kind once."""
    notes: dict[str, str] = {}
    for name in names:
        for kind in PARTS:
            if match := re.fullmatch(f".*@{kind.pattern}", name):
                notes.setdefault(kind.note, kind.note.format(kind.title.format(match[1])))
    return list(notes.values())
