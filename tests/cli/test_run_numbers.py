"""Numbers that are too large, or none: one line, before anything is made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from magnet import cli
from magnet.cli.errors import CommandError, explain
from magnet.cli.run_numbers import require_numbers, too_large
from magnet.sampling.options import SamplerOptions

HUGE = "99999999999999999999999"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("fit --model Tokenizer --data.batch_size 1e9", "--data.batch_size: got 1000000000.0, expected a whole number"),
        (f"fit --model Tokenizer --data.batch_size {HUGE}", f"batch_size: got {HUGE}, expected at most 1,000,000"),
        (
            "fit --model Tokenizer --data.window_frames 4000000",
            "window_frames: got 4000000, expected at most 1,000,000",
        ),
        ("fit --model Tokenizer --data.test.horizon_frames 4000000", "horizon_frames: got 4000000, expected at most"),
        ("fit --model Denoiser --data.max_agents 9999", "max_agents: got 9999, expected 1 to 1000"),
        (f"fit --model Tokenizer --data.scene_seed {HUGE}", f"scene_seed: got {HUGE}, expected -1000000000000 to"),
        ("fit --model Tokenizer --seed_everything -5", "--seed_everything -5: expected 0 to 4294967295"),
        ("fit --model Tokenizer --seed_everything 4294967296", "4294967296: expected 0 to 4294967295"),
        ("fit --model Tokenizer --trainer.devices 1e9", "--trainer.devices 1e9: expected 1 to 1,024, a list such as"),
        ("fit --model Tokenizer --trainer.devices 99999999999", "--trainer.devices 99999999999: expected 1 to 1,024"),
        (
            "fit --model Tokenizer --trainer.accumulate_grad_batches 0",
            "--trainer.accumulate_grad_batches 0: expected at least 1",
        ),
        ("test --samples 99999", "samples: got 99999, expected at most 10000"),
        ("tasks show joint_future --tokens 99999", "tokens: got 99999, expected at most 10000"),
        ("tasks show joint_future --people 99999", "people: got 99999, expected at most 200"),
        ("view a.npz --record b.npz --frames 9999999", "--frames 9999999: expected 1 to 1,000,000"),
        ("data fake interx OUT --takes 9999999", "takes: got 9999999, expected at most 1,000,000"),
        ("data fake interx OUT --frames 1e9", "--frames: got 1e9, expected a whole number. See magnet data fake"),
        (f"data fake interx OUT --seed {HUGE}", f"--seed {HUGE}: too large, expected at most 9223372036854775807"),
        (
            "agent --name A --scene a --listen tcp://127.0.0.1:1 --threads 99999",
            "--threads is 99999, expected 1 to 1024",
        ),
    ],
)
def test_a_number_that_cannot_be_is_answered_in_a_line(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(words.split()) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(said) == 1 and message in said[0]


def test_a_number_of_a_file_is_told_with_its_place_however_it_is_written(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    for written in ("1e9", "1.0e+9", "1000000000.0"):
        Path("mine.yaml").write_text(f"data:\n  class_path: Synthetic\n  init_args:\n    batch_size: {written}\n")
        assert cli.main(["fit", "--model", "Tokenizer", "--config", "mine.yaml"]) == 2
        assert "error: mine.yaml, line 4: data.init_args.batch_size: got 1000000000.0" in capsys.readouterr().err


def test_devices_that_can_be_are_taken_and_others_are_not() -> None:
    def taken(devices: Any) -> bool:
        try:
            require_numbers({"trainer": {"devices": devices}})
        except CommandError:
            return False
        return True

    assert [each for each in ["auto", "1", "-1", 8, [0, 1], "0,1", None, "many", "-2", 4096] if not taken(each)] == [
        "many", "-2", 4096
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("pyramid_offset", 9999, "got 9999, expected 0 to 1000"),
        ("crowd_spacing", 1e30, "1.5 to 1000"),
        ("crowd_spacing", 1.4, "got 1.4, expected 1.5 to 1000"),
        ("together", 1e-60, "got 1e-60, expected metres of at least 0.3, or 0"),
    ],
)
def test_options_of_sampling_are_bounded(field: str, value: float, message: str) -> None:
    with pytest.raises(ValueError, match=f"{field}: .*{message}"):
        SamplerOptions(**{field: value})


def test_memory_that_does_not_suffice_is_told_in_a_line() -> None:
    errors = [MemoryError(), MemoryError("Unable to allocate 119. GiB for an array")]
    errors += [RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"), torch.OutOfMemoryError("out of memory")]
    errors += [RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes")]
    for error in errors:
        assert "more memory than there is: ask for less at a time" in (explain(error) or "")


def test_what_early_stopping_watches_in_vain_is_told_in_a_line(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stop = "[{class_path: EarlyStopping, init_args: {monitor: val_loss}}]"
    words = ("fit", "--model", "ToyModel", "--data", "ToyData", "--trainer.accelerator", "cpu", "--out", "run")
    assert cli.main([*words, "--trainer.max_epochs", "1", "--trainer.callbacks", stop]) == 2
    assert "metric `val_loss` which is not available" in capsys.readouterr().err.splitlines()[-1]


def test_only_numbers_that_nothing_takes_are_too_large() -> None:
    assert too_large(["--seed", str(2**63 - 1), "--seed=-9223372036854775807", "--title", "9e99"]) is None
    said = f"--seed {2**63}: too large, expected at most {2**63 - 1}"
    assert too_large(["--seed", str(2**63)]) == too_large([f"--seed={2**63}"]) == said
