"""Several processes train as one does, go on in another number, and end together with a message (docs/scale.md)."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from lightning.fabric.plugins.environments import SLURMEnvironment

from magnet.cli.errors import explain

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `tests.cli.scale_runs`."""
    folder = tmp_path_factory.mktemp("scale")
    words = [sys.executable, "-m", "tests.cli.scale_runs", str(folder)]
    subprocess.run(words, cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=True, timeout=550)
    return folder


def curve(run: Path, name: str) -> list[float]:
    with (run / "metrics.csv").open() as file:
        return [float(row[name]) for row in csv.DictReader(file) if row.get(name)]


def codes(runs: Path) -> dict[str, list[int]]:
    read: dict[str, list[int]] = json.loads((runs / "codes.json").read_text())
    return read


@pytest.mark.slow
def test_two_and_four_processes_learn_as_one_with_the_same_global_batch(runs: Path) -> None:
    one = curve(runs / "of_1", "loss")
    assert len(one) == 12 and one[-1] < 0.9 * one[0]
    for world in (2, 4):
        assert codes(runs)[f"of_{world}"] == [0] * world
        several = curve(runs / f"of_{world}", "loss")
        assert several == pytest.approx(one, rel=0.1), "augmentation is drawn by each process for its own scenes"
        assert curve(runs / f"of_{world}", "val/loss") == pytest.approx(curve(runs / "of_1", "val/loss"), rel=0.05)


@pytest.mark.slow
def test_a_run_goes_on_with_another_number_of_processes(runs: Path) -> None:
    assert codes(runs)["on_4"] == [0] * 4 and codes(runs)["on_1"] == [0]
    four, one = (curve(runs / f"on_{world}", "loss")[-6:] for world in (4, 1))
    assert four == pytest.approx(one, rel=0.1)
    metrics = [curve(runs / f"on_{world}", "val/mpjpe_cm")[-1] for world in (4, 1)]
    assert metrics[0] == pytest.approx(metrics[1], rel=0.05)


@pytest.mark.slow
def test_a_killed_process_ends_the_run_with_a_message_and_the_run_goes_on(runs: Path) -> None:
    left, killed = codes(runs)["killed"]
    assert (left, killed) == (2, -9)
    assert "another process of this training" in (runs / "left.log").read_text()
    assert codes(runs)["resumed"] == [0, 0]


@pytest.mark.slow
def test_sharded_over_two_processes_the_network_learns_the_same(runs: Path) -> None:
    one, two = (json.loads((runs / f"sharded{world}.0.json").read_text()) for world in (1, 2))
    assert two["losses"] == pytest.approx(one["losses"], rel=1e-4)
    assert one["held"] == 1.0 and two["held"] < 0.51


@pytest.mark.slow
def test_a_denoiser_in_shards_learns_as_one_and_goes_on_alone(runs: Path) -> None:
    """Scenes of two, three and four people and self-forcing, which processes without shards run unequally often."""
    assert codes(runs)["cut_1"] == [0] and codes(runs)["cut_2"] == [0, 0] and codes(runs)["cut_on"] == [0]
    one, two = (curve(runs / f"cut_{world}", "val/loss") for world in (1, 2))
    assert two == pytest.approx(one, rel=0.05)
    assert curve(runs / "cut_on", "val/loss")[-1] < two[0]


def test_what_torch_says_of_a_lost_process_becomes_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    lost = RuntimeError("[gloo/transport/tcp/pair.cc:537] Read error [127.0.0.1]:8091: Connection reset by peer")
    assert explain(lost) is None, "of a single process it is ours"
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert "--ckpt_path last" in (explain(lost) or "")
    assert explain(RuntimeError("shapes do not fit")) is None


def test_what_lightning_says_of_slurm_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLURM_NTASKS", "4")
    monkeypatch.delenv("SLURM_NTASKS_PER_NODE", raising=False)
    with pytest.raises(RuntimeError) as refused:
        SLURMEnvironment()
    assert "Use `--ntasks-per-node=4`" in (explain(refused.value) or "")
