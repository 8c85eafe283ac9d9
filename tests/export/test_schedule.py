"""Pictures of mask schedules, against the schedules they show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from magnet.export.drawing import AGENTS, CONTEXT
from magnet.export.schedule import draw_schedule, moments, shade
from magnet.export.schedule_terminal import schedule_text
from magnet.sampling.noise import LEVELS
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks import registry
from tests.cases import few

GRID = Grid(tokens=9, agents=2, context=3, steps=3, window=6, stride=2)


def plan(name: str, grid: Grid = GRID, **options: object) -> MaskSchedule:
    return registry.get(name)(**options).schedule(grid)


def exact(image: Image.Image, colour: tuple[int, int, int]) -> np.ndarray:
    """Which pixels have exactly a colour."""
    return (np.asarray(image.convert("RGB")) == np.array(colour)).all(axis=-1)


@pytest.mark.parametrize("people", few([2, 3, 4], 1))
@pytest.mark.parametrize("name", registry.names())
def test_every_task_can_be_drawn_for_any_number_of_people(tmp_path: Path, name: str, people: int) -> None:
    grid = Grid(tokens=9, agents=people, context=3, steps=3, window=6, stride=2)
    schedule = plan(name, grid)
    image = Image.open(draw_schedule(schedule, tmp_path / "plan.png", title=name, count=8, unit=1))
    for agent in range(people):
        if (schedule.finished & ~schedule.known)[:, agent].any():
            assert exact(image, AGENTS[agent]).sum() > 80, f"agent {agent} is missing"
    assert (exact(image, CONTEXT[0]).sum() > 80) == bool(schedule.known.any())
    for colour in (True, False):
        lines = schedule_text(schedule, 60, colour, 8).plain.splitlines()
        assert max(map(len, lines)) <= 60


def test_known_columns_are_pink_and_no_others(tmp_path: Path) -> None:
    grid = Grid(tokens=8, agents=2, context=3, steps=4)
    image = Image.open(draw_schedule(plan("joint_future", grid), tmp_path / "plan.png"))
    pink = exact(image, CONTEXT[0])[: image.height - 100]  # less the legend
    blue = exact(image, AGENTS[0])[: image.height - 100]
    assert pink.any(axis=0).nonzero()[0].max() < blue[:, 150:].any(axis=0).nonzero()[0].min() + 150
    runs = np.diff(pink.any(axis=0).astype(int)) == 1
    assert runs.sum() == 3


def test_saturation_falls_with_the_level() -> None:
    spread = [max(shade(AGENTS[0], level)) - min(shade(AGENTS[0], level)) for level in range(0, LEVELS + 1, 100)]
    assert spread == sorted(spread, reverse=True)
    assert shade(AGENTS[0], 0) == AGENTS[0]
    assert min(shade(AGENTS[0], LEVELS)) > 235


@pytest.mark.parametrize("name", registry.names())
def test_moments_are_rows_of_the_schedule(name: str) -> None:
    schedule = plan(name)
    rows = list(schedule.levels_by_step())
    for count in (4, 7, 12, 200):
        shown = moments(schedule, count)
        numbers = [moment.number for moment in shown]
        assert numbers == sorted(set(numbers))
        assert len(shown) <= count
        assert numbers[0] == 0
        assert numbers[-1] == schedule.evaluations
        for moment in shown:
            assert torch.equal(torch.from_numpy(moment.level), rows[moment.number])
    assert len(shown) == len(rows)


def test_what_leaves_the_window_is_empty() -> None:
    for moment in moments(plan("joint_future"), 20)[:-1]:
        assert moment.window is not None
        start, stop = moment.window
        assert moment.empty[:start].all()
        assert moment.empty[stop:].all()
        assert not moment.empty[start:stop].any()


def test_what_stays_unknown_is_empty() -> None:
    last = moments(plan("partner_prediction", target=(0,)))[-1]
    assert last.empty[3:, 1].all()
    assert not last.empty[:, 0].any()


def test_the_partners_future_is_empty_until_its_turn() -> None:
    """Motion control sees the other up to the token that it generates."""
    for moment in moments(plan("motion_control"), 100)[:-1]:
        now = int((moment.level[:, 0] > 0).nonzero()[0][0])
        inside = np.arange(GRID.tokens) >= moment.window[0]
        assert (moment.empty[:, 1] == ~(inside & (np.arange(GRID.tokens) <= now))).all()


def test_boxes_of_simultaneous_agents_are_hidden_but_not_empty() -> None:
    first = moments(plan("agentic_sync"))[0]
    assert first.unseen[0, 3, 1]
    assert first.unseen[1, 3, 0]
    assert first.unseen.sum() == 2
    assert not first.empty[3].any()


def test_dashes_have_the_colour_of_who_does_not_see(tmp_path: Path) -> None:
    """Before the first step nothing is clean, so that only dashes have an agent's full colour."""
    grid = Grid(tokens=5, agents=2, context=4, steps=4)
    for name, dashes in {"agentic_sync": True, "joint_future": False}.items():
        image = Image.open(draw_schedule(plan(name, grid), tmp_path / "plan.png"))
        upper, lower = image.crop((140, 64, 400, 93)), image.crop((140, 94, 400, 123))
        assert exact(upper, AGENTS[1]).any() == dashes
        assert exact(lower, AGENTS[0]).any() == dashes
        assert not exact(upper, AGENTS[0]).any()
        assert not exact(lower, AGENTS[1]).any()


def test_a_long_schedule_stays_readable(tmp_path: Path) -> None:
    grid = Grid(tokens=1200, agents=3, context=4, steps=4, window=16, stride=12)
    schedule = plan("joint_future", grid)
    path = draw_schedule(schedule, tmp_path / "plan.PNG")
    with Image.open(path) as image:
        assert max(image.size) < 2500
    assert path.stat().st_size < 80_000
    text = schedule_text(schedule, 80).plain
    assert max(map(len, text.splitlines())) <= 80
    assert "of 1200 token steps are shown" in text


def test_plain_characters_are_ascii() -> None:
    text = schedule_text(plan("agentic_async", offset=0.5), 80, colour=False).plain
    assert text.isascii()
    assert text.splitlines()[0].split("A")[1].split() == ["o", "o", "o", "9", ".", ".", ".", ".", "."]


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"written as \.png"):
        draw_schedule(plan("joint_future"), tmp_path / "plan.svg")
    with pytest.raises(ValueError, match="4 or more"):
        draw_schedule(plan("joint_future"), tmp_path / "plan.png", count=3)
