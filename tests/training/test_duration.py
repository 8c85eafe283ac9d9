"""What is said of how long a training takes."""

import math
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.callbacks import Timer

from magnet.training import duration
from magnet.training.duration import Duration, announced, told
from magnet.training.step_rate import WARM_UP


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(12, "12 seconds"), (600, "10 minutes"), (3.5 * 3600, "3.5 hours"), (30 * 3600, "30 hours"), (259200, "3.0 days")],
)
def test_a_length_of_time_is_said_as_one_says_it(seconds: float, words: str) -> None:
    assert told(seconds) == words


def test_the_whole_training_is_announced_once_from_steps_after_the_first(monkeypatch, capsys) -> None:
    clock = iter([100.0, 102.0])  # the first steps, which compile, are not on it
    monkeypatch.setattr(duration, "now", lambda device: next(clock, 999.0))
    counts = {"estimated_stepping_batches": 10**9, "max_steps": 9008, "is_global_zero": True, "callbacks": []}
    trainer, model = SimpleNamespace(**counts), SimpleNamespace(device=torch.device("cpu"))
    callback = Duration()
    for number in range(WARM_UP + 20):
        trainer.global_step = number
        callback.on_train_batch_start(trainer, model, None, number)
        if number < WARM_UP:
            assert capsys.readouterr().out == ""
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("about 60 minutes for 9,000 steps of 0.40 s on ")


def test_several_batches_of_a_step_count_once_and_a_longest_time_counts(monkeypatch, capsys) -> None:
    clock = iter([100.0, 102.0])
    monkeypatch.setattr(duration, "now", lambda device: next(clock, 999.0))
    timer = Timer(duration={"minutes": 10})
    monkeypatch.setattr(timer, "time_remaining", lambda: 120.0)
    counts = {"estimated_stepping_batches": math.inf, "max_steps": -1, "is_global_zero": True, "callbacks": [timer]}
    trainer, model = SimpleNamespace(**counts), SimpleNamespace(device=torch.device("cpu"))
    callback = Duration()
    for batch in range(4 * (WARM_UP + 6)):  # accumulate_grad_batches=4
        trainer.global_step = batch // 4
        callback.on_train_batch_start(trainer, model, None, batch)
    assert capsys.readouterr().out.startswith("about 2.0 minutes for 300 steps of 0.40 s on ")


def test_a_training_without_an_end_says_so() -> None:
    assert "nothing ends this training: say --trainer.max_steps N" in announced(0.05, math.inf, "2 CPU threads")
