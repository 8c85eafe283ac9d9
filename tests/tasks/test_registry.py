import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import pytest

import magnet
from magnet import plugins
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks import registry


@dataclasses.dataclass(frozen=True)
class Foreign:
    """A stranger's task."""

    formula: ClassVar[str] = "P(A)"

    def schedule(self, grid: Grid) -> MaskSchedule:
        return MaskSchedule.full_sequence(grid.past(), ~grid.past(), grid)


@pytest.fixture
def clean_registry(monkeypatch):
    registry.discover()
    monkeypatch.setattr(registry.TASKS, "known", dict(registry.TASKS.known))
    monkeypatch.setattr(registry.TASKS, "failed", [])


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
    monkeypatch.setattr(plugins, "entry_points", lambda group: [FakePoint("duel", lambda: Foreign)])
    registry.discover(again=True)
    assert registry.get("duel") is Foreign


def test_a_class_whose_definition_runs_again_takes_the_place_of_itself(clean_registry):
    """As a notebook's cell does, after something in it was changed."""

    def cell() -> type:
        @registry.register_task("duel")
        @dataclasses.dataclass(frozen=True)
        class Duel(Foreign):
            pass

        return Duel

    first, again = cell(), cell()
    assert registry.get("duel") is again is not first
    with pytest.raises(ValueError, match=r"name duel is taken by .*cell\.<locals>\.Duel"):
        registry.register_task("duel")(Foreign)


def test_a_name_that_options_would_read_as_a_path_is_refused(clean_registry, monkeypatch):
    monkeypatch.setattr(plugins, "entry_points", lambda group: [FakePoint("Their.duel", lambda: Foreign)])
    registry.discover(again=True)
    with pytest.raises(ValueError, match="would be a module; call it their_duel"):
        registry.get("Their.duel")


def test_a_plug_in_that_fails_is_listed_and_hides_no_other(clean_registry, monkeypatch):
    def broken():
        raise ImportError("No module named nope")

    points = [FakePoint("broken", broken), FakePoint("duel", lambda: Foreign)]
    monkeypatch.setattr(plugins, "entry_points", lambda group: points)
    registry.discover(again=True)
    assert registry.get("duel") is Foreign
    (lost,) = registry.failures()
    assert lost.name == "broken" and "nope" in str(lost.error)
    with pytest.raises(ValueError, match="broken failed to load"):
        registry.get("broken")


def test_a_variable_names_an_uninstalled_task(clean_registry, monkeypatch):
    monkeypatch.setenv(registry.VARIABLE, f" {__name__}:Foreign ,")
    registry.discover(again=True)
    assert registry.get("foreign") is Foreign
    assert not registry.failures()


def test_a_taken_name_is_refused(clean_registry):
    with pytest.raises(ValueError, match="joint_future is taken"):
        registry.register_task("joint_future")(Foreign)


def test_what_is_no_task_is_refused(clean_registry):
    with pytest.raises(TypeError, match="is not a dataclass"):
        registry.register_task("no")(type("No", (), {"schedule": 1, "formula": ""}))
    with pytest.raises(TypeError, match=r"has no schedule and no formula; see docs/tasks\.md"):
        registry.register_task("no")(dataclasses.make_dataclass("No", []))
    with pytest.raises(TypeError, match=r"has no formula; see docs/tasks\.md"):
        registry.register_task("no")(dataclasses.make_dataclass("No", [], namespace={"schedule": Foreign.schedule}))


@pytest.mark.parametrize(
    ("name", "task"),
    [("Duel", "duel"), ("PushHands", "push_hands"), ("VRPartner", "vr_partner"), ("Follow2Leaders", "follow2_leaders")],
)
def test_a_class_name_becomes_a_task_name(name, task):
    assert registry.snake_case(name) == task


def test_a_variable_may_name_a_module_whose_tasks_register_themselves(clean_registry, monkeypatch, tmp_path):
    (tmp_path / "stray_tasks.py").write_text(
        "from magnet.tasks import register_task\n"
        "from magnet.tasks.joint import JointFuture\n"
        "@register_task('stray')\n"
        "class Stray(JointFuture):\n"
        "    '''A stray task.'''\n"
    )
    (tmp_path / "no_tasks.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "stray_task.py").write_text("")  # begins as the other does
    monkeypatch.setenv(registry.VARIABLE, "stray_tasks,no_tasks,stray_task")
    registry.discover(again=True)
    assert {entry.name: entry.origin for entry in registry.entries()}["stray"] == "MAGNET_TASKS=stray_tasks"
    lost = {each.name: str(each.error) for each in registry.failures()}
    assert all("registers no task" in lost[name] for name in ("no_tasks", "stray_task"))


def test_a_variables_module_has_its_origin_on_all_that_came_with_it_imported_before_or_not(
    clean_registry, monkeypatch, tmp_path
):
    text = "from magnet.tasks import register_task\nfrom magnet.tasks.joint import JointFuture\n"
    (tmp_path / "part_tasks.py").write_text(f"{text}@register_task('part')\nclass Part(JointFuture):\n    pass\n")
    (tmp_path / "all_tasks.py").write_text(
        f"import part_tasks\n{text}@register_task('whole')\nclass Whole(JointFuture):\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(registry.VARIABLE, "all_tasks")
    registry.discover(again=True)
    origins = {entry.name: entry.origin for entry in registry.entries()}
    assert origins["whole"] == origins["part"] == "MAGNET_TASKS=all_tasks"
    registry.TASKS.add("whole", registry.get("whole"), "magnet")  # as an import before leaves it
    registry.discover(again=True)
    assert {entry.name: entry.origin for entry in registry.entries()}["whole"] == "MAGNET_TASKS=all_tasks"
    assert not registry.failures()


def test_a_variable_finds_a_module_in_the_working_directory(tmp_path):
    """As the installed command is started: Python itself does not look there."""
    (tmp_path / "wait_here.py").write_text(
        "import dataclasses\n"
        "from magnet.tasks.joint import JointFuture\n"
        "@dataclasses.dataclass(frozen=True)\n"
        "class WaitHere(JointFuture):\n"
        "    '''Wait.'''\n"
    )
    code = "from magnet.tasks import registry; print(registry.get('wait_here').__doc__)"
    said = {**os.environ, "PYTHONPATH": str(Path(magnet.__file__).parents[1]), registry.VARIABLE: "wait_here:WaitHere"}
    command = [sys.executable, "-P", "-c", code]  # -P: without the working directory
    done = subprocess.run(command, cwd=tmp_path, env=said, capture_output=True, text=True)
    assert done.stdout == "Wait.\n", done.stderr
