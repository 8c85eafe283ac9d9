"""`magnet tasks` and `magnet tasks show`."""

from __future__ import annotations

import dataclasses
import inspect
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import pytest
from PIL import Image

from magnet import __version__, cli
from magnet.cli.bench import task_options
from magnet.cli.tasks import parse_task
from magnet.plugins import Failed, Registered
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks import registry


@dataclass(frozen=True)
class Foreign:
    """Somebody else's task.

    Args:
        keep: how many more tokens are given.
    """

    formula: ClassVar[str] = "P(everything | [a little])"
    keep: int = 1
    who: tuple[int, ...] = field(default_factory=lambda: (0, 1))

    def schedule(self, grid: Grid) -> MaskSchedule:
        known = grid.past()
        known[: grid.context + self.keep] = True
        return MaskSchedule.full_sequence(known, ~known, grid)


@dataclass(frozen=True)
class Beat:
    """When poses are given: token steps between beats, and before the first."""

    every: int = 4
    first: int = 0


@dataclass(frozen=True)
class OnBeats:
    """Fill in what lies between beats.

    Args:
        beat: when poses are given.
    """

    formula: ClassVar[str] = "P(everything | beats)"
    beat: Beat = field(default_factory=Beat)

    def schedule(self, grid: Grid) -> MaskSchedule:
        known = grid.past()
        known[self.beat.first :: self.beat.every] = True
        return MaskSchedule.full_sequence(known, ~known, grid)


@pytest.fixture
def on_beats(monkeypatch: pytest.MonkeyPatch) -> None:
    registry.discover()
    monkeypatch.setitem(registry.TASKS.known, "on_beats", Registered("on_beats", OnBeats, "strange-tasks 3.1"))


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> None:
    registry.discover()
    entry = Registered("foreign", Foreign, "strange-tasks 3.1")
    monkeypatch.setitem(registry.TASKS.known, "foreign", entry)
    lost = Failed("broken", ImportError("no module named [nowhere]"), "strange-tasks 3.1")
    monkeypatch.setattr(registry.TASKS, "failed", [lost])


def no_grid(self) -> MaskSchedule:
    raise AssertionError("never called with a grid")


def nothing(self, grid: Grid) -> None:
    grid.past()


def failing(self, grid: Grid) -> MaskSchedule:
    raise KeyError("theirs")


def refusing(self, grid: Grid) -> MaskSchedule:
    raise ValueError("give it a hundred people")


FAULTS = {
    no_grid: r"task odd: schedule\(grid\) fails: TypeError: .*takes 1 positional argument but 2 were given; see docs",
    nothing: r"task odd: schedule\(grid\) gave None, expected a MaskSchedule; see docs/tasks.md",
    failing: r"task odd: schedule\(grid\) fails: KeyError: 'theirs'; see docs/tasks.md",
}


def odd(monkeypatch: pytest.MonkeyPatch, schedule: Callable[..., object]) -> None:
    """Make a task known that plans so."""
    kind = dataclasses.make_dataclass("Odd", [], namespace={"schedule": schedule, "formula": "P(odd)"}, frozen=True)
    monkeypatch.setitem(registry.TASKS.known, "odd", Registered("odd", kind, "strange-tasks 3.1"))


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert cli.main(["tasks", *arguments]) == 0
    return capsys.readouterr().out


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert cli.main(["tasks", *arguments]) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


def test_the_list_names_formula_origin_version_and_fields(capsys: pytest.CaptureFixture[str], foreign: None) -> None:
    text = printed(capsys)
    for entry in registry.entries():
        assert entry.name in text
        assert entry.kind.formula in text
    assert f"joint_future  magnet {__version__}" in text
    assert "foreign  strange-tasks 3.1" in text
    assert "--task.keep 1  --task.who [0,1]" in text
    assert "--task.offset 1.0" in text


