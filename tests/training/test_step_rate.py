"""The time of a training step and its share of the machine."""

from __future__ import annotations

import itertools
import logging

import lightning as L
import pytest
import torch

from magnet.datamodules.synthetic import Synthetic
from magnet.testing import random_scene, tiny_denoiser
from magnet.training import step_rate
from magnet.training.step_rate import StepRate, matmul_rate, step_operations, tokens_of


def test_operations_count_trainable_matrices_alone() -> None:
    model = torch.nn.Sequential(torch.nn.Linear(10, 20), torch.nn.Linear(20, 5))
    assert step_operations(model, 7) == 6 * 7 * (200 + 100)
    model[0].requires_grad_(False)
    assert step_operations(model, 7) == 6 * 7 * 100


def test_tokens_are_those_of_all_slots(generator: torch.Generator) -> None:
    assert tokens_of(random_scene(3, 32, 2, generator)) == 3 * 2 * 8
    assert tokens_of("something else") == 0


def test_the_rate_of_matrix_products_is_some_number() -> None:
    assert matmul_rate(torch.device("cpu"), torch.float32, repeats=1) > 1e6


def test_it_prints_and_logs_the_median_step(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    clock = itertools.count(step=0.5)  # every look at the clock is half a second later
    monkeypatch.setattr(step_rate, "now", lambda device: float(next(clock)))
    monkeypatch.setattr(step_rate, "matmul_rate", lambda device: 1e9)
    model = tiny_denoiser()
    data = Synthetic(train_clips=2, clip_frames=150, people=[2], max_agents=2, batch_size=2, epoch_size=64)
    said = StepRate(every=4)
    trainer = L.Trainer(
        max_steps=8, logger=False, enable_checkpointing=False, enable_progress_bar=False, callbacks=[said],
        accelerator="cpu", enable_model_summary=False, limit_val_batches=0,
    )  # fmt: skip
    with caplog.at_level(logging.INFO):
        trainer.fit(model, data)
    lines = [record.message for record in caplog.records if record.message.startswith("step ")]
    assert [line.split(":")[0] for line in lines] == ["step 4", "step 8"]
    tokens = 2 * 2 * data.window_frames // 4
    share = 100 * step_operations(model, tokens) / 0.5 / 1e9
    assert all(f"500.0 ms, {share:.1f} %" in line for line in lines)
    assert float(trainer.callback_metrics["step_seconds"]) == 0.5


def test_a_training_without_an_end_is_timed_as_seldom_as_one_with_an_end() -> None:
    """Each timed step waits for the device."""

    def timed(max_steps: int) -> list[int]:
        rate = StepRate(every=100)
        return [step for step in range(200) if rate.timed(step, max_steps)]

    assert timed(-1) == timed(1000) == [*range(90, 100), *range(190, 200)]
    assert timed(50)[:10] == [*range(40, 50)], "and its end"


def test_how_often_must_be_a_number_of_steps() -> None:
    with pytest.raises(ValueError, match="expected 1 or more"):
        StepRate(every=0)
