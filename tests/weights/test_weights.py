import errno
import json
import math
import pickle
from pathlib import Path

import pytest
import torch

from magnet import checkpoints
from magnet.cli import named_files
from magnet.export import reading
from magnet.files import CannotWrite
from magnet.motion.scene import empty_scene
from magnet.training.checkpoint_io import CheckpointIO


@pytest.fixture
def checkpoint():
    torch.manual_seed(0)
    return {
        "state_dict": {
            "big": torch.randn(300, 40),
            "bias": torch.randn(5),
            "normalizer.mean": torch.randn(3, 3),
            "count": torch.tensor(3),
        },
        "hyper_parameters": {"network": {"width": 8}},
        "tokenizer_hyper_parameters": {"network": {"causal": True}},
        "magnet_config": {"model": {"class_path": "Denoiser"}},
        "global_step": 12,
    }


def test_a_released_model_comes_back(checkpoint, tmp_path):
    back = checkpoints.read(checkpoints.write(checkpoint, tmp_path / "m"))
    (tmp_path / "plain").touch()
    modes = {file.stat().st_mode for file in (tmp_path / "m").iterdir()}
    assert modes == {(tmp_path / "plain").stat().st_mode}, "for others to read as well"
    assert back["state_dict"].keys() == checkpoint["state_dict"].keys()
    for name in ("bias", "normalizer.mean", "count"):
        assert torch.equal(back["state_dict"][name], checkpoint["state_dict"][name])
    assert torch.allclose(back["state_dict"]["big"], checkpoint["state_dict"]["big"], atol=2e-3)
    assert all(back[key] == checkpoint[key] for key in (*checkpoints.KEPT, "global_step"))


def test_weights_released_in_half_are_widened_where_they_are_wanted(checkpoint, tmp_path):
    folder = checkpoints.write(checkpoint, tmp_path)
    kept, wide = (checkpoints.read(folder, halves=halves)["state_dict"] for halves in (True, False))
    assert (kept["big"].dtype, kept["bias"].dtype) == (torch.float16, torch.float32)
    assert wide["big"].dtype == torch.float32
    assert all(torch.equal(kept[name].to(wide[name].dtype), wide[name]) for name in wide)


def test_no_part_is_larger_than_the_limit(checkpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "PART_BYTES", 10_000)
    folder = checkpoints.write({**checkpoint, "state_dict": {str(i): torch.randn(50, 40) for i in range(9)}}, tmp_path)
    parts = list(folder.glob("*.safetensors"))
    assert len(parts) > 1
    assert all(part.stat().st_size < 12_000 for part in parts)
    assert len(checkpoints.read(folder)["state_dict"]) == 9


def whole(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("full", range(3), ids=["first part", "second part", "config.json"])
def test_a_release_that_was_there_stays_whole_where_the_new_one_is_not(checkpoint, tmp_path, monkeypatch, full):
    folder = checkpoints.write(checkpoint, tmp_path / "m")
    (folder / "README.md").write_text("a card")
    before = whole(folder)
    monkeypatch.setattr(checkpoints, "PART_BYTES", 10_000)  # two parts
    other = {**checkpoint, "state_dict": {str(i): torch.randn(50, 40) for i in range(4)}}
    write_whole, written = checkpoints.write_whole, []

    def until_the_disk_is_full(*args, **kwargs):
        written.append(args)
        if len(written) > full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write_whole(*args, **kwargs)

    monkeypatch.setattr(checkpoints, "write_whole", until_the_disk_is_full)
    with pytest.raises(CannotWrite, match="the disk is full"):
        checkpoints.write(other, folder)
    assert len(written) == full + 1 and whole(folder) == before
    full = math.inf
    assert len(checkpoints.read(checkpoints.write(other, folder))["state_dict"]) == 4
    monkeypatch.undo()
    checkpoints.write(checkpoint, folder)
    assert whole(folder).keys() == {"README.md", "config.json", "weights-01.safetensors"}


def test_a_damaged_part_is_named(checkpoint, tmp_path):
    folder = checkpoints.write(checkpoint, tmp_path)
    part = folder / "weights-01.safetensors"
    part.write_bytes(part.read_bytes()[:-1] + b"\0")
    with pytest.raises(ValueError, match=r"weights-01\.safetensors is damaged"):
        checkpoints.read(folder)
    part.unlink()
    with pytest.raises(ValueError, match="is missing"):
        checkpoints.read(folder)


def test_a_later_format_is_refused(checkpoint, tmp_path):
    folder = checkpoints.write(checkpoint, tmp_path)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "format": 99}))
    with pytest.raises(ValueError, match="format 99"):
        checkpoints.read(folder)
    (folder / "config.json").write_text(json.dumps({"format": 99, "files": {}}))  # it may hold anything else
    with pytest.raises(ValueError, match="weights format 99, this version reads up to 1"):
        checkpoints.read(folder)


