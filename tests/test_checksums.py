"""Checkpoints with flipped bytes are refused, whoever reads them; those that were whole before stay whole."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from magnet import checkpoints, files
from magnet.cli import checkpoint_config
from magnet.cli.errors import CommandError
from magnet.tokenizer.checkpoint import read_checkpoint
from magnet.training.checkpoint_io import CheckpointIO
from tests.toys import ToyData, ToyModel

IO = CheckpointIO()


@pytest.fixture
def checkpoint() -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    state = {"big": torch.randn(300, 40, generator=generator), "count": torch.tensor(3)}
    return {"state_dict": state, "hyper_parameters": {"width": 8}, "global_step": 12}


@pytest.fixture
def saved(checkpoint: dict[str, Any], tmp_path: Path) -> Path:
    path = tmp_path / "run/checkpoints/last.ckpt"
    IO.save_checkpoint(checkpoint, path)
    return path


def flipped(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0x10
    path.write_bytes(data)


def test_what_is_saved_comes_back_with_a_checksum_that_sha256sum_reads(saved: Path, checkpoint: dict[str, Any]) -> None:
    back = IO.load_checkpoint(saved)
    assert torch.equal(back["state_dict"]["big"], checkpoint["state_dict"]["big"]) and back["global_step"] == 12
    assert sorted(path.name for path in saved.parent.iterdir()) == ["last.ckpt", "last.ckpt.sha256"]
    subprocess.run(["sha256sum", "-c", "--quiet", "last.ckpt.sha256"], cwd=saved.parent, check=True)


def test_a_checkpoint_is_known_by_its_hash_whatever_its_name(
    saved: Path, checkpoint: dict[str, Any], tmp_path: Path
) -> None:
    assert checkpoints.digest(saved) == checkpoints.checksum_file(saved).read_text()[:64]
    released = checkpoints.write(checkpoint, tmp_path / "released")
    assert checkpoints.digest(released) == json.loads((released / "config.json").read_text())["sha256"]


def test_a_flipped_byte_anywhere_is_refused_by_every_reader(saved: Path) -> None:
    whole = saved.read_bytes()
    readers = (checkpoints.read, IO.load_checkpoint, read_checkpoint)
    for number, at in enumerate(np.linspace(0, len(whole) - 1, 40).astype(int)):
        flipped(saved, at)
        with pytest.raises(ValueError, match=r"last\.ckpt: damaged, its SHA-256 is not the one in last\.ckpt\.sha256"):
            readers[number % 3](saved)
        saved.write_bytes(whole)
    flipped(saved, 100)
    with pytest.raises(CommandError, match=r"damaged.*take another checkpoint; if you changed it yourself, delete"):
        checkpoint_config.Stored.read(saved)


def test_a_checkpoint_without_a_checksum_loads_unless_its_weights_are_flipped(saved: Path) -> None:
    checkpoints.checksum_file(saved).unlink()
    assert checkpoints.read(saved)["global_step"] == 12
    whole = saved.read_bytes()
    values = whole.index(checkpoints.read(saved)["state_dict"]["big"].numpy().tobytes())
    for at in values + np.linspace(0, 300 * 40 * 4 - 1, 20).astype(int):
        flipped(saved, at)
        assert torch.load(saved, weights_only=True)["global_step"] == 12  # torch alone does not notice
        with pytest.raises(ValueError, match=r"last\.ckpt: not a checkpoint that is whole .*take another one"):
            checkpoints.read(saved)
        saved.write_bytes(whole)


def test_what_lightning_itself_wrote_loads(checkpoint: dict[str, Any], tmp_path: Path) -> None:
    super(CheckpointIO, IO).save_checkpoint(checkpoint, tmp_path / "a.ckpt")
    torch.save(checkpoint, tmp_path / "b.ckpt")
    assert all(checkpoints.read(tmp_path / name)["global_step"] == 12 for name in ("a.ckpt", "b.ckpt"))


def test_a_damaged_checksum_is_told_from_a_damaged_checkpoint(saved: Path) -> None:
    checkpoints.checksum_file(saved).write_text("rubbish")
    with pytest.raises(ValueError, match=r"last\.ckpt\.sha256: holds no SHA-256; copy it again, or delete it"):
        checkpoints.read(saved)


def test_a_checkpoint_that_takes_the_place_of_another_has_its_own_checksum_or_none(
    saved: Path, checkpoint: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    replace, unlink = os.replace, Path.unlink

    def looked(*words: Any, **more: Any) -> None:
        replace(*words, **more)
        seen.append(checkpoints.read(saved)["global_step"])  # as a process that is killed here would leave it

    def looked_too(self: Path, *words: Any, **more: Any) -> None:
        unlink(self, *words, **more)
        seen.append(checkpoints.read(saved)["global_step"])

    monkeypatch.setattr(os, "replace", looked)
    monkeypatch.setattr(Path, "unlink", looked_too)
    IO.save_checkpoint(checkpoint | {"global_step": 13}, saved)
    assert seen == [12, 13, 13]
    assert checkpoints.checksum_file(saved).exists()


def test_a_checkpoint_that_is_removed_takes_its_checksum_along(saved: Path) -> None:
    IO.remove_checkpoint(saved)
    assert not list(saved.parent.iterdir())


@pytest.mark.parametrize("room", [0, 1000, 40_000])
def test_a_full_disk_leaves_the_checkpoint_before(
    saved: Path, checkpoint: dict[str, Any], monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    left, write = [room], files.HashedFile.write

    def written(self: files.HashedFile, data: Any) -> int:
        left[0] -= len(data)
        if left[0] < 0:
            self.failed = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise self.failed
        return write(self, data)

    monkeypatch.setattr(files.HashedFile, "write", written)
    with pytest.raises(OSError, match=r"checkpoints: the disk is full .*then go on with --ckpt_path last"):
        IO.save_checkpoint(checkpoint | {"global_step": 13}, saved)
    monkeypatch.undo()
    assert checkpoints.read(saved)["global_step"] == 12
    assert sorted(path.name for path in saved.parent.iterdir()) == ["last.ckpt", "last.ckpt.sha256"]


def test_a_training_run_keeps_a_checksum_of_every_checkpoint_and_goes_on_from_it(tmp_path: Path) -> None:
    def fitted(epochs: int, checkpoint: Path | None) -> None:
        keep = ModelCheckpoint(tmp_path, "{epoch}", save_last=True, save_top_k=1, monitor="epoch", mode="max")
        words = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
        trainer = Trainer(max_epochs=epochs, plugins=[CheckpointIO()], callbacks=[keep], **words)
        trainer.fit(ToyModel(), ToyData(), ckpt_path=None if checkpoint is None else str(checkpoint), weights_only=True)

    fitted(2, None)
    files_there = {"last.ckpt", "epoch=1.ckpt"}  # the one of epoch 0 was removed
    assert {path.name for path in tmp_path.iterdir()} == files_there | {f"{name}.sha256" for name in files_there}
    fitted(3, tmp_path / "last.ckpt")
    flipped(tmp_path / "last.ckpt", 2000)
    with pytest.raises(ValueError, match="damaged, its SHA-256 is not"):
        fitted(4, tmp_path / "last.ckpt")


# -- released models ---------------------------------------------------------------------------


def test_a_flipped_byte_in_what_ships_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "duet"
    shutil.copytree(checkpoints.resolve(), folder, ignore=shutil.ignore_patterns("scenes"))
    assert checkpoints.read(folder)["state_dict"]
    for file in [*sorted(folder.glob("*.safetensors")), folder / "config.json"]:
        whole, places = file.read_bytes(), 40 if file.suffix == ".json" else 3
        for at in np.linspace(0, len(whole) - 2, places).astype(int):  # the last byte is an end of line
            flipped(file, at)
            with pytest.raises(ValueError, match=rf"{file.name}.*(damaged|missing|later|up to).*"):
                checkpoints.read(folder)
            file.write_bytes(whole)


def test_a_config_without_its_own_hash_still_loads(tmp_path: Path, checkpoint: dict[str, Any]) -> None:
    folder = checkpoints.write(checkpoint | {key: {} for key in checkpoints.KEPT}, tmp_path / "m")
    config = json.loads((folder / "config.json").read_text())
    del config["sha256"]
    (folder / "config.json").write_text(json.dumps(config))
    assert checkpoints.read(folder)["global_step"] == 12
    (folder / "config.json").write_text(json.dumps(config | {"parts": [{"file": "../a.safetensors", "sha256": ""}]}))
    with pytest.raises(ValueError, match="its index names"):
        checkpoints.read(folder)


def test_a_full_disk_before_the_first_checkpoint_does_not_send_to_one(
    checkpoint: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match=r"the disk is full .*then run the same command again$"):
        IO.save_checkpoint(checkpoint, tmp_path / "checkpoints" / "last.ckpt")
