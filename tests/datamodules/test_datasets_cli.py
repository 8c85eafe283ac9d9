"""Every data set of the registry, through the command line: fake, check, prepare, train two steps, test."""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from magnet import cli
from magnet.datamodules import registry
from magnet.datamodules.fakes import remocap as fake_remocap
from tests.cases import some_slow
from tests.datamodules.remocap_fits import write_fitted_scenes

CPU = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")
TINY = {
    "quantizer.codebook_dim": "8", "quantizer.codebook_size": "8", "network.width": "8", "network.depth": "1",
}  # fmt: skip
SMALL = {
    "batch_size": "2", "epoch_size": "4", "window_frames": "16", "val_batch_size": "2",
    "test.context_frames": "8", "test.horizon_frames": "8", "test.limit": "2",
}  # fmt: skip
FRAMES = {"remocap": 40, "bvh": 40, "glb": 40, "cmu": 40}
"""Of a fake's takes, where fitting 150 takes too long."""
QUICK = ("interx",)
"""One that needs a body and one that brings its own; the others' files are read in test_readers.py."""
TAKES = {"duobox": 1}
"""Of a fake, where one has several splits."""


def magnet(*words: str) -> None:
    assert cli.main(list(words)) == 0


def flags(prefix: str, values: dict[str, str]) -> list[str]:
    return [word for name, value in values.items() for word in (f"--{prefix}.{name}", value)]