@pytest.mark.parametrize(
    ("value", "said"),
    [(float("nan"), "big: holds NaN"), (7e4, r"big: holds up to 7e\+04, which float16 does not hold")],
)
def test_weights_that_are_no_numbers_in_a_release_are_refused(value, said, checkpoint, tmp_path):
    folder = checkpoints.write(checkpoint, tmp_path)
    before = (folder / "config.json").read_bytes()
    checkpoint["state_dict"]["big"] = torch.full((2, 3), 0.5)
    checkpoint["state_dict"]["big"][1, 2] = value
    with pytest.raises(ValueError, match=said):
        checkpoints.write(checkpoint, folder)
    assert (folder / "config.json").read_bytes() == before
    checkpoint["state_dict"]["big"] = torch.full((2, 3), -float("inf"))  # a mask's own
    assert bool(checkpoints.read(checkpoints.write(checkpoint, folder))["state_dict"]["big"].isinf().all())


@pytest.mark.parametrize("change", [{"format": "one"}, {"hyper_parameters": None}, {"parts": 3}, {"parts": [{}]}])
def test_a_damaged_configuration_is_named(change, checkpoint, tmp_path):
    folder = checkpoints.write(checkpoint, tmp_path)
    config = json.loads((folder / "config.json").read_text())
    config.pop("sha256")
    (folder / "config.json").write_text(json.dumps(config | change))
    with pytest.raises(ValueError, match=r"config\.json is damaged"):
        checkpoints.read(folder)


def test_a_file_of_motion_and_the_own_folder_are_no_checkpoints(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    empty_scene(1, 4, 2, torch.zeros(())).save(tmp_path / "duet.npz")
    (tmp_path / "duet.csv").write_text("a_x,a_y,a_z\n")
    assert set(named_files.READ) == set(reading.READ)
    assert set(checkpoints.MOTION) == set(reading.READ) - {".pt"}  # which checkpoints may end in, too
    for name in ("duet.npz", *(f"duet{suffix}" for suffix in checkpoints.MOTION)):
        (tmp_path / name).touch()
        with pytest.raises(ValueError, match=f"{name}: is a file of motion, expected a checkpoint"):
            checkpoints.read(name)
    with pytest.raises(ValueError, match="neither the folder of a released model"):
        checkpoints.read(".")


def test_no_name_is_no_checkpoint():
    with pytest.raises(ValueError, match="not a file, nor a model that comes with the package"):
        checkpoints.resolve("")


class Evil:
    def __reduce__(self):
        return print, ("code has run",)


def test_foreign_code_in_a_checkpoint_is_not_run(tmp_path, capsys):
    path = tmp_path / "evil.ckpt"
    path.write_bytes(pickle.dumps({"state_dict": Evil()}))
    with pytest.raises(ValueError, match="not a checkpoint that can be read safely"):
        checkpoints.read(path)
    torch.save({"state_dict": Evil()}, path)
    with pytest.raises(ValueError, match="not a checkpoint that can be read safely"):
        CheckpointIO().load_checkpoint(path)
    assert "code has run" not in capsys.readouterr().out


def test_an_unknown_name_says_which_there_are():
    with pytest.raises(ValueError, match="no checkpoint no_such: not a file, nor a model"):
        checkpoints.resolve("no_such")


@pytest.mark.parametrize("name", ["last", "best", "latest"])
def test_what_the_command_calls_checkpoints_of_its_folder_is_told_how_to_be_named(name: str):
    with pytest.raises(ValueError, match=rf"^no checkpoint {name}: .*; give a run's folder, such as runs/NAME/latest"):
        checkpoints.resolve(name)
