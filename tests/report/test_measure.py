"""What cells measure of a long generation: laws of recordings in place of samples."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from magnet.datamodules.synthetic import Synthetic
from magnet.metrics import Interpenetration
from magnet.motion.scene import Scene
from magnet.report import measure
from magnet.report.cells import Cell

CELL = Cell("long", 0, "made", None, "joint_future", scenes=3, samples=1, frames=300)
START, PIECE = 4, 150
"""Frames that are given, and those of a stretch, as the paper's Fig. 7 has them and this test's scenes."""


def scenes(cell: Cell) -> Synthetic:
    return Synthetic(
        people=[2], max_agents=2, train_clips=4, val_clips=1, test_clips=3, clip_frames=160, window_frames=32
    )


@pytest.fixture(autouse=True)
def few_clips(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "data_of", scenes)


def recorded() -> Tensor:
    """Joints of the stretches that follow what is given. -> (B, 150, 2, 22, 3)"""
    data = scenes(CELL)
    data.test = data.test.__class__(context_frames=START, horizon_frames=PIECE, limit=CELL.scenes)
    data.prepare_data()
    return torch.cat([data.body.joints(batch.slice(START)) for batch in data.test_dataloader()])


def long_of(monkeypatch: pytest.MonkeyPatch, made: Tensor) -> dict[str, Any]:
    """What is measured of a method that makes this of the scenes. (B, T, 2, 22, 3)"""
    seen: list[int] = []

    def method(given: Scene, samples: int, generators: list[torch.Generator]) -> Tensor:
        assert given.frames == START and len(generators) == given.scenes
        first = sum(seen)
        seen.append(given.scenes)
        return made[None, first : first + given.scenes]

    monkeypatch.setattr(measure, "predictor", lambda *_: method)
    return measure.run(CELL, "some.ckpt", "duet", 1)["rows"]["ours"]


def test_a_recording_twice_over_is_at_no_distance_from_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    real = recorded()
    found = long_of(monkeypatch, torch.cat([real, real], dim=1))
    for row in (found["value"], *found["without"].values()):
        assert row.keys() == {"fd@150", "fd@300", "fd", "mi", "ip_ratio"}
        assert [row[name] for name in ("fd@150", "fd@300", "fd", "mi")] == pytest.approx([0, 0, 0, 0], abs=1e-4)
    assert list(found["without"]) == ["0", "1", "2"]


def test_what_goes_wrong_after_the_first_stretch_is_seen_in_the_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """All stand in one another from then on: half of all frames, and far from how they were recorded."""
    real = recorded()
    stuck = real[:, :, :1].expand_as(real)
    found = long_of(monkeypatch, torch.cat([real, stuck], dim=1))["value"]
    metric = Interpenetration()
    metric.update(real[None], real)
    assert found["fd@150"] == pytest.approx(0, abs=1e-4) and found["fd@300"] == found["fd"] > 0.01
    assert found["ip_ratio"] == pytest.approx((metric.compute()["ip_ratio"].item() + 1) / 2, abs=1e-6)
    assert found["mi"] > 0.1


def test_without_a_model_training_windows_and_the_recordings_are_measured() -> None:
    rows = measure.run(CELL, None, "duet", 1)["rows"]
    assert rows.keys() == {"training set", "ground truth"}
    assert rows["training set"]["value"]["fd@300"] > 0
    assert rows["ground truth"]["value"].keys() == {"ip_ratio"}
    metric = Interpenetration()
    metric.update(recorded()[None], recorded())
    assert rows["ground truth"]["value"]["ip_ratio"] == pytest.approx(metric.compute()["ip_ratio"].item(), abs=1e-6)
    assert len(rows["training set"]["without"]) == len(rows["ground truth"]["without"]) == 3
