"""Tasks as they are asked for: by a name, with fields."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from magnet.plugins import Registered
from magnet.tasks import registry
from magnet.tasks.base import SMALL, fault_of, needed, schedule_of, task_of
from magnet.tasks.partner import MotionControl

SAMPLER = r"; how to sample is said of the model: magnet\.load\(name, sampler=\.\.\.\)$"


@pytest.mark.parametrize(
    ("field", "hint"), [("blok", "$"), ("sampler", SAMPLER), ("steps", SAMPLER), ("guidance", SAMPLER)]
)
def test_a_field_that_a_task_has_not_is_told_with_those_that_it_has(field: str, hint: str) -> None:
    with pytest.raises(ValueError, match=f"task motion_control has no field {field}; it has target, block{hint}"):
        task_of("motion_control", {"target": (1,), field: 2})
    assert task_of("motion_control", {"target": (1,)}) == MotionControl(target=(1,))


def test_a_field_that_a_task_needs_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    needy = dataclasses.make_dataclass("Needy", [("whom", int)], bases=(MotionControl,), frozen=True, kw_only=True)
    registry.discover()
    monkeypatch.setitem(registry.TASKS.known, "needy", Registered("needy", needy, "strange-tasks 3.1"))
    with pytest.raises(ValueError, match="task needy needs whom, which is not given"):
        task_of("needy", {"target": (1,)})
    assert task_of("needy", {"whom": 0}) == needy(whom=0)
    needier = dataclasses.make_dataclass("Needier", [("where", int)], bases=(needy,), frozen=True, kw_only=True)
    monkeypatch.setitem(registry.TASKS.known, "needier", Registered("needier", needier, "strange-tasks 3.1"))
    with pytest.raises(ValueError, match="task needier needs whom and where, which are not given"):
        task_of("needier", {"target": (1,)})


def test_fields_that_are_made_or_never_given_are_not_needed() -> None:
    made: list[Any] = [
        ("whom", int),
        ("list", list[int], dataclasses.field(default_factory=list)),
        ("own", int, dataclasses.field(init=False)),
    ]
    assert needed(dataclasses.make_dataclass("Made", made, frozen=True, kw_only=True)) == ["whom"]


@pytest.mark.parametrize("name", registry.names())
def test_every_task_of_ours_can_be_tried(name: str) -> None:
    """On a grid with a past: a task that goes on would refuse another, and its faults were never found."""
    assert schedule_of(registry.get(name)(), SMALL).finished.any()
    assert fault_of(registry.get(name)) is None


def test_a_task_that_needs_fields_cannot_be_tried_which_is_no_fault() -> None:
    needy = dataclasses.make_dataclass("Needy", [("whom", int)], bases=(MotionControl,), frozen=True, kw_only=True)
    assert fault_of(needy) is None
