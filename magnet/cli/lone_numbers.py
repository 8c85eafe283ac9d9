"""One whole number for an option that takes a list of them, on a command line: `--task.target 1` for `[1]`."""

from __future__ import annotations

import argparse
import re
import types
import typing
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

NUMBER = re.compile(r"-?\d+")
LISTS = (list, tuple, Sequence, Iterable)


def lists_of(actions: Iterable[argparse.Action]) -> frozenset[str]:
    """Options, with their dashes, that take whole numbers in a list of any length, and no number or text alone."""
    return frozenset(flag for action in actions if _whole(action) for flag in action.option_strings)


def _whole(action: argparse.Action) -> bool:
    kind = getattr(action, "_typehint", None)
    kinds = typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, types.UnionType) else (kind,)
    kinds = tuple(each for each in kinds if each is not types.NoneType)
    return bool(kinds) and all(
        typing.get_origin(each) in LISTS and typing.get_args(each) in ((int,), (int, ...)) for each in kinds
    )


def in_lists(flags: Sequence[str], takes_list: Callable[[str], bool]) -> list[str]:
    """A command line whose lone whole numbers are lists where `takes_list` says so of their option."""
    words: list[str] = []
    for before, word in pairwise(["", *flags]):
        name, equals, value = word.partition("=")
        if before.startswith("--") and NUMBER.fullmatch(word) and takes_list(before):
            word = f"[{word}]"
        elif equals and NUMBER.fullmatch(value) and takes_list(name):
            word = f"{name}=[{value}]"
        words.append(word)
    return words
