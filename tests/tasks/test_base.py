"""Tasks as they are asked for: by a name, with fields."""

from __future__ import annotations

import pytest

from magnet.tasks.base import task_of
from magnet.tasks.partner import MotionControl

SAMPLER = r"; how to sample is said of the model: magnet\.load\(name, sampler=\.\.\.\)$"


@pytest.mark.parametrize(
    ("field", "hint"), [("blok", "$"), ("sampler", SAMPLER), ("steps", SAMPLER), ("guidance", SAMPLER)]
)
def test_a_field_that_a_task_has_not_is_told_with_those_that_it_has(field: str, hint: str) -> None:
    with pytest.raises(ValueError, match=f"task motion_control has no field {field}; it has target, block{hint}"):
        task_of("motion_control", {"target": (1,), field: 2})
    assert task_of("motion_control", {"target": (1,)}) == MotionControl(target=(1,))
