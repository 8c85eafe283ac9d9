"""What `magnet predict` writes that no model made, and what is said of it: recorded frames, and people left out."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from magnet.generation.unmade import given_invalid, sound
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES

NAMED = 4
"""People who are named one by one; of more, a line says how many."""


def in_front(recorded: Scene, read: Scene) -> tuple[Scene, int]:
    """The files' scene without first frames that can stand nowhere, and how many frames are in front of what is read.

    What is read are whole tokens from the end of the files, so that up to three frames stand before it. They are said.
    """
    if not (lead := recorded.frames - read.frames):
        return recorded, 0
    bad = (~sound(recorded.slice(0, lead)).all(dim=0)).nonzero()[:, 0]
    left_out = int(bad[-1]) + 1 if len(bad) else 0
    first = "the first, which is not valid, is" if left_out == 1 else f"the first {left_out}, which are not valid, are"
    lost = f", {first} left out" if left_out else ""
    front = "one before them stays" if lead - left_out == 1 else f"{lead - left_out} before them stay"
    kept = f", the {front} in front" if left_out < lead else ""
    print(f"of {recorded.frames} frames the last {read.frames} are read, in tokens of 4 frames{kept}{lost}")
    return recorded.slice(left_out), lead - left_out


def said_of_unmade(task: str, recorded: Scene, lead: int, frames: int, unmade: Tensor) -> list[str]:
    """Lines on people whom a task does not make: from when to when they are as recorded, and when they stand still.

    frames: of what is written behind the first `lead`; else as for `magnet.generation.unmade.completed`.
    """
    good = sound(recorded).all(dim=0).nonzero()[:, 0]
    end = min(int(good[-1]) + 1 if len(good) else 0, lead + frames)
    there = recorded.present.any(dim=0)
    groups: dict[int, list[int]] = {}
    for person in (unmade.any(dim=0) & there).nonzero()[:, 0].tolist():
        first = lead + TOKEN_FRAMES * int(unmade[:, person].int().argmax())
        groups.setdefault(first, []).append(person)
    lines = []
    for first, people in groups.items():
        one = len(people) == 1
        who = f"{named(people)} {'is' if one else 'are'} not made by {task}"
        still = f"{'stands' if one else 'stand'} still from frame {max(first, end)}"
        if end > first:
            then = f", and {still}" if end < lead + frames else ""
            lines.append(f"{who}: as recorded in frames {first} to {end - 1}{then}")
        else:
            lines.append(f"{who} and {still}")
    return lines


def said_of_invalid(scene: Scene, known: Tensor, lead: int) -> list[str]:
    """A line on given frames that are marked as not valid, from which a model goes on as they are.

    known: (N, P) bool, token steps of people that the task reads.
    lead: frames of the files before the first frame of `scene`.
    """
    bad = given_invalid(scene, known).any(dim=0).nonzero()[:, 0]
    if not len(bad):
        return []
    first, last = lead + int(bad[0]), lead + int(bad[-1])
    some = f"frame {first}" if len(bad) == 1 else f"{len(bad)} frames from {first} to {last}"
    verb = "is" if len(bad) == 1 else "are"
    how = "marked as not valid (not tracked, or made up), and read all the same"
    return [f"of what is given, {some} {verb} {how}; --start and --end choose others"]


def named(people: Sequence[int]) -> str:
    """People in words: person 1, people 0 and 2, or how many."""
    if len(people) > NAMED:
        return f"{len(people)} people"
    names = [str(person) for person in people]
    return f"person {names[0]}" if len(names) == 1 else f"people {', '.join(names[:-1])} and {names[-1]}"


def said_of_given(made: Scene, lead: int = 0) -> str:
    """How many frames of whom were given, in all scenes, as a part of a sentence; empty where none were.

    lead: recorded frames in front of those that were made.
    """
    if made.given is None or not bool(made.given.any()):
        return ""
    there = made.present.any(dim=0).nonzero()[:, 0].tolist()
    scenes, all_given = made.present.sum(dim=0).tolist(), made.given.sum(dim=(0, 1)).tolist()
    counts = {person: all_given[person] + lead * scenes[person] for person in there}
    least, most = min(counts.values()), max(counts.values())
    if least == most:
        return f", of which {most} are given,"
    if len(counts) > NAMED:
        return f", of which {least} to {most} of each person are given,"
    *some, last = (f"{count} of person {person}" for person, count in counts.items())
    return f", of which {', '.join(some)} and {last} are given,"
