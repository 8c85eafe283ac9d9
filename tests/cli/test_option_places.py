"""What is wrong in a configuration file is told of by the file, the line and the whole key."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnet import cli


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("speeds: [0.9]", "no option data.init_args.data[1].init_args.speeds: Synthetic has no speeds"),
        ("val_clips: x", "data.init_args.data[1].init_args.val_clips: got x, expected a whole number"),
        ("test: {stride: x}", "data.init_args.data[1].init_args.test.stride: got x, expected a whole number"),
    ],
)
def test_a_wrong_option_of_a_data_set_in_a_mixture_is_named_by_its_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: str, said: str
) -> None:
    one, top = (
        "      - class_path: Synthetic\n        init_args: ",
        "data:\n  class_path: Mixed\n  init_args:\n    data:\n",
    )
    file = tmp_path / "mixed.yaml"
    file.write_text(f"{top}{one}{{train_clips: 4}}\n{one}{{train_clips: 4, {wrong}}}\n")
    assert cli.main(["fit", "--config", str(file), "--model", "Tokenizer"]) == 2
    error = capsys.readouterr().err
    assert f"error: {file}, line 8: {said}" in error and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("command", "written", "said"),
    [
        (
            "fit",
            "data:\n  class_path: Synthetic\n  init_args:\n    batch_size: many\n",
            "line 4: data.init_args.batch_size: got many, expected a whole number",
        ),
        (
            "fit",
            "model:\n  class_path: Denoiser\n  init_args:\n    sampling: {settle: nonsense}\n",
            "line 4: model.init_args.sampling.settle: got nonsense, expected off, light, firm, hold or null",
        ),
        (
            "fit",
            "data:\n  class_path: Sinthetic\n",
            "line 2: data.class_path: no data Sinthetic; did you mean Synthetic?",
        ),
        ("fit", "data: Sinthetic\n", "line 1: data: no data Sinthetic; did you mean Synthetic?"),
        ("fit", "model:\n  class_path: Foo\n", "line 2: model.class_path: no model Foo; there are Denoiser, Tokenizer"),
        (
            "fit",
            "data:\n  class_path: Mixed\n  init_args:\n    data:\n    - class_path: Sinthetic\n",
            "line 5: data.init_args.data[0].class_path: no data Sinthetic; did you mean Synthetic?",
        ),
        ("fit", "trainer:\n  max_steps: many\n", "line 2: trainer.max_steps: got many, expected a whole number"),
        ("test", "samples: [3]\n", "line 1: samples: got [3], expected a whole number"),
        (
            "fit",
            "data:\n  class_path: Synthetic\n  init_args:\n    batchsize: 3\n",
            "line 4: no option data.init_args.batchsize; did you mean data.init_args.batch_size?",
        ),
        ("fit", "trainer:\n  max_stps: 3\n", "line 2: no option trainer.max_stps; did you mean trainer.max_steps?"),
        ("test", "sampler:\n  setle: hold\n", "line 2: no option sampler.setle; did you mean sampler.settle?"),
        ("test", "samplez: 3\n", "line 1: no option samplez; did you mean samples?"),
        (
            "test",
            "task: {name: inbetweening,\n  evry: 3}\n",
            "line 2: no option task.evry; did you mean task.every? See magnet test --help",
        ),
        ("test", "task:\n  name: inbetweening\n  every: x\n", "line 3: task.every: got x, expected a whole number"),
    ],
)
@pytest.mark.parametrize("way", ["itself", "extended"])
def test_what_is_wrong_in_a_file_is_told_with_its_place(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    written: str,
    said: str,
    way: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(written)
    Path("over.yaml").write_text("extends: mine.yaml\nseed_everything: 3\n")
    words = [command, "--config", "mine.yaml" if way == "itself" else "over.yaml"]
    if "model:" not in written and command == "fit":
        words += ["--model", "Tokenizer"]
    assert cli.main(words) == 2
    error = capsys.readouterr().err
    assert f"error: mine.yaml, {said}" in error and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--data.batch_size few", "mine.yaml, line 4: data.init_args.batch_size: got many"),
        ("--data.clip_frames x", "--data.clip_frames: got x"),
        ("--data.clip_framez 3", "no option --data.clip_framez; did you mean --data.clip_frames?"),
    ],
)
def test_what_a_flag_gives_is_not_blamed_on_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], flags: str, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    value = "many" if "batch_size" in flags else "4"
    Path("mine.yaml").write_text(f"data:\n  class_path: Synthetic\n  init_args:\n    batch_size: {value}\n")
    assert cli.main(["fit", "--config", "mine.yaml", "--model", "Tokenizer", *flags.split()]) == 2
    assert f"error: {said}" in capsys.readouterr().err
