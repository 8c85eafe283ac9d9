"""Help, lists and mistyped flags: answered without importing Torch or Lightning, and with the same words."""

from __future__ import annotations

import inspect
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import pytest

from magnet.cli import answers, doctor, flags
from magnet.cli.errors import explain
from magnet.cli.main import LIGHT_COMMANDS, TRAINER_COMMANDS
from magnet.datamodules.preparing.fit_cache import cache_folder

HEAVY = {"torch", "lightning", "jsonargparse", "numpy"}
RUN = "import sys; from magnet.cli import main; code = main(sys.argv[1:]); print('\\n#', code, *sys.modules)"
ASKED = [[command, "--help"] for command in {**TRAINER_COMMANDS, **LIGHT_COMMANDS}] + [
    ["tasks"],
    ["data", "list"],
    ["data", "prepare", "--help"],
    ["tasks", "show", "--help"],
    ["test", "--help", "sampler"],
    ["test", "--tsak", "joint_future"],
    ["fit", "--model", "Denoiser", "--model.widht", "3"],
    ["predict", "--data.max_agent", "2"],
    ["fit", "--data.pth", "x"],
    ["fit", "--trainer.max_step", "3"],
    ["fit", "--trainer.gradient_clip_val", "abc"],
    ["test", "--sampler.requantize", "maybe"],
]
COMPARED = [["test", "--help"], ["tasks"], ["data", "list"], ["test", "--tsak", "joint_future"], ASKED[-2]]
"""Those that are also asked with nothing kept, which takes seconds each."""


