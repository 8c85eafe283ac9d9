"""Files that torch saved: tensors come back as arrays, no code runs, and no damage ends in a bare error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from magnet.errors import DataError
from magnet.torch_files import load_tensors


def test_tensors_come_back_as_arrays_and_all_else_as_it_was(tmp_path: Path) -> None:
    held = {
        "params": {"pose": torch.arange(6.0).reshape(2, 3).T, "fixed": torch.ones(1, 4).expand(3, 4)},
        "half": torch.tensor([1.5, 2.0], dtype=torch.bfloat16, requires_grad=True),
        "rest": [torch.arange(3), "text", 2.5, None],
    }
    for zipped in (True, False):
        torch.save(held, tmp_path / "a.pt", _use_new_zipfile_serialization=zipped)
        got = load_tensors(tmp_path / "a.pt")
        assert got["params"]["pose"].tolist() == [[0, 3], [1, 4], [2, 5]] and got["params"]["fixed"].shape == (3, 4)
        assert got["half"].dtype == np.float32 and got["half"].tolist() == [1.5, 2.0]
        assert got["rest"][0].tolist() == [0, 1, 2] and got["rest"][1:] == ["text", 2.5, None]


class Runs:
    def __reduce__(self) -> Any:
        return print, ("ran",)


def test_code_is_refused_and_not_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save({"a": Runs()}, tmp_path / "a.pt")
    with pytest.raises(DataError, match=r"a\.pt: .*which is not loaded because it can run code"):
        load_tensors(tmp_path / "a.pt")
    assert capsys.readouterr().out == ""


def test_damage_and_tensors_that_are_no_arrays_are_data_errors_that_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save({"a": torch.arange(100.0)}, path)
    whole = path.read_bytes()
    for size in range(0, len(whole), 40):
        path.write_bytes(whole[:size])
        with pytest.raises(DataError, match=r"a\.pt"):
            load_tensors(path)
    huge = torch.zeros(1).expand(10**10)
    for tensor, said in ((torch.eye(3).to_sparse(), "no plain array"), (huge, "more numbers than the file has")):
        torch.save({"a": tensor}, path)
        with pytest.raises(DataError, match=rf"a\.pt: a tensor .*{said}"):
            load_tensors(path)
    with pytest.raises(DataError, match="no such file"):
        load_tensors(tmp_path / "none.pt")
