"""Numbers that users give are finite, whole where they count, and in range: of every option that there is."""

from __future__ import annotations

import dataclasses
import math
import typing
from typing import Any

import numpy as np
import pytest

from magnet.checks import require_number, require_whole, require_wholes
from magnet.sampling.grid import planning_grid
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import ddim_levels
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid
from magnet.tasks import registry

GRID = Grid(24, 3, 4, steps=4, window=8)
TASKS = {entry.name: entry.kind for entry in registry.entries() if entry.kind.__module__.startswith("magnet.")}
OPTIONS: dict[str, type] = {"SamplerOptions": SamplerOptions, "Guidance": Guidance, "Grid": Grid, **TASKS}
NO_NUMBER = (math.nan, math.inf, -math.inf, True, "3")
FAR = -1e9  # below whatever an option may mean


def bad_values(hint: Any) -> list[Any]:
    """What no option of this type can mean; nothing where it is no number and no list of numbers."""
    parts = typing.get_args(hint) if type(None) in typing.get_args(hint) else (hint,)
    if int in parts:
        return [*NO_NUMBER, 2.5, int(FAR)]
    if float in parts:
        return [*NO_NUMBER, FAR]
    if typing.get_origin(hint) is tuple:
        inner = typing.get_args(hint)[0]
        return [3, (0.5,), (math.nan,), ("0",), (1000,)] if inner is int else [3, ((0,),), ((0.5, 1),), ((0, 1000),)]
    return []


CASES = [
    pytest.param(kind, field.name, value, id=f"{name}.{field.name}={value!r}")
    for name, kind in OPTIONS.items()
    for field in dataclasses.fields(kind)
    for value in bad_values(typing.get_type_hints(kind)[field.name])
]


def made(kind: type, **fields: Any) -> Any:
    """Options, or of a task its plan with them."""
    if kind is Grid:
        return dataclasses.replace(GRID, **fields)
    options = kind(**fields)
    return options.schedule(GRID) if kind in TASKS.values() else options


@pytest.mark.parametrize(("kind", "name", "value"), CASES)
def test_every_option_refuses_what_it_cannot_mean(kind, name, value):
    with pytest.raises(ValueError, match=f"{name.rstrip('s')}|keyframe"):
        made(kind, **{name: value})


@pytest.mark.parametrize("kind", OPTIONS.values(), ids=OPTIONS)
def test_options_as_they_are_by_default_are_accepted(kind):
    """Those of a task plan something: what is not known is clean in the end, for everybody who is generated."""
    got = made(kind)
    if kind not in TASKS.values():
        assert isinstance(got, kind)
        return
    finished = got.known.clone()
    for stage in got.stages:
        finished[stage.start : stage.stop] |= stage.levels[-1] == 0
    generated = finished & ~got.known
    assert bool(generated.any())
    assert bool(finished[:, generated.any(dim=0)].all())


def test_numbers_out_of_range_say_the_range():
    for given, message in [
        ((math.nan, 0, 1), "eta: got nan, expected a number, 0 to 1"),
        ((2, 0, 1), "eta: got 2, expected 0 to 1"),
        ((-0.5, 0), "eta: got -0.5, expected at least 0"),
        ((0.0, None, None, 0), "eta: got 0, expected over 0"),
        ((None,), "eta: got None, expected a number"),
        ((9, None, 8.5), "eta: got 9, expected at most 8.5"),
    ]:
        with pytest.raises(ValueError, match=f"^{message}$"):
            require_number("eta", *given)
    for number in (0, 1, 0.5, np.float32(0.25), np.int64(1)):
        require_number("eta", number, 0, 1)


def test_whole_numbers_are_no_fractions():
    with pytest.raises(ValueError, match=r"^block: got 2\.5, expected a whole number, 1 to 8$"):
        require_whole("block", 2.5, 1, 8)
    with pytest.raises(ValueError, match=r"^block: got 9, expected 1 to 8$"):
        require_whole("block", 9, 1, 8)
    require_whole("block", np.int64(8), 1, 8)
    require_whole("seed", 2**63 - 1, -(2**63), 2**63 - 1)
    with pytest.raises(ValueError, match=f"got {2**63}, expected {-(2**63)} to {2**63 - 1}"):
        require_whole("seed", 2**63, -(2**63), 2**63 - 1)


def test_lists_of_whole_numbers_show_how_they_are_written():
    with pytest.raises(ValueError, match=r"^target: got 0, expected whole numbers in brackets, such as \(0, 1\)$"):
        require_wholes("target", 0)
    require_wholes("target", [0, np.int64(1)])
    require_wholes("target", ())


def test_too_many_denoising_steps_name_how_many_work():
    with pytest.raises(
        ValueError, match="500 with a shift of 3 would use the same of 1000 levels twice; take 335 or fewer"
    ):
        ddim_levels(500, 3.0)
    for steps in (334, 335):
        levels = ddim_levels(steps, 3.0)
        assert len(levels) == steps + 1 and (levels.diff() < 0).all()
    with pytest.raises(ValueError, match="336"):
        ddim_levels(336, 3.0)
    assert len(ddim_levels(1000)) == 1001


@pytest.mark.parametrize("steps", [0, -1, 1001])
def test_denoising_steps_are_one_to_a_thousand(steps):
    with pytest.raises(ValueError, match=f"steps: got {steps}, expected 1 to 1000"):
        SamplerOptions(steps=steps)
    with pytest.raises(ValueError, match=f"steps: got {steps}, expected 1 to 1000"):
        ddim_levels(steps)


def test_what_is_sampled_as_it_was_trained_is_not_compiled() -> None:
    with pytest.raises(ValueError, match=r"^compile: the precision reference is the network as it was trained"):
        SamplerOptions(precision="reference", compile=True)


def test_the_grid_takes_whatever_the_sampler_does():
    """Options that are accepted plan: no number passes one check and fails another without a word."""
    options = SamplerOptions(steps=335, stride=8, pyramid_offset=None)
    assert planning_grid(24, 2, 4, 8, options).steps == 335