def answered(words: list[str], cache: Path) -> tuple[str, str, str, set[str]]:
    """What a command prints, what it complains of, its exit code, and the modules that it imports."""
    place = {"XDG_CACHE_HOME": str(cache), "COLUMNS": "90", "PATH": "/usr/bin:/bin", "PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run([sys.executable, "-c", RUN, *words], capture_output=True, text=True, env=place, timeout=120)
    text, _, rest = done.stdout.rpartition("\n# ")
    code, *modules = rest.split()
    return text, done.stderr, code, set(modules)


@pytest.mark.slow
def test_what_is_kept_is_what_would_be_said_and_imports_nothing_heavy(tmp_path: Path) -> None:
    place = {"XDG_CACHE_HOME": str(tmp_path / "kept"), "PATH": "/usr/bin:/bin", "PYTHONPATH": ":".join(sys.path)}
    subprocess.run([sys.executable, "-m", "magnet.cli.all_answers"], check=True, env=place, timeout=300)
    for words in ASKED:
        said = answered(words, tmp_path / "kept")
        assert not said[3] & HEAVY, words
        if words in COMPARED:
            assert said[:3] == answered(words, tmp_path / "empty" / "_".join(words))[:3], words


def test_help_of_a_light_command_waits_for_nothing_heavy(tmp_path: Path) -> None:
    """One process asks them all, so that this runs with every change; tasks and data list are kept answers, above."""
    asked = [[command, "--help"] for command in LIGHT_COMMANDS if command != "tasks"]
    run = f"""
import contextlib, sys
from magnet.cli import main
for words in {asked}:
    with contextlib.suppress(SystemExit):
        main(words)
    print("\\n#", words[0], *set(sys.modules) & {HEAVY})
"""
    place = {"XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True, env=place, timeout=120)
    assert done.returncode == 0, done.stderr
    assert [line[2:].split() for line in done.stdout.splitlines() if line.startswith("# ")] == [
        words[:1] for words in asked
    ]


def test_answers_are_forgotten_with_the_code_that_they_were_made_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(answers.VARIABLE, raising=False)
    monkeypatch.setattr(answers, "FRESH", True)
    assert [answers.kept("a", lambda text=text: text) for text in ("one", "two")] == ["one", "one"]
    for number in range(2 * answers.KEPT):
        monkeypatch.setattr(answers, "code_digest", lambda number=number: f"changed{number}")
        assert answers.kept("a", lambda number=number: f"three {number}") == f"three {number}"
    assert len(list(tmp_path.glob("magnet/answers-*"))) == answers.KEPT
    monkeypatch.setenv(answers.VARIABLE, "my_tasks")  # which may change from call to call
    assert answers.kept("a", lambda: "four") == "four"


def test_shipped_answers_are_those_of_exactly_this_code_and_no_plugin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(answers.VARIABLE, raising=False)
    monkeypatch.setattr(answers, "FRESH", True)
    monkeypatch.setattr(answers, "OURS", tmp_path)
    monkeypatch.setattr(answers, "entry_points", lambda group: [])
    monkeypatch.setattr(answers, "code_digest", inspect.unwrap(answers.code_digest))  # anew at every call
    code, first = tmp_path / "cli" / "a.py", "x = 1\n"
    code.parent.mkdir()
    code.write_text(first)
    shipped = answers.shipped()
    assert shipped is not None
    shipped.write_text('{"a": "shipped"}')
    answers.keep({"b": "kept"})
    assert [answers.recall(name) for name in "abc"] == ["shipped", "kept", None]
    code.write_text("def go():\n    return 2\n")
    assert answers.recall("a") is None
    code.write_text(first)
    plugin = EntryPoint("walk", "nowhere.walks", "magnet.tasks")
    digests = set()
    for release in ("1.0", "1.1"):
        dist = SimpleNamespace(name="walks", version=release)
        found = SimpleNamespace(
            group=plugin.group, name=plugin.name, value=plugin.value, module=plugin.module, dist=dist
        )
        with monkeypatch.context() as other:
            other.setattr(answers, "entry_points", lambda group, found=found: [found])
            digests.add(answers.code_digest())
    assert len(digests) == 2
    for name, value in (("version", lambda name: "0"), ("entry_points", lambda group: [plugin])):
        with monkeypatch.context() as other:
            other.setattr(answers, name, value)
            assert answers.recall("a") is None
    assert answers.recall("a") == "shipped"
    monkeypatch.setenv(answers.VARIABLE, "my_tasks")
    assert answers.recall("a") is None


def test_a_place_that_cannot_be_written_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    monkeypatch.setattr(answers, "FRESH", True)
    assert answers.kept("a", lambda: "one") == "one"


def test_a_user_without_a_home_folder_is_answered_and_told_where_one_is_needed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As in a container whose user is a number alone."""

    def none() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", none)
    monkeypatch.setattr(answers, "FRESH", True)
    assert answers.kept("a", lambda: "one") == "one"
    assert [found.state for found in doctor.files() if found.what == "cache"] == ["missing"]
    with pytest.raises(RuntimeError) as error:
        cache_folder(None, "cmu")
    assert "no home folder: set HOME" in (explain(error.value) or "")


KNOWN = {
    "actions": [
        "--help",
        "--out",
        "--data",
        "--model",
        "--trainer",
        "--trainer.max_steps",
        "--trainer.logger.help",
        "--trainer.logger",
        "--sampler.steps",
    ],
    "classes": {"model": {"Net": ["model.width", "model.loss.latent"]}, "data": {"Walks": ["data.root"]}},
    "chosen": {"model": "Net"},
    "values": {"--trainer.max_steps": "a whole number", "--model.width": "a number or null", "--data.root": "a number"},
}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--otu runs", "no option --otu; did you mean --out?"),
        ("--width 3", "no option --width; did you mean --model.width?"),
        ("--model.wdith 3", "no option --model.wdith; did you mean --model.width?"),
        (
            "--trainer.max_step 3",
            "no option --trainer.max_step; did you mean --trainer.max_steps?",
        ),  # the parser may take it as short for another
        ("--trainer.maxsteps 3", "no option --trainer.maxsteps; did you mean --trainer.max_steps?"),
        ("--model.width=3 --model.init_args.width 4 --model.loss.latent 1 --trainer.logger.save_dir x", None),
        ("--trainer.max_steps abc --out x", "--trainer.max_steps: got abc, expected a whole number"),
        ("--out x --model.width=wide", "--model.width: got wide, expected a number or null"),
        ("--trainer.max_steps 1e3 --model.width null", None),
        ("--trainer.max_steps --model.width NaN", None),
        ("--model my.Net --trainer.max_steps abc", None),
        ("--task.anything 3", None),
        ("--model my.Net --model.depth 3", None),
        ("--config my.yaml --otu runs", None),
        ("--ckpt_path last --otu runs", None),
    ],
)
def test_only_what_nothing_can_take_is_refused_at_once(words: str, said: str | None) -> None:
    assert flags.mistake(words.split(), KNOWN) == said
