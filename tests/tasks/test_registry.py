import dataclasses
from typing import ClassVar

import pytest

from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks import registry


@dataclasses.dataclass(frozen=True)
class Foreign:
    """A stranger's task."""

    formula: ClassVar[str] = "P(A)"

    def schedule(self, grid: Grid) -> MaskSchedule:
        return MaskSchedule.together(grid.past(), ~grid.past(), grid)


@pytest.fixture
def clean_registry(monkeypatch):
    registry.discover()
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    monkeypatch.setattr(registry, "_failures", {})


class FakePoint:
    """What importlib.metadata gives for an entry point."""

    dist = None

    def __init__(self, name: str, load) -> None:
        self.name, self.load, self.value = name, load, f"{name}_package:Task"


def test_our_tasks_are_there():
    assert {"joint_future", "generation"} <= set(registry.names())


def test_an_unknown_name_suggests_the_closest():
    with pytest.raises(ValueError, match="did you mean joint_future"):
        registry.get("joint_futur")


def test_an_installed_package_adds_its_task(clean_registry, monkeypatch):
    monkeypatch.setattr(registry, "entry_points", lambda group: [FakePoint("duel", lambda: Foreign)])
    registry.discover(again=True)
    assert registry.get("duel") is Foreign


def test_a_plug_in_that_fails_is_listed_and_hides_no_other(clean_registry, monkeypatch):
    def broken():
        raise ImportError("No module named nope")

    points = [FakePoint("broken", broken), FakePoint("duel", lambda: Foreign)]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    registry.discover(again=True)
    assert registry.get("duel") is Foreign
    assert "nope" in str(registry.failures()["broken"])
    with pytest.raises(ValueError, match="broken failed to load"):
        registry.get("broken")


def test_a_variable_names_an_uninstalled_task(clean_registry, monkeypatch):
    monkeypatch.setenv(registry.VARIABLE, f"{__name__}:Foreign")
    registry.discover(again=True)
    assert registry.get("foreign") is Foreign


def test_a_taken_name_is_refused(clean_registry):
    with pytest.raises(ValueError, match="joint_future is taken"):
        registry.register_task("joint_future")(Foreign)


def test_what_is_no_task_is_refused(clean_registry):
    with pytest.raises(TypeError, match="is not a dataclass"):
        registry.register_task("no")(type("No", (), {"schedule": 1, "formula": ""}))