def test_failures_stand_at_the_end_with_their_packages_and_errors(
    capsys: pytest.CaptureFixture[str], foreign: None
) -> None:
    text = printed(capsys)
    assert text.index("broken  failed to load  strange-tasks 3.1") > text.index("partner_prediction")
    assert "ImportError: no module named [nowhere]" in text


@pytest.mark.parametrize("name", registry.names())
def test_show_prints_the_formula_and_how_to_get_a_picture(capsys: pytest.CaptureFixture[str], name: str) -> None:
    text = printed(capsys, "show", name, "--moments", "5")
    assert registry.get(name).formula in text
    assert f"--out {name}.png" in text
    assert " 9 " in text


@pytest.mark.parametrize(("schedule", "said"), FAULTS.items())
def test_a_task_whose_plan_fails_is_marked_and_named_in_a_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, schedule: Callable[..., object], said: str
) -> None:
    odd(monkeypatch, schedule)
    listed = " ".join(printed(capsys).split())
    assert re.search(f"odd strange-tasks 3.1 P\\(odd\\) .*cannot be sampled: {said}", listed)
    assert listed.count("cannot be sampled") == 1
    assert re.fullmatch(f"magnet tasks: error: {said}.*\n", complaint(capsys, "show", "odd"))
    assert cli.main(["predict", "--task", "odd", "--people", "2", "--frames", "8", "--out", "new.npz"]) == 2
    assert re.fullmatch(f"magnet predict: error: {said}.*\n", capsys.readouterr().err)


