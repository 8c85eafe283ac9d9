"""Every data set of the catalogue, through the command line: fake, check, prepare, train two steps, test."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from magnet import cli
from magnet.datamodules import catalogue
from magnet.datamodules.common import to_clips
from magnet.datamodules.fakes.motion import made_up_body
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.recording import DataError, Reader, Recording
from tests.datamodules.made import SPOILED, in_degrees

CPU = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")
TINY = {"latent": "8", "hidden": "8", "codes": "8", "depth": "1"}
SMALL = {
    "max_agents": "7", "batch_size": "2", "epoch_size": "4", "window_frames": "16", "val_batch_size": "2",
    "context_frames": "8", "horizon_frames": "8", "test_limit": "2",
}  # fmt: skip
FRAMES = {"duobox": 480, "interx": 480, "remocap": 60}
"""Of a fake's takes at its own rate, where 150 are too few at 30 fps, or fitting so many takes too long."""
TAKES = {"duobox": 1}
"""Of a fake, where one has several splits."""
LONG = {"duobox": 1200, "interx": 1200, "interhuman": 900}
"""Of a fake's takes to spoil, where 400 frames are too short for several steps."""


def magnet(*words: str) -> None:
    assert cli.main(list(words)) == 0


def flags(prefix: str, values: dict[str, str]) -> list[str]:
    return [word for name, value in values.items() for word in (f"--{prefix}.{name}", value)]


@pytest.mark.parametrize("name", catalogue.NAMES)
def test_from_a_fake_download_to_a_tested_tokenizer(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    body = () if catalogue.find(name).load_reader().family == "positions" else ("--body", "dl/body.npz")
    magnet("data", "fake", name, "dl", "--frames", str(FRAMES.get(name, 150)), "--takes", str(TAKES.get(name, 4)))
    magnet("data", "prepare", name, "--root", "dl", "--out", "store", "--workers", "1", *body)
    assert f"--data {catalogue.find(name).data.partition(':')[2]} --data.path store" in capsys.readouterr().out
    if body:  # fits are the same again, and take their time
        magnet("data", "check", "dl", "--workers", "1", "--limit", "1", "--picture", "none", *body)
    magnet("data", "check", "store", "--picture", "none", *body)
    assert "all assertions hold" in capsys.readouterr().out
    manifest = json.loads(Path("store/manifest.json").read_text())
    assert manifest["skipped"] == [] and all(manifest["splits"][split]["clips"] for split in ("train", "val", "test"))
    data = ["--data", catalogue.find(name).data.replace(":", "."), "--data.path", "store", *flags("data", SMALL)]
    data += ["--data.body_model", body[1]] if body else []
    limits = ("--trainer.max_steps", "2", "--trainer.limit_val_batches", "1")
    magnet("fit", "--model", "Tokenizer", *flags("model", TINY), *data, "--out", "run", *limits, *CPU)
    magnet("test", "--ckpt_path", "run/checkpoints/last.ckpt", "--out", "tested", *CPU)
    results = json.loads(Path("tested/results.json").read_text())
    assert results


@pytest.mark.parametrize("wrong", SPOILED)
@pytest.mark.parametrize("name", catalogue.NAMES)
def test_a_wrong_axis_unit_or_rate_is_named_for_every_reader(name, wrong, tmp_path_factory):
    kind, root = catalogue.find(name).load_reader(), cached_fake(name, tmp_path_factory)
    reader = kind(root)
    for take in reader.takes():
        recording = reader.read(take)
        if recording.frames > 4 * recording.fps and (wrong != "m for mm" or shown_people(recording) > 1):
            break
    if wrong == "30 for 120 fps":  # every fourth frame, called by the rate of all
        fields = ("poses", "transl", "positions", "valid")
        cut = {f: getattr(recording, f)[::4] for f in fields if getattr(recording, f) is not None}
        recording, spoil = replace(recording, **cut), lambda r: r
    else:
        spoil = SPOILED[wrong][0]
    with pytest.raises(DataError, match=SPOILED[wrong][1]):
        to_clips(spoil(recording), made_up_body(), take.name, name, "train", reader.family)


@pytest.mark.parametrize("name", catalogue.NAMES)
def test_degrees_are_named_for_every_reader_of_rotations(name, tmp_path_factory):
    kind, root = catalogue.find(name).load_reader(), cached_fake(name, tmp_path_factory)
    if kind.family == "positions":
        pytest.skip("no rotations")
    reader = kind(root)
    with pytest.raises(DataError, match="look like degrees"):
        to_clips(in_degrees(reader.read(reader.takes()[0])), made_up_body(), "take", name, "train", kind.family)


FAKES: dict[str, Path] = {}


def cached_fake(name: str, tmp_path_factory) -> Path:
    if name not in FAKES:
        FAKES[name] = tmp_path_factory.mktemp(name)
        catalogue.find(name).load_fake()(FAKES[name], takes=TAKES.get(name, 2), frames=LONG.get(name, 400))
    return FAKES[name]


def shown_people(recording: Recording) -> int:
    motion = recording.poses if recording.poses is not None else recording.positions
    assert motion is not None
    return motion.shape[1]


@pytest.mark.parametrize("name", catalogue.NAMES)
def test_an_entry_has_all_its_parts(name):
    entry = catalogue.find(name)
    reader, data = entry.load_reader(), entry.load_data()
    assert issubclass(reader, Reader) and reader.name == name
    assert re.match(r"https?://", reader.source) and reader.licence
    assert issubclass(data, Prepared) and data.reader is reader


def test_a_wrong_name_suggests_the_closest():
    with pytest.raises(ValueError, match="no data set 'interX'; did you mean interx"):
        catalogue.find("interX")
