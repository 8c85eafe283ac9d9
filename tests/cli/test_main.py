"""The command line: what is answered without a model, and what errors say."""

from __future__ import annotations

import contextlib
import importlib
import re
import signal
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from magnet import __version__, cli
from magnet.cli import data, export, refine, report
from magnet.cli.errors import CommandError
from magnet.cli.main import COMMANDS, TRAINER_COMMANDS, underscored, usage
from magnet.datamodules import registry
from magnet.extras import installing
from magnet.testing import random_scene
from tests import toys
from tests.cases import few, some_slow

ROOT = Path(__file__).parents[2]
HEAVY = ("torch", "lightning", "numpy", "jsonargparse", "rich", "matplotlib")


def loaded_by(*arguments: str) -> tuple[str, set[str]]:
    """What a command prints, and which modules it imports, in a process of its own."""
    code = f"import sys; from magnet.cli import main; main({list(arguments)!r}); print('\\n#', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    text, _, modules = done.stdout.rpartition("\n# ")
    return text, set(modules.split())


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Standard error of a command that must end with exit code 2 and no traceback."""
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


@pytest.mark.parametrize("arguments", [("--help",), ("--version",), ()])
def test_help_and_version_import_nothing_heavy(arguments: tuple[str, ...]) -> None:
    text, modules = loaded_by(*arguments)
    assert __version__ in text
    assert not modules & set(HEAVY)
    assert len(modules) < 200


def test_help_names_every_command() -> None:
    assert all(f"  {name} " in usage() for name in COMMANDS)


@pytest.mark.parametrize(
    "words",
    [("demo", "--sample", "3"), ("export", "a.npz", "b.glb", "--sce", "0"), ("view", "a.npz", "--ht", "x.html")],
)
def test_options_are_written_out(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert f"no option {words[-2]}" in complaint(capsys, *words)


@pytest.mark.parametrize(
    ("parser", "words"),
    [
        (export.parser, "in.npz out.glb --rig a b --rig c"),
        (refine.parser, "in.npz out.npz --shapes a b --shapes c"),
        (report.parser, "4 --only a b --only c"),
        (report.parser, "4 --skip a b --skip c"),
        (lambda: data.command_parser("prepare"), "--bodies a b --bodies c"),
    ],
)
def test_options_of_several_values_may_be_repeated(parser: Callable[[], ArgumentParser], words: str) -> None:
    """As those of one value; argparse would forget all but the last."""
    given = parser().parse_intermixed_args(words.split())
    assert getattr(given, words.rpartition(" --")[2].split()[0]) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("demo --mintes 3", "--minute"),
        ("export a.npz b.glb --scnes 0", "--scene"),
        ("refine a.npz b.npz --tirm", "--trim"),
        ("predict a.npz --seconds 10 --out b.glb", "--frames"),
        ("test --checkpoint last", "--ckpt_path"),
    ],
)
def test_a_flag_that_is_not_there_is_answered_with_what_may_be_meant(
    words: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    said = complaint(capsys, *words.split())
    assert f"did you mean {meant}" in said and said.count("\n") <= 1


def test_importing_magnet_imports_nothing_heavy() -> None:
    code = "import sys, magnet; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert not set(done.stdout.split()) & set(HEAVY)


def test_python_m_magnet_is_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "magnet", "--version"], capture_output=True, text=True, timeout=60)
    assert done.stdout == f"magnet {__version__}\n"
    done = subprocess.run([sys.executable, "-m", "magnet", "tset"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "did you mean test?" in done.stderr


def test_a_warning_is_a_line_without_the_code_that_it_came_from(tmp_path: Path) -> None:
    scene = random_scene(1, 8, 2, torch.Generator().manual_seed(0))
    scene.replace(valid=torch.arange(8)[None] != 3).save(tmp_path / "lost.npz")
    words = [sys.executable, "-m", "magnet", "export", str(tmp_path / "lost.npz"), str(tmp_path / "lost.glb")]
    for debug in (False, True):
        done = subprocess.run(words + ["--debug"] * debug, capture_output=True, text=True, timeout=120, check=True)
        assert ("UserWarning" in done.stderr) == debug
        assert done.stderr.startswith("magnet: warning: lost.glb: 1 of 8 frames, frame 3 first") != debug


def test_tasks_are_listed_with_what_they_sample(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tasks"]) == 0
    text = capsys.readouterr().out
    assert "joint_future" in text
    assert "P(A" in text


def test_fit_help_explains_every_field(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fit", "--help", "all"]) == 0
    text = capsys.readouterr().out
    for field, meaning in {"--model.lr": "step size", "--data.takes": "how many", "--out": "folder of the run"}.items():
        assert field in text
        assert meaning in text


def test_test_help_explains_sampling(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["test", "--help"]) == 0
    assert "--samples" in capsys.readouterr().out
    assert cli.main(["test", "--help", "sampler"]) == 0
    assert "--sampler.steps" in capsys.readouterr().out
    assert cli.main(["test", "--help=task"]) == 0
    assert "--task joint_future: " in capsys.readouterr().out
    assert cli.main(["test", "--help", "OtherData"]) == 0
    assert re.findall(r"--data\.(\w+) ", capsys.readouterr().out) == ["root", "takes", "window_frames", "max_agents"]


@pytest.mark.parametrize("command", some_slow(TRAINER_COMMANDS, "validate", "predict", "fit"))
def test_help_is_by_topic_and_no_topic_takes_three_hundred_lines(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    """Every field is told in some topic, or in that of its class; together they tell what `--help all` tells."""

    def told(*topic: str) -> str:
        assert cli.main([command, "--help", *topic]) == 0
        return capsys.readouterr().out

    first = told()
    topics = re.findall(rf"^  magnet {command} --help ([a-z]+) ", first, re.MULTILINE)
    assert {"model", "data", "trainer", "all"} <= set(topics)
    assert {"task", "sampler"} <= set(topics) or command in ("fit", "validate")
    texts = [first, *(told(topic) for topic in topics if topic != "all")]
    assert max(len(text.splitlines()) for text in texts) < 300
    names = [*registry.classes(), "Denoiser", "Tokenizer"]
    fields = set(re.findall(r"^ +(--[\w.]+)", "".join([*texts, *map(told, names)]), re.MULTILINE))
    everything = told("all")
    assert set(re.findall(r"^ +(--[\w.]+)", everything, re.MULTILINE)) <= fields
    words = " ".join(everything.split())
    silent = re.findall(r" (--(?:model|data|task|sampler)\.[\w.]+) \S+ \(type:", words)
    assert not silent, "each field is told in words, not by its type alone"


@pytest.mark.parametrize(
    ("arguments", "message"),
    few(
        [
            (["fti"], "did you mean fit?"),
            (["xyzzy"], "there are fit, validate"),
            (["test", "--help", "modle"], "no help topic modle; did you mean model?"),
            (["test", "--task", "joint_futur"], "did you mean joint_future?"),
            (["test", "--task=nothing_like_it"], "There are "),
            (["fit"], "say which model: --model ToyModel"),
            (["fit", "--model", "Nosuch"], "no model Nosuch; there are ToyModel"),
            (["fit", "--model", "ToyModel", "--lr", "1"], "no option --lr; did you mean --model.lr?"),
            (["fit", "--model", "ToyModel", "--model.lrr", "1"], "no option --model.lrr; did you mean --model.lr?"),
            (["fit", "--model", "ToyModel", "--data.max_agents", "two"], "got two, expected a whole number"),
            (["test", "generation"], "got generation, expected an option; did you mean --task generation?"),
            (["test", "."], "got ., expected an option; options are written --NAME VALUE"),
            (["fit", "--model", "ToyModel", "--data.", "1"], "no option --data.; the name of a field belongs behind"),
            (["fit", "--model", "."], "no model .; there are ToyModel"),
            (
                ["fit", "--model", "ToyModel", "--data.takes", "1"],
                "no option --data.takes of this data; it belongs to another: --data OtherData",
            ),
            (
                ["fit", "--model", "ToyModel", "--data.root.x", "1"],
                "no option --data.root.x; --data.root takes a value",
            ),
            (["test", "--data.test.max_scenes", "2"], "no option --data.test.max_scenes"),
            (["test", "2"], "options are written --NAME VALUE"),
            (
                ["predict", "--task", "joint_future", "--out", "o.glb", "A.bvh"],
                "files to go on from stand before --out",
            ),
            (["test", "--out", __file__], "got a file, expected a folder"),
            (["test", "--frames", "9"], "did you mean --data.window_frames?"),
            (["predict", "--peopel", "2"], "no option --peopel; did you mean --people?"),
            (["test", "--sampler.step", "4"], "no option --sampler.step; did you mean --sampler.steps?"),
            (["test", "--trainer.max_epoch", "4"], "no option --trainer.max_epoch; did you mean --trainer.max_epochs?"),
            (["fit", "--model", "ToyModel", "--data.root"], "--data.root: got nothing, expected a value"),
            (
                ["fit", "--model", "ToyModel", "--trainer.callbacks", "x"],
                "no callback x; there are magnet.callbacks.NarrowCodes, ",
            ),
            (["predict", "--picture", "avi"], "--picture: got avi, expected mp4, gif, webp, none"),
            (
                ["test", "--sampler.pyramid_offset", "four"],
                "--sampler.pyramid_offset: got four, expected a whole number or null",
            ),
            (
                ["test", "--task", "inbetweening", "--task.keys", "20,30"],
                "--task.keys: got 20,30, expected a list such as [0,1]",
            ),
            (["fit", "--model", "ToyModel", "--data.window_frames", "63"], "63, which is not a multiple of 4"),
            (["fit", "--model", "ToyModel", "--model.max_agents", "3"], "set --data.max_agents"),
            (["fit", "--config", "nosuch.yaml"], "no configuration file nosuch.yaml"),
            (["fit", "--model", "ToyModel", "--ckpt_path", "last"], "no run with a checkpoints/last.ckpt"),
            (["test", "--ckpt_path"], "--ckpt_path: got nothing, expected a value"),
            (["test", "--ckpt_path", "nosuch.ckpt"], "no checkpoint nosuch.ckpt"),
        ],
        12,
    ),
)
def test_a_mistake_is_answered_by_what_would_be_right(
    toy: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    said = complaint(capsys, *arguments)
    assert message in said and len(said.splitlines()) == 1
    command = f"magnet {arguments[0]}" if arguments[0] in COMMANDS else "magnet"
    assert said.startswith(f"{command}: error: ")
    assert not (toy / "runs").exists()


def test_options_that_a_class_refuses_are_told_in_its_own_words(
    toy: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: object, *_: object) -> None:
        raise ValueError("takes: got 0, expected at least 1")

    monkeypatch.setattr(toys.LightningDataModule, "__init__", refuse)
    error = complaint(capsys, "fit", "--model", "ToyModel", "--trainer.accelerator", "cpu")
    assert "magnet fit: error: takes: got 0, expected at least 1 (" in error and "subtypes" not in error


def test_a_denoiser_without_a_tokenizer_is_refused_before_anything_is_written(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = complaint(capsys, "fit", "--model", "magnet.denoiser.module.Denoiser", "--trainer.accelerator", "cpu")
    assert "has no tokenizer" in error
    assert not (toy / "runs").exists()


def test_a_config_that_is_no_mapping_is_refused(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (toy / "list.yaml").write_text("- 1\n")
    (toy / "broken.yaml").write_text("model: [\n")
    assert "list.yaml holds list" in complaint(capsys, "fit", "--config", "list.yaml")
    assert "broken.yaml is no YAML" in complaint(capsys, "fit", "--config", "broken.yaml")


class Bomb:
    """Writes a file when it is unpickled."""

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.write_text, (Path("exploded"), "boom"))


def test_a_bad_checkpoint_is_refused_in_a_line(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save({"weights": torch.ones(1)}, toy / "none.ckpt")
    torch.save({"state_dict": {}, "bomb": Bomb()}, toy / "bomb.ckpt")
    (toy / "text.ckpt").write_text("hello")
    (toy / "short.ckpt").write_bytes((toy / "none.ckpt").read_bytes()[:200])
    assert "a bare state_dict" in complaint(capsys, "test", "--ckpt_path", "none.ckpt")
    assert "could run code" in complaint(capsys, "test", "--ckpt_path", "bomb.ckpt")
    assert not (toy / "exploded").exists()
    for name in ("text.ckpt", "short.ckpt"):
        error = complaint(capsys, "test", "--ckpt_path", name)
        assert f"{name}: not a checkpoint" in error
        assert len(error.splitlines()) == 1


def test_a_class_from_nowhere_is_not_imported_for_a_checkpoint(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (toy / "stranger.py").write_text("from pathlib import Path\nPath('exploded').touch()\n")
    config = {"model": {"class_path": "stranger.Model", "init_args": {}}, "data": None}
    torch.save({"state_dict": {}, "magnet_config": config}, toy / "a.ckpt")
    assert "stranger.Model, which is not part of magnet" in complaint(capsys, "test", "--ckpt_path", "a.ckpt")
    assert not (toy / "exploded").exists()


def test_a_missing_wandb_names_the_install(
    toy: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magnet.cli.run_logs.find_spec", lambda name: None)
    error = complaint(capsys, "fit", "--model", "ToyModel", "--wandb", "offline")
    assert installing("wandb") in error


def test_debug_shows_the_traceback(toy: Path) -> None:
    with pytest.raises(CommandError):
        cli.main(["test", "--debug", "--ckpt_path", "nosuch.ckpt"])


def test_our_own_faults_are_not_hidden(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: object) -> None:
        raise AttributeError("a bug")

    monkeypatch.setattr(toys.ToyModel, "on_fit_start", broken)
    with pytest.raises(AttributeError, match="a bug"):
        cli.main(["fit", "--model", "ToyModel", "--trainer.accelerator", "cpu"])


@pytest.mark.parametrize("page", sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]), ids=lambda page: page.name)
def test_every_training_that_a_page_names_says_what_is_trained(page: Path) -> None:
    for line in re.findall(r"^ {4}(magnet fit .*)", page.read_text(encoding="utf-8"), re.MULTILINE):
        assert "--config" in line or "--model " in line, line


def test_flags_are_written_in_one_style_and_read_in_two(capsys: pytest.CaptureFixture[str]) -> None:
    for command in COMMANDS:
        with contextlib.suppress(SystemExit):
            cli.main([command, "--help"])
    assert not re.findall(r"--[a-z]+-[a-z]+", capsys.readouterr().out)
    for words in (["--out", "a-b"], ["--ckpt-path=runs/a-b.ckpt"], ["--task", "in-betweening"], ["-x-y"], ["---"]):
        flag, *values = words
        assert [underscored(word) for word in words] == [flag.replace("ckpt-path", "ckpt_path"), *values]


@pytest.mark.parametrize("command", ["test", "demo"])
def test_sigterm_ends_a_command_at_once(command: str) -> None:
    code = (
        "import importlib, os, signal, sys, time\n"
        "m = importlib.import_module('magnet.cli.main')\n"
        "def run(command, arguments):\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    time.sleep(20)\n"
        "    return 0\n"
        f"m.run = run; sys.exit(m.main([{command!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], timeout=15, check=False)
    assert done.returncode == 128 + signal.SIGTERM


def test_a_training_is_left_to_save_its_checkpoint_and_handlers_are_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    before, seen = signal.getsignal(signal.SIGTERM), []
    monkeypatch.setattr(
        importlib.import_module("magnet.cli.main"), "run", lambda *_: seen.append(signal.getsignal(signal.SIGTERM)) or 0
    )
    assert [cli.main(["fit"]), cli.main(["test"])] == [0, 0]
    assert seen[0] is before
    assert seen[1] is not before
    assert signal.getsignal(signal.SIGTERM) is before
