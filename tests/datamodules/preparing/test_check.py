"""A check of a download holds one take at a time."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.preparing import check
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import ConvertedTake, PrepareJob, convert_all
from magnet.datamodules.reading.recording import Take
from tests.datamodules import made

pytestmark = pytest.mark.usefixtures("known")


def test_rows_of_takes_that_were_checked_are_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows: list[weakref.ref[np.ndarray]] = []

    def counting(*given: Any) -> Iterator[tuple[Take, ConvertedTake]]:
        for take, part in convert_all(*given):
            rows.append(weakref.ref(part.rows))
            yield take, part
            assert [each() for each in rows[:-1]] == [None] * (len(rows) - 1)

    monkeypatch.setattr(check, "convert_all", counting)
    body = str(made.write(tmp_path / "dl"))
    found = check.check_download(PrepareJob(made.NAME, str(tmp_path / "dl"), {}, body, CanonicalizeOptions()))
    assert len(rows) > 1 and found.splits and not found.skipped


def test_a_part_that_was_saved_holds_its_rows_no_longer(tmp_path: Path) -> None:
    dtype = ConvertedTake.failed("").rows.dtype
    part = ConvertedTake(None, (), ("a",), (5,), (1,), np.zeros((1, 10), np.float32), np.ones(5, dtype))
    rows = weakref.ref(part.rows)
    saved = part.saved(tmp_path / "a.npy")
    del part
    assert rows() is None and len(saved.rows) == 0
    assert len(ConvertedTake.load(tmp_path / "a.npy").rows) == 5
