"""A test run of two processes has the table, and the facts, of one."""

from __future__ import annotations

import json
from pathlib import Path

import lightning as L
import pytest
import torch.multiprocessing as mp

from magnet.evaluation.evaluator import MODEL
from tests.evaluation.test_evaluator import data, prepared, run
from tests.processes import as_by_torchrun, free_port


def one_of_two(rank: int, port: int, folder: str) -> None:
    """One process of a test run."""
    as_by_torchrun(rank, 2, port)
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = L.Trainer(accelerator="cpu", devices=2, strategy="ddp", **quiet)
    evaluation, _ = prepared(baselines=False)
    trainer.test(evaluation, datamodule=data(), verbose=False)
    Path(folder, f"{rank}.json").write_text(
        json.dumps([evaluation.results.meta, evaluation.results.rows[MODEL]]), encoding="utf-8"
    )


@pytest.mark.slow
def test_two_processes_tell_of_the_scenes_of_both(tmp_path: Path) -> None:
    """Nine scenes, of which one process has five."""
    port = free_port()
    mp.spawn(one_of_two, args=(port, str(tmp_path)), nprocs=2)
    one = run(data(), baselines=False).results
    for rank in range(2):
        facts, row = json.loads((tmp_path / f"{rank}.json").read_text())
        assert facts["test scenes"] == one.meta["test scenes"] == 9
        assert facts["sampling"] == pytest.approx(one.meta["sampling"], abs=2e-4)
        assert row["mpjpe"] == pytest.approx(one.rows[MODEL]["mpjpe"], rel=1e-3)
