"""The data set with a reader that the page on own recordings shows, and the example package has."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

import magnet
from magnet import cli
from magnet.body import load_body
from magnet.datamodules import registry
from magnet.datamodules.options import HeldOutScenes
from magnet.datamodules.preparing import convert
from magnet.errors import DataError
from magnet.synthesis import synthesize

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "magnet-duel"
FRAMES = 120


@pytest.fixture
def waltzes(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module, as an entry point would load it."""
    registry.discover()
    monkeypatch.syspath_prepend(EXAMPLE)
    module = importlib.import_module("magnet_duel.waltzes")
    registry.register_data("magnet-duel")(module.Waltzes)
    yield module
    registry.unregister(module.Waltzes)


@pytest.fixture
def download(tmp_path: Path) -> Path:
    """Three files as the reader expects them."""
    body, folder = load_body(), tmp_path / "waltzes"
    folder.mkdir()
    for number in range(3):
        scene = synthesize("mirror", 2, FRAMES, torch.Generator().manual_seed(number), body).scene
        np.savez(folder / f"waltz_{number}.npz", positions=body.joints(scene)[0].numpy())
    return folder


def test_the_page_shows_the_whole_module() -> None:
    text = (EXAMPLE / "magnet_duel/waltzes.py").read_text()
    shown = text.partition("from __future__ import annotations\n\n")[2]
    assert f"```python\n# magnet_duel/waltzes.py\n{shown}```" in (ROOT / "docs/own.md").read_text()


def test_the_data_set_of_the_page_without_a_reader_gives_what_its_files_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = synthesize("mirror", 2, FRAMES, torch.Generator().manual_seed(0), load_body()).scene
    monkeypatch.chdir(tmp_path)
    for slot, letter in enumerate("AB"):
        magnet.Motion.of(scene.permute_agents(torch.tensor([slot]))).save(f"take_{letter}.bvh")
    block = (ROOT / "docs/own.md").read_text().partition("```python\n# mydata.py\n")[2].partition("```")[0]
    here: dict[str, Any] = {"__name__": "mydata"}
    exec(compile(block, "mydata.py", "exec"), here)
    data = here["Mine"](test=HeldOutScenes(horizon_frames=FRAMES - 32))
    (batch,) = data.test_dataloader()
    assert batch.agents == 2 and batch.frames == FRAMES
    body = load_body()
    torch.testing.assert_close(body.joints(batch), body.joints(scene), atol=1e-3, rtol=0)


def test_it_is_listed_checked_prepared_and_trained_on(
    waltzes: ModuleType, download: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["data", "list", "waltzes"]) == 0
    assert "Waltzes of the Duellists" in capsys.readouterr().out
    assert cli.main(["data", "check", str(download), "--picture", "none", "--workers", "1"]) == 0
    store = tmp_path / "store"
    assert cli.main(["data", "prepare", "waltzes", "--root", str(download), str(store), "--workers", "1"]) == 0
    assert "--data Waltzes --data.path" in capsys.readouterr().out
    data = waltzes.Waltzes(path=str(store), window_frames=32, batch_size=2, epoch_size=2)
    (batch,) = data.train_dataloader()
    assert tuple(batch.T_world_root.shape) == (2, 32, 2, 4, 4)
    assert data.folder.clips("test")[0].name == "waltz_2"


@pytest.mark.slow
def test_several_processes_prepare_it_where_its_module_was_only_imported(
    waltzes: ModuleType, download: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(convert, "ALONE", 0)
    command = ["data", "prepare", "waltzes", "--root", str(download), str(tmp_path / "store"), "--workers", "2"]
    assert cli.main(command) == 0, capsys.readouterr().err


@pytest.mark.slow
def test_one_that_a_notebook_defines_is_prepared_there(download: Path, tmp_path: Path) -> None:
    cell = (EXAMPLE / "magnet_duel/waltzes.py").read_text(encoding="utf-8")
    command = ["data", "prepare", "waltzes", "--root", str(download), str(tmp_path / "store"), "--workers", "2"]
    cell += f"\nfrom magnet.cli import main\nraise SystemExit(main({command}))\n"  # as there, in no file
    run = subprocess.run([sys.executable, "-c", cell], capture_output=True, text=True, timeout=600, check=False)
    assert run.returncode == 0, run.stderr


def test_its_reader_says_what_is_wrong_with_a_file(waltzes: ModuleType, download: Path, tmp_path: Path) -> None:
    reader = waltzes.WaltzReader(download)
    np.savez(download / "waltz_0.npz", joints=np.zeros(3))
    with pytest.raises(DataError, match=r"waltz_0.npz has no positions, only joints; take"):
        reader.read(reader.takes()[0])
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"holds no NAME\.npz; ask"):
        waltzes.WaltzReader(tmp_path / "empty").found()
