"""What a command resolves for a class is what the class says of itself, and what was given to it."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import operator
import re
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from lightning.pytorch.callbacks import ModelCheckpoint, OnExceptionCheckpoint

from magnet import cli
from magnet.cli import class_options
from magnet.cli.checkpoint_config import LINKS
from magnet.cli.config_files import Layer
from magnet.cli.main import TRAINER_COMMANDS
from magnet.tasks import registry as task_registry
from tests.cases import few, some_slow
from tests.options import DATA, MODELS, own, plain
from tests.toys import OtherData, ToyData, ToyModel

CPU = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")
TASKS = {entry.name: entry.kind for entry in task_registry.entries()}


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    capsys.readouterr()
    assert cli.main([*words, "--print_config"]) == 0
    return yaml.safe_load(capsys.readouterr().out)


def written(path: Path, **options: Any) -> str:
    path.write_text(yaml.safe_dump(options), encoding="utf-8")
    return str(path)


def spelt(kind: type) -> dict[str, Any]:
    """A class with every option, as `--print_config` writes it, each number otherwise than by default."""

    def other(value: Any) -> Any:
        return not value if isinstance(value, bool) else value + 1 if isinstance(value, int) else value

    return {"class_path": kind.__name__, "init_args": {name: other(value) for name, value in own(kind).items()}}


SPELT = spelt(DATA["Synthetic"])


def in_turn(names: Iterable[str], commands: Iterable[str], part: slice) -> list[Any]:
    """Every name with every command; quick ones are some names, each with one of the commands, in turn."""
    every = list(itertools.product(names, commands))
    quick = list(zip(names, itertools.cycle(commands)))[part]
    return some_slow(every, *(case for case in every if case not in quick))


# -- each class ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "command"), in_turn(DATA, TRAINER_COMMANDS, slice(0, None, 4)))
def test_models_and_data_named_by_a_flag_have_their_own_defaults(
    name: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    model = list(MODELS)[list(DATA).index(name) // len(TRAINER_COMMANDS) % len(MODELS)]
    linked = set(LINKS.values()) if command == "fit" else set()
    got = printed(capsys, command, "--model", model, "--data", name)
    assert got["data"]["init_args"] == own(DATA[name])
    assert got["model"]["init_args"] == {k: value for k, value in own(MODELS[model]).items() if k not in linked}


@pytest.mark.parametrize(("name", "named_by"), in_turn(DATA, ["file", "flag"], slice(1, None, 4)))
def test_data_named_by_a_file_or_a_flag_have_their_own_defaults_over_any_other_file(
    name: str, named_by: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    below = written(tmp_path / "below.yaml", model="Tokenizer", data=SPELT | {"class_path": "Synthetic"})
    given = {"class_path": name, "init_args": {"batch_size": 5}}
    above = written(tmp_path / "above.yaml", extends="below.yaml", data=given)
    flags = ("--config", below, "--data.batch_size", "5", f"--data={name}")
    got = printed(capsys, "fit", *(flags if named_by == "flag" else ("--config", above)))["data"]["init_args"]
    assert got == (SPELT["init_args"] if name == "Synthetic" else own(DATA[name])) | {"batch_size": 5}


def test_a_model_over_a_file_that_spells_the_other_out_has_its_own_defaults(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    below = written(tmp_path / "below.yaml", model=spelt(MODELS["Denoiser"]))
    assert printed(capsys, "validate", "--config", below, "--model", "Tokenizer")["model"]["init_args"] == own(
        MODELS["Tokenizer"]
    )


@pytest.mark.parametrize(("name", "command"), in_turn(TASKS, ["test", "predict"], slice(0, None, 3)))
def test_tasks_have_their_own_defaults(name: str, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    asked = printed(capsys, command, "--task", name)["task"]
    fields = {field.name: field for field in dataclasses.fields(TASKS[name]) if field.init}
    missing = dataclasses.MISSING
    expected = {
        key: field.default if field.default_factory is missing else field.default_factory()
        for key, field in fields.items()
    }
    assert asked == {"name": name, **plain(expected)}


@pytest.mark.slow
def test_every_data_set_inside_mixed_has_its_own_defaults_over_any_other_list(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inside = [name for name in DATA if "data" not in own(DATA[name])]
    parts = [{"class_path": name, "init_args": {"seed": 3}} for name in inside]
    mixed = {"class_path": "Mixed", "init_args": {"data": parts, "max_agents": 3}}
    below = SPELT | {"class_path": "Synthetic"}
    lower = {"class_path": "Mixed", "init_args": {"data": [below] * len(inside), "epoch_size": 9}}
    words = ("--config", written(tmp_path / "lower.yaml", model="Tokenizer", data=lower))
    more = ("--config", written(tmp_path / "mixed.yaml", data=mixed))
    flag, first = ("--data.data", json.dumps(parts[:3])), f"--data.data={json.dumps(parts[:1])}"
    for given, agents, count in ((more, 3, len(inside)), (flag, 2, 3), ((first,), 2, 1)):
        got = printed(capsys, "fit", *words, *given)["data"]["init_args"]
        found = [part["init_args"] for part in got.pop("data")]
        assert found == [own(DATA[name]) | {"seed": 3} for name in inside[:count]]
        rest = own(DATA["Mixed"]) | {"max_agents": agents, "epoch_size": 9}
        assert got == {key: value for key, value in rest.items() if key != "data"}


def test_callbacks_have_their_own_defaults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = "lightning.pytorch.callbacks."
    kept = {"class_path": f"{path}ModelCheckpoint", "init_args": {"filename": "abc", "dirpath": "there"}}
    other = {"class_path": f"{path}OnExceptionCheckpoint", "init_args": {"dirpath": "here"}}
    lower = written(tmp_path / "lower.yaml", model="Tokenizer", trainer={"callbacks": [kept]})
    upper = written(tmp_path / "upper.yaml", trainer={"callbacks": [other]})
    expected = own(OnExceptionCheckpoint, "lightning") | {"dirpath": "here"}
    for more in (("--config", upper), ("--trainer.callbacks", json.dumps([other]))):
        (callback,) = printed(capsys, "fit", "--config", lower, *more)["trainer"]["callbacks"]
        assert callback["init_args"] == expected
    (callback,) = printed(capsys, "fit", "--config", upper, "--config", lower)["trainer"]["callbacks"]
    assert callback["init_args"] == own(ModelCheckpoint, "lightning") | kept["init_args"]


PAGES = [Path(__file__).parents[2] / "README.md", *sorted(Path(__file__).parents[2].glob("docs/*.md"))]
COMMANDS = sorted(
    {
        line.partition("   #")[0].removesuffix("...").strip()
        for page in PAGES
        for line in re.findall(
            r"^ {4}magnet ((?:fit|validate|test|predict) .*--data (?!mydata\.).*)",  # a reader's own file
            page.read_text().replace("\\\n", " "),  # lines that a backslash continues
            re.MULTILINE,
        )
    }
)


@pytest.mark.parametrize("line", few(COMMANDS, 2))
def test_a_command_that_a_page_shows_for_a_data_set_runs_what_it_says(
    line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word for word in shlex.split(line) if word != "--full"]  # the one flag without a value
    given = dict(zip(words[1::2], words[2::2], strict=True))
    given.pop("--ckpt_path", None)  # of somebody's own run
    said = {name.removeprefix("--data."): value for name, value in given.items() if name.startswith("--data.")}
    got = printed(capsys, words[0], *(word for pair in given.items() for word in pair))["data"]
    expected = own(DATA[given["--data"]])
    for name, value in said.items():
        *groups, option = name.split(".")
        functools.reduce(operator.getitem, groups, expected)[option] = yaml.safe_load(value)
    assert got["init_args"] == expected


# -- what is given ---------------------------------------------------------------------------------


def data_of(*words: str) -> Any:
    assert cli.main([*words, *CPU]) == 0
    return ToyModel.seen["data"]


def test_what_a_file_gives_to_another_class_is_left_out_and_told(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = {"class_path": "OtherData", "init_args": {"root": "there", "takes": 9, "max_agents": 3}}
    file = written(toy / "other.yaml", model="ToyModel", data=other, trainer={"max_epochs": 1})
    data = data_of("fit", "--config", file, "--data", "ToyData", "--out", "one")
    assert (type(data), data.root, data.max_agents) == (ToyData, "nowhere", 2)
    assert f"data is ToyData: what {file} gives to OtherData is left out (max_agents, root, takes)" in (
        capsys.readouterr().err
    )
    data = data_of("fit", "--config", file, "--out", "two")
    assert (type(data), data.root, data.max_agents, data.takes) == (OtherData, "there", 3, 9)
    assert "left out" not in capsys.readouterr().err


def test_options_of_no_class_are_given_to_whichever_wins(toy: Path) -> None:
    base = written(
        toy / "base.yaml", model="ToyModel", data={"init_args": {"max_agents": 5}}, trainer={"max_epochs": 1}
    )
    for name, root in (("ToyData", "nowhere"), ("OtherData", "elsewhere")):
        named = written(toy / "named.yaml", extends="base.yaml", data=name)
        for number, words in enumerate((("--config", named), ("--config", base, "--data", name))):
            data = data_of("fit", *words, "--out", f"{name}{number}")
            assert (type(data).__name__, data.max_agents, data.root) == (name, 5, root)


def test_data_and_model_of_a_checkpoint_give_nothing_to_other_classes(toy: Path) -> None:
    words = ("--data", "OtherData", "--data.root", "here", "--data.max_agents", "3", "--model.lr", "0.25")
    data_of("fit", "--model", "ToyModel", *words, "--trainer.max_epochs", "1", "--out", "run")
    checkpoint = ("--ckpt_path", "run/checkpoints/last.ckpt")
    same = data_of("validate", *checkpoint, "--data", "tests.toys.OtherData")
    assert (same.root, same.max_agents, ToyModel.seen["model"].lr) == ("here", 3, 0.25)
    other = data_of("validate", *checkpoint, "--data", "ToyData")
    assert (other.root, other.max_agents, ToyModel.seen["model"].lr) == ("nowhere", 3, 0.25)  # slots are linked
    for named in ('{"class_path": "ToyData"}', '{"class_path": "ToyData", "init_args": {}}'):
        assert data_of("validate", *checkpoint, "--data", named).root == "nowhere"


def test_of_two_classes_the_last_flag_wins_and_the_first_leaves_nothing(toy: Path) -> None:
    words = ("--data", "OtherData", "--data.class_path=OtherData", "--data", "ToyData", "--trainer.max_epochs", "1")
    data = data_of("fit", "--model", "ToyModel", *words, "--out", "one")
    assert (type(data), data.root) == (ToyData, "nowhere")


# -- layers ----------------------------------------------------------------------------------------


def settled(layers: Sequence[dict[str, Any]], *flags: str) -> list[dict[str, Any]]:
    named = [Layer(f"{number}.yaml", options) for number, options in enumerate(layers)]
    return [layer.options for layer in class_options.settle(named, flags).layers]


A, B = {"class_path": "A", "init_args": {"x": 1}}, {"class_path": "B", "init_args": {"y": 2}}


def test_options_of_no_class_belong_to_the_class_below_them() -> None:
    loose = {"data": {"init_args": {"z": 3}}}
    assert settled([{"data": A}, loose, {"data": B}]) == [{}, {}, {"data": B}]
    assert settled([loose, {"data": A}, {"data": B}]) == [loose, {}, {"data": B}]
    assert settled([{"data": A}, loose]) == [{"data": A}, loose]
    assert settled([{"data": A}, loose], "--data", "B") == [{}, {}]


def test_layers_given_are_not_changed() -> None:
    given = Layer("a.yaml", {"data": {"class_path": "A", "init_args": {"x": [1]}}})
    class_options.settle([given, Layer("b.yaml", {"data": B})], ["--data.x", "[2]"])
    assert given.options == {"data": {"class_path": "A", "init_args": {"x": [1]}}}


def test_only_what_is_replaced_whole_is_taken_out() -> None:
    lower = {"trainer": {"logger": A, "max_steps": 5, "callbacks": [A]}, "sampler": {"guidance": {"kind": "self"}}}
    assert settled([lower, {"trainer": {"logger": B}}])[0] == {
        "trainer": {"max_steps": 5, "callbacks": [A]},
        "sampler": {"guidance": {"kind": "self"}},
    }
    assert settled([lower, {"trainer": {"max_steps": 6}, "sampler": {"guidance": {"weight": 1}}}])[0] == lower
    assert settled([lower], "--trainer.callbacks+", "B", "--trainer.logger", "some.A", "--trainer.max_steps", "7") == [
        lower
    ]
    assert settled([lower], "--trainer.logger=B")[0]["trainer"] == {"max_steps": 5, "callbacks": [A]}
    nested = {"data": {"class_path": "A", "init_args": {"data": [A]}}}
    bare = {"data": {"class_path": "A", "init_args": {}}}
    assert settled([nested], "--data.data", "[]") == settled([nested], "--data.init_args.data=[]") == [bare]
    assert settled([nested], "--data.data.x", "1") == [nested]


@pytest.mark.parametrize("path", ["--data.data", "--data.x.data", "--data.init_args.data"])
def test_a_flag_of_a_class_that_a_file_only_names_takes_nothing_out_of_the_file(path: str) -> None:
    assert settled([{"data": "Mixed"}], path, "[]") == [{"data": "Mixed"}]
