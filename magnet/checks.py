"""Checks of what users give: numbers finite, whole where they count something, and in range; choices that there are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, get_args


def require_number(
    name: str, value: object, least: float | None = None, most: float | None = None, over: float | None = None
) -> None:
    """Refuse what is not a finite number in a range.

    Args:
        name: what the number is called where it is given.
        value: what was given; an int will do.
        least: the smallest number allowed.
        most: the largest.
        over: a number that it must lie above.

    Raises:
        ValueError: names the number, what was got and what was expected.
    """
    _require(name, value, "a number", least, most, over)


def require_whole(name: str, value: object, least: int | None = None, most: int | None = None) -> None:
    """Refuse what is not a whole number in a range; arguments as for `require_number`.

    Raises:
        ValueError: names the number, what was got and what was expected.
    """
    _require(name, value, "a whole number", least, most)


def require_wholes(name: str, values: object, like: str = "(0, 1)") -> None:
    """Refuse what is not a tuple or list of whole numbers, such as `like`.

    Raises:
        ValueError: names the field, what was got and how it is written.
    """
    several = isinstance(values, Sequence) and not isinstance(values, str)
    if not several or not all(_fits(value, whole=True) for value in values):  # type: ignore[attr-defined]
        raise ValueError(f"{name}: got {values!r}, expected whole numbers in brackets, such as {like}")


def require_choice(name: str, value: object, choices: object) -> None:
    """Refuse what is not among the values of a `Literal`.

    Raises:
        ValueError: names the field, what was got and what there is.
    """
    if value not in get_args(choices):
        words = " or ".join(word or '""' for word in get_args(choices))
        raise ValueError(f"{name}: got {value!r}, expected {words}")


def require_flag(name: str, value: object, unsaid: bool = False) -> None:
    """Refuse what is neither True nor False; None is accepted where it may be left `unsaid`.

    Raises:
        ValueError: names the field, and what was got.
    """
    if not isinstance(value, bool) and not (unsaid and value is None):
        raise ValueError(f"{name}: got {value!r}, expected True or False")


def _require(
    name: str, value: object, kind: str, least: float | None, most: float | None, over: float | None = None
) -> None:
    if _fits(value, kind == "a whole number"):
        number: Any = value  # a float would round seeds
        high = (least is None or number >= least) and (over is None or number > over)
        if high and (most is None or number <= most):
            return
        kind = ""
    if least is not None and most is not None:
        wanted = f"{_shown(least)} to {_shown(most)}"
    else:
        bounds = (("at least", least), ("over", over), ("at most", most))
        wanted = " and ".join(f"{word} {_shown(bound)}" for word, bound in bounds if bound is not None)
    shown = f"{value:g}" if isinstance(value, float) and kind != "a whole number" else f"{value!r}"
    raise ValueError(f"{name}: got {shown}, expected {', '.join(part for part in (kind, wanted) if part)}")


def _shown(bound: float) -> str:
    return f"{bound}" if isinstance(bound, int) else f"{bound:g}"


def _fits(value: object, whole: bool) -> bool:
    """Whether something is a finite number; True and False are none."""
    if isinstance(value, bool) or not isinstance(value, Integral if whole else Real):
        return False
    return math.isfinite(value)


def slots_of(name: str, agents: int | Sequence[int], count: int, has: str = "the scene has people") -> tuple[int, ...]:
    """One slot or several of so many, as a task takes them.

    Raises:
        ValueError: no whole numbers, or no such slot.
    """
    several: Any = (agents,) if isinstance(agents, Integral) else agents
    require_wholes(name, several)
    if strange := [agent for agent in several if not 0 <= agent < count]:
        raise ValueError(f"{name} {strange[0]}: {f'{has} 0 to {count - 1}' if count else 'nobody is in the scene'}")
    return tuple(int(agent) for agent in several)
