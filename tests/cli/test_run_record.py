"""What is written of a run: whether it can be, its seeds, the link to the latest."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from lightning.pytorch import LightningModule, Trainer

from magnet import cli
from magnet.cli import doctor, run_record
from magnet.datamodules.store.reader import FORMAT
from magnet.files import CannotWrite
from magnet.training import origins


def test_a_folder_that_cannot_be_written_is_refused_before_the_run(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    record = run_record.Record(tmp_path / "file" / "run", "", {}, {}, command="test")
    with pytest.raises(CannotWrite, match="is a file, expected a folder"):
        record.setup(Trainer(logger=False, accelerator="cpu"), LightningModule(), "test")


def test_seeds_of_model_and_data_are_recorded_by_their_names() -> None:
    of = {"class_path": "its.Class", "init_args": {"seed": 3}}
    fit = run_record.seeds({"seed_everything": 1111, "model": of, "data": {"class_path": "its.Data"}})
    assert fit == {"seed": 1111, "seeds": {"seed_everything": 1111, "model.seed": 3}}
    assert run_record.seeds({"seed": 5, "seed_everything": 1, "model": None, "data": of}) == {
        "seed": 5,
        "seeds": {"seed": 5, "seed_everything": 1, "data.seed": 3},
    }


def test_what_a_prepared_store_holds_is_recorded_with_the_data(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text(json.dumps({"name": "cmu", "format": FORMAT, "body": {"id": "open-1"}}))
    parts = [{"class_path": "Prepared", "init_args": {"path": path}} for path in (str(tmp_path), "gone")]
    model = LightningModule()
    model.origin = origins.begun()
    mixed = {"class_path": "Mixed", "init_args": {"data": parts}}
    record = run_record.Record(tmp_path / "run", "", {"data": mixed}, {})
    record.on_train_start(Trainer(fast_dev_run=True, accelerator="cpu"), model)
    (said,) = model.origin["data"]
    assert said["init_args"]["data"] == [{**parts[0], "store": "cmu"}, parts[1]]


@pytest.mark.parametrize("command", ["validate", "test", "predict"])
def test_latest_leads_to_what_was_measured_last_but_a_trainings_stays(command: str, toy: Path) -> None:
    (toy / "salsa.yaml").write_text("model: {class_path: ToyModel}\n")
    words = ["--trainer.accelerator", "cpu", "--ckpt_path", "last"]
    assert cli.main(["fit", "--config", "salsa.yaml", "--trainer.max_epochs", "1", *words[:2]]) == 0
    trained = (toy / "runs" / "salsa" / "latest").resolve()
    latest = toy / "runs" / command / "latest"
    for number in (1, 2):
        assert cli.main([command, *words]) == 0
        runs = [path for path in latest.parent.iterdir() if not path.is_symlink()]
        assert len(runs) == number and latest.resolve() == max(runs, key=lambda run: run.stat().st_mtime_ns)
    assert cli.main([command, *words, "--out", "elsewhere"]) == 0 and not (toy / "latest").exists()
    assert cli.main([command, "--config", "salsa.yaml", *words]) == 0
    assert (toy / "runs" / "salsa" / "latest").resolve() == trained
    (told,) = (one.told for one in doctor.files() if one.what == "runs")
    assert ", 4 runs, " in told, "links are no runs"