@pytest.mark.parametrize("name", some_slow(registry.readers(), *(set(registry.readers()) - set(QUICK))))
def test_from_a_fake_download_to_a_tested_tokenizer(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    body = () if registry.reader(name).family == "positions" else ("--body", "dl/body.npz")
    fitted = FRAMES.get(name, 150) < 60
    magnet("data", "fake", name, "dl", "--frames", str(FRAMES.get(name, 150)), "--takes", str(TAKES.get(name, 4)))
    few = ("--limit", "1", "--min_frames", "8") if fitted else ("--limit", "1")  # fits take their time
    magnet("data", "check", "dl", "--workers", "1", "--picture", "none", *few, *body)
    assert "all assertions hold" in capsys.readouterr().out
    prepare_fit_and_test(name, body, (), capsys)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("remocap", ("--reader.fits", "dl/fits")),
        ("duobox", ("--reader.form", "skeleton", "--reader.phases", "1")),
    ],
)
def test_ready_fits_and_bare_skeletons_train_as_well(name, options, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    magnet("data", "fake", name, "dl", "--frames", "30", "--takes", "1" if name == "duobox" else "4")
    if name == "remocap":
        write_fitted_scenes(tmp_path / "dl/fits", fake_remocap.scenes(4, 60, 0))
    body, options = ("--body", "dl/body.npz"), ("--min_frames", "8", *options)
    magnet("data", "check", "dl", "--name", name, "--workers", "1", "--picture", "none", *options, *body)
    assert "all assertions hold" in capsys.readouterr().out
    manifest = prepare_fit_and_test(name, body, options, capsys)
    fitted = [take for entry in manifest["notes"] if "mean residual" in entry["note"] for take in entry["takes"]]
    assert sorted(fitted) == ([f"{FIRST}_{part}" for part in ("te0", "tr0", "va0")] if name == "duobox" else [])


FIRST = "000_ma_jab_liu_defense"


@pytest.mark.slow
def test_skeletons_that_no_body_fits_are_refused_and_listed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    magnet("data", "fake", "duobox", "dl", "--frames", "30", "--takes", "1")
    path = tmp_path / f"dl/fbx_export_joints/{FIRST}.npy"
    held = np.load(path, allow_pickle=True).item()
    held["ma_position"][:, 1::2] += [0.0, 0.5, 0.0]  # half of the joints half a metre off
    np.save(path, held)
    words = ("--root", "dl", "--out", "store", "--workers", "1", "--min_frames", "8", "--reader.form", "skeleton")
    assert cli.main(["data", "prepare", "duobox", *words, "--limit", "1", "--body", "dl/body.npz"]) == 2
    said = capsys.readouterr().err
    assert re.search(rf"none of \d takes could be used.*{FIRST}_tr0: .*mean error of [\d.]+ cm", said, re.S)


@pytest.mark.slow
def test_a_mixed_model_is_tested_on_scenes_of_each_size(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    magnet("data", "fake", "embody3d", "dl", "--frames", "40", "--takes", "12")
    body = ("--body", "dl/body.npz")
    mixed = prepare_fit_and_test("embody3d", body, (), capsys)
    assert set(mixed["splits"]["train"]["clips by people"]) == {"2", "3", "4"}
    for people in (2, 3, 4):
        words = ("--root", "dl", "--out", f"of{people}", "--workers", "1", "--reader.people", f"[{people}]")
        magnet("data", "prepare", "embody3d", *words, *body)
    held = [
        json.loads(Path(f"of{people}/manifest.json").read_text(encoding="utf-8"))["splits"]["test"]["takes"]
        for people in (2, 3, 4)
    ]
    assert sum(held) == mixed["splits"]["test"]["takes"]
    people = 2 + next(k for k, takes in enumerate(held) if takes)
    data = ("--data", "Embody3D", "--data.path", f"of{people}")
    magnet("test", "--ckpt_path", "run/checkpoints/last.ckpt", *data, "--out", "each", *CPU)
    assert json.loads(Path("each/results.json").read_text(encoding="utf-8"))


def prepare_fit_and_test(name, body, options, capsys):
    """From `dl` to `store`, two steps of training on it, and a test; returns the store's manifest."""
    magnet("data", "prepare", name, "--root", "dl", "--out", "store", "--workers", "1", *body, *options)
    assert f"--data {registry.data_of(registry.reader(name))} --data.path store" in capsys.readouterr().out
    magnet("data", "check", "store", "--picture", "none", *body)
    assert "all assertions hold" in capsys.readouterr().out
    manifest = json.loads(Path("store/manifest.json").read_text(encoding="utf-8"))
    assert manifest["skipped"] == [] and all(manifest["splits"][split]["clips"] for split in ("train", "val", "test"))
    body_model = ("--data.body_model", body[1]) if body else ()
    kind = registry.classes()[registry.data_of(registry.reader(name))]
    fit_and_test("--data", kind.__name__, "--data.path", "store", *body_model)  # the documented command
    largest = max(int(people) for split in manifest["splits"].values() for people in split["clips by people"])
    options = yaml.safe_load(Path("run/config.yaml").read_text(encoding="utf-8"))["data"]["init_args"]
    defaults = [inspect.signature(one.__init__).parameters for one in kind.__mro__ if "__init__" in vars(one)]
    expected = {
        key: next(each[key].default for each in defaults if key in each) for key in ("max_agents", "device_resident")
    }
    assert largest <= options["max_agents"] == expected["max_agents"]
    assert options["device_resident"] == expected["device_resident"] == (name == "cmu")
    return manifest


def fit_and_test(*data: str) -> None:
    """Two steps of training, and a test."""
    limits = ("--trainer.max_steps", "2", "--trainer.limit_val_batches", "1")
    words = (*flags("model", TINY), *data, *flags("data", SMALL), "--out", "run", *limits)
    magnet("fit", "--model", "Tokenizer", *words, *CPU)
    magnet("test", "--ckpt_path", "run/checkpoints/last.ckpt", "--out", "tested", *CPU)
    assert json.loads(Path("tested/results.json").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_recordings_of_cmu_train_without_being_prepared(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("MAGNET_CMU", "dl")
    magnet("data", "fake", "cmu", "dl", "--frames", "30", "--takes", "3")
    fit_and_test("--data", "CMU")
    assert len(list(tmp_path.glob("magnet/cmu/*.npz"))) == 4