def test_a_task_that_only_refuses_the_grid_is_not_marked(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    odd(monkeypatch, refusing)
    assert "cannot be sampled" not in printed(capsys)
    assert "give it a hundred people" in complaint(capsys, "show", "odd")


def test_show_writes_a_picture(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "new" / "plan.png"
    text = printed(capsys, "show", "agentic_async", "--out", str(out), "--people", "3", "--task.offset", "0.5")
    assert text.strip() == str(out)
    with Image.open(out) as image:
        assert min(image.size) > 400
        assert len(image.convert("RGB").getcolors(100_000)) > 20


def test_fields_change_the_plan(capsys: pytest.CaptureFixture[str], foreign: None) -> None:
    first = printed(capsys, "show", "agentic_async", "--task.order=[1]")
    assert first != printed(capsys, "show", "agentic_async")
    assert "o 9 9 ." in printed(capsys, "show", "agentic_async", "--turn", "2")  # as `duet` takes turns
    assert "o o o o o o 9" in printed(capsys, "show", "foreign", "--task.keep", "2", "--window", "16")


def test_a_task_gets_its_own_dataclass_from_flags_and_files(capsys: pytest.CaptureFixture[str], on_beats: None) -> None:
    assert "--task.beat.every 4  --task.beat.first 0" in printed(capsys)
    first = printed(capsys, "show", "on_beats")
    assert first != printed(capsys, "show", "on_beats", "--task.beat.every", "3")
    assert "did you mean --task.beat.every?" in complaint(capsys, "show", "on_beats", "--task.beat.evry", "3")
    choice = parse_task("on_beats", ["--task.beat.first", "2"], [{"beat": {"every": 3}}])
    assert choice.task == OnBeats(Beat(every=3, first=2))
    assert choice.spec == {"name": "on_beats", "beat": {"every": 3, "first": 2}}
    file_alone = parse_task("on_beats", [], [{"beat": {"every": 3}}])
    assert file_alone.spec["beat"] == {"every": 3, "first": 0}  # what the file leaves out stays as it is


def test_bench_takes_options_of_a_dataclass_in_a_task(on_beats: None) -> None:
    asked = task_options({"beat.every": ["--task.beat.every", "3"]}, ["on_beats", "joint_future"])
    assert asked == {"on_beats": {"beat": Beat(every=3)}, "joint_future": {}}


def test_show_help_explains_sizes_and_fields(capsys: pytest.CaptureFixture[str], foreign: None) -> None:
    text = printed(capsys, "show", "foreign", "--help")
    assert "how many more tokens are given" in text
    assert "--people" in text
    assert "--out" in printed(capsys, "show", "--help")


@pytest.mark.parametrize("command", ["test", "predict"])
def test_help_of_a_command_explains_every_field_of_every_task(capsys: pytest.CaptureFixture[str], command: str) -> None:
    assert cli.main([command, "--help", "task"]) == 0
    text = capsys.readouterr().out
    sections = dict(re.findall(r"^--task (\w+): (.*?)(?=^--task |\Z)", text, re.MULTILINE | re.DOTALL))
    assert list(sections) == registry.names()
    for entry in registry.entries():
        section = " ".join(sections[entry.name].split())
        names = [each.name for each in dataclasses.fields(entry.kind)]
        assert re.findall(r"--task\.(\w+) ", section) == names
        explained = " ".join((inspect.getdoc(entry.kind) or "").split())
        for name in names:
            found = re.search(rf"\b{name}: (.*?)(?: \w+: |$)", explained)
            assert found
            assert found[1].rstrip(".") in section
        assert ("(no fields)" in section) == (not names)
        assert "as above" not in section


def test_help_names_tasks_and_not_what_stands_for_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["test", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert f"--task NAME: One of {', '.join(registry.names())}; default: joint_future." in text
    for internal in ("NamedTask", "cli.tasks", "stands for", "class_path"):
        assert internal not in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["shwo"], "magnet tasks show NAME"),
        (["list", "all"], "magnet tasks show NAME"),
        (["show"], "there are agentic_async"),
        (["show", "joint_futur"], "did you mean joint_future?"),
        (["show", "agentic_async", "--task.ofset", "1"], "no option --task.ofset; did you mean --task.offset?"),
        (["show", "agentic_async", "--poeple", "3"], "no option --poeple; did you mean --people?"),
        (["show", "agentic_async", "--task.offset", "half"], "--task.offset: got half, expected a number"),
        (["show", "agentic_async", "--task.offset", "2"], "expected 0 to 1"),
        (["show", "partner_inpainting", "--people", "1"], "there is one person alone, and somebody has to be given"),
        (["show", "joint_future", "--context", "0"], "give it context frames"),
        (["show", "joint_future", "--tokens", "0"], "tokens: got 0, expected at least 1"),
        (["show", "joint_future", "--moments", "1"], "4 or more"),
        (["show", "joint_future", "--out", "plan.svg"], "written as .png"),
    ],
)
def test_a_mistake_is_answered_by_what_would_be_right(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert message in complaint(capsys, *arguments)


@pytest.mark.parametrize("command", ["test --task needy", "tasks show needy", "bench --task needy --quick"])
def test_an_option_that_a_task_needs_is_named_as_users_write_it(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fields = [("whom", int), ("at", int)]
    needy = dataclasses.make_dataclass("Needy", fields, bases=(Foreign,), frozen=True, kw_only=True)
    registry.discover()
    monkeypatch.setitem(registry.TASKS.known, "needy", Registered("needy", needy, "strange-tasks 3.1"))
    assert cli.main([*command.split(), "--task.at", "1"]) == 2
    assert "the task needs --task.whom; see magnet " in capsys.readouterr().err


@pytest.mark.slow
def test_show_imports_no_lightning() -> None:
    code = (
        "import sys; from magnet.cli import main; main(['tasks', 'show', 'joint_future']); "
        "print('\\n#', *(m for m in ('lightning', 'magnet.denoiser.module', 'matplotlib') if m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1].strip() == "#"


def test_a_wrong_flag_is_named_whatever_the_checkpoint_remembers(capsys):
    """The options of the shipped model are longer than any path may be."""
    from magnet import cli

    assert cli.main(["test", "--taks", "joint_future"]) == 2
    said = capsys.readouterr().err
    assert "no option --taks" in said and "--task" in said
