"""Configuration files that extend others, and samplers by name, from the command line."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import yaml

from magnet import cli
from magnet.cli import config_files, demo, train, view, view_shown
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from tests.cases import some_slow
from tests.toys import ToyEvaluator, ToyModel

CPU = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")
PAPER = SamplerOptions.preset("paper")


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    assert cli.main([*words, "--print_config"]) == 0
    return yaml.safe_load(capsys.readouterr().out)


def sampler(capsys: pytest.CaptureFixture[str], *words: str) -> SamplerOptions:
    """The sampler that a command line asks for."""
    fields = printed(capsys, *words)["sampler"]
    return SamplerOptions(**{**fields, "guidance": Guidance(**fields["guidance"])})


def complaint(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(words) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    return error


# -- samplers by name ----------------------------------------------------------------------------


@pytest.mark.parametrize("command", some_slow(["test", "predict"], "predict"))
def test_one_word_samples_as_the_paper_does(toy: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    assert sampler(capsys, command, "--sampler", "paper") == PAPER
    assert sampler(capsys, command, "--sampler=paper") == PAPER
    assert sampler(capsys, command) == SamplerOptions()


def test_fields_beat_the_preset_wherever_they_stand(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fifty = dataclasses.replace(PAPER, steps=50)
    assert sampler(capsys, "test", "--sampler", "paper", "--sampler.steps", "50") == fifty
    assert sampler(capsys, "test", "--sampler.steps", "50", "--sampler", "paper") == fifty
    told = sampler(capsys, "test", "--sampler", "paper", "--sampler.guidance.kind", "history")
    assert told == dataclasses.replace(PAPER, guidance=dataclasses.replace(PAPER.guidance, kind="history"))


def test_a_file_names_a_preset_too_and_a_flag_beats_it(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (toy / "word.yaml").write_text("sampler: paper\n")
    (toy / "more.yaml").write_text("sampler: {preset: paper, steps: 7, guidance: {kind: self}}\n")
    (toy / "less.yaml").write_text("sampler: {steps: 9}\n")
    assert sampler(capsys, "test", "--config", "word.yaml") == PAPER
    more = dataclasses.replace(PAPER, steps=7, guidance=dataclasses.replace(PAPER.guidance, kind="self"))
    assert sampler(capsys, "test", "--config", "more.yaml") == more
    assert sampler(capsys, "test", "--config", "word.yaml", "--config", "less.yaml").steps == 9
    assert sampler(capsys, "test", "--config", "less.yaml", "--sampler", "paper") == PAPER
    assert sampler(capsys, "test", "--config", "word.yaml", "--sampler.eta", "0.5").eta == 0.5


def test_what_is_printed_runs_again(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = printed(capsys, "test", "--sampler", "paper")
    (toy / "mine.yaml").write_text(yaml.safe_dump(first))
    assert printed(capsys, "test", "--config", "mine.yaml") == first


def test_a_preset_reaches_the_evaluator(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cli.main(["fit", "--model", "ToyModel", "--trainer.max_epochs", "1", "--out", "trained", *CPU]) == 0
    words = ("--ckpt_path", "trained/checkpoints/last.ckpt", "--sampler", "paper", "--sampler.steps", "3")
    monkeypatch.setattr(train, "TokenModel", ToyModel)
    monkeypatch.setattr(train, "Evaluator", ToyEvaluator)
    assert cli.main(["test", *words, *CPU]) == 0
    assert ToyModel.seen["evaluator"].sampler == dataclasses.replace(PAPER, steps=3)


@pytest.mark.parametrize("command", ["test", "predict", "demo", "view"])
def test_a_wrong_preset_suggests_the_closest(toy: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    words = [command, "--live"] if command == "view" else [command]
    assert cli.main([*words, "--sampler", "papr"]) == 2
    assert "no sampler preset papr; did you mean paper?" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["test", "predict", "predict a.bvh", "view --live", "score"])
@pytest.mark.parametrize("flag", ["--sampler.preset", "--sampler.name", "--preset"])
def test_a_preset_in_another_place_is_told_its_own(
    toy: Path, capsys: pytest.CaptureFixture[str], command: str, flag: str
) -> None:
    (toy / "a.bvh").touch()
    out = ("--out", "o.npz") if command == "predict a.bvh" else ()
    assert cli.main([*command.split(), flag, "paper", *out]) == 2
    said = f"no option {flag}; a preset is named by --sampler PRESET: default or steady or plain or "
    assert said in capsys.readouterr().err


def test_where_only_a_preset_is_taken_its_fields_lead_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["view", "--live", "--sampler.steps", "3"]) == 2
    said = capsys.readouterr().err
    assert "no option --sampler.steps; --sampler takes a preset's name here, and there is --steps." in said


def test_a_wrong_preset_in_a_file_suggests_the_closest(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (toy / "word.yaml").write_text("sampler: papers\n")
    said = "word.yaml: no sampler preset papers; did you mean paper? There are default, steady, "
    assert said in complaint(capsys, "test", "--config", "word.yaml")


def test_help_names_the_presets(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["test", "--help", "sampler"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "--sampler PRESET default or steady or plain or strides or paper, or a file" in said
    with pytest.raises(SystemExit):
        view.arguments_of(["--help"])
    assert "default or steady or plain or strides or paper" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), SamplerOptions(steps=10, apart="light")),
        (("--steps", "4"), SamplerOptions(steps=4, apart="light")),
        (("--sampler", "paper"), PAPER),
        (("--sampler", "paper", "--steps", "4"), dataclasses.replace(PAPER, steps=4)),
    ],
)
def test_the_viewer_samples_as_it_is_told(words: tuple[str, ...], expected: SamplerOptions) -> None:
    assert view_shown.sampler_options(view.arguments_of(["--live", *words])) == expected


def test_the_demo_takes_a_preset_and_its_steps() -> None:
    assert demo.parser().parse_args(["--sampler", "paper"]).sampler == "paper"
    assert demo.parser().parse_args([]).steps is None


# -- files that extend others --------------------------------------------------------------------


def test_a_file_states_only_what_differs_from_those_it_extends(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (toy / "parts").mkdir()
    (toy / "parts" / "base.yaml").write_text(
        "model: {class_path: ToyModel, init_args: {lr: 0.5}}\ntrainer: {max_steps: 3}\n"
    )
    (toy / "parts" / "data.yaml").write_text("data: {class_path: OtherData, init_args: {takes: 4}}\n")
    (toy / "mine.yaml").write_text(
        "extends: [parts/base.yaml, parts/data.yaml]\nmodel: {init_args: {lr: 0.25}}\ndata: {init_args: {root: here}}\n"
    )
    (toy / "again.yaml").write_text("extends: mine.yaml\ntrainer: {max_steps: 5}\n")
    got = printed(capsys, "fit", "--config", "again.yaml")
    assert got["model"]["init_args"]["lr"] == 0.25
    assert (got["data"]["init_args"]["takes"], got["data"]["init_args"]["root"]) == (4, "here")
    assert got["trainer"]["max_steps"] == 5
    assert printed(capsys, "fit", "--config", "again.yaml", "--model.lr", "2")["model"]["init_args"]["lr"] == 2
    named = config_files.read_layers("again.yaml")
    assert [Path(layer.path).name for layer in named] == ["base.yaml", "data.yaml", "mine.yaml", "again.yaml"]


def test_a_run_is_called_after_the_file_that_was_named(toy: Path) -> None:
    (toy / "base.yaml").write_text("model: {class_path: ToyModel}\n")
    (toy / "mine.yaml").write_text("extends: base.yaml\ntrainer: {max_epochs: 1}\n")
    assert cli.main(["fit", "--config", "mine.yaml", *CPU]) == 0
    assert (toy / "runs" / "mine" / "latest" / "checkpoints" / "last.ckpt").exists()


def test_the_class_in_an_extended_file_counts_for_a_checkpoints_defaults(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        cli.main(["fit", "--model", "ToyModel", "--model.lr", "0.3", "--trainer.max_epochs", "1", "--out", "t", *CPU])
        == 0
    )
    (toy / "base.yaml").write_text("ckpt_path: t/checkpoints/last.ckpt\n")
    (toy / "mine.yaml").write_text("extends: base.yaml\n")
    capsys.readouterr()
    assert printed(capsys, "test", "--config", "mine.yaml")["model"]["init_args"]["lr"] == 0.3


def test_files_that_cannot_be_extended_are_told(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (toy / "one.yaml").write_text("extends: two.yaml\n")
    (toy / "two.yaml").write_text("extends: one.yaml\n")
    (toy / "gone.yaml").write_text("extends: nosuch.yaml\n")
    (toy / "odd.yaml").write_text("extends: {a: 1}\n")
    assert "extends itself, by way of one.yaml and two.yaml" in complaint(capsys, "fit", "--config", "one.yaml")
    assert "no configuration file nosuch.yaml" in complaint(capsys, "fit", "--config", "gone.yaml")
    assert complaint(capsys, "fit", "--config", "oddd.yaml").endswith("oddd.yaml; did you mean odd.yaml?\n")
    assert "configs/ is in a clone of the repository" in complaint(capsys, "fit", "--config", "configs/finetune.yaml")
    assert "expected a file or a list of files" in complaint(capsys, "fit", "--config", "odd.yaml")
    Path("number.yaml").write_text("model: {class_path: 3}", encoding="utf-8")
    said = complaint(capsys, "fit", "--config", "number.yaml")
    assert "number.yaml: model.class_path is 3, expected the name of a class" in said
    Path("word.yaml").write_text("data: {class_path: Mixed, init_args: {data: [{init_args: a}]}}", encoding="utf-8")
    said = complaint(capsys, "fit", "--config", "word.yaml")
    assert "word.yaml: data.init_args.data[0].init_args is 'a', expected options such as" in said


FORMS = {
    "a name": "task: agentic_async",
    "a name and options": "task: {name: agentic_async, offset: 0.25}",
    "as it was written before": "task: {class_path: magnet.cli_tasks.aliases.agentic_async, init_args: {offset: 0.25}}",
}


@pytest.mark.parametrize("form", some_slow(FORMS, "a name"))
def test_a_file_names_its_task_in_any_of_these_forms(toy: Path, capsys: pytest.CaptureFixture[str], form: str) -> None:
    """Flags beat it option by option, and another task leaves its options out and says so."""
    (toy / "mine.yaml").write_text(FORMS[form] + "\n")
    task = printed(capsys, "test", "--config", "mine.yaml", "--task.block", "3")["task"]
    assert (task["name"], task["block"]) == ("agentic_async", 3)
    assert task["offset"] == (1.0 if form == "a name" else 0.25)
    assert printed(capsys, "test", "--config", "mine.yaml", "--task.offset=0.5")["task"]["offset"] == 0.5
    assert cli.main(["test", "--config", "mine.yaml", "--task", "generation", "--print_config"]) == 0
    out, notes = capsys.readouterr()
    assert yaml.safe_load(out)["task"] == {"name": "generation"}
    assert ("left out (offset)" in notes) == (form != "a name")
