"""Files of motion that are not read: each is refused with the way to one that is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magnet.datamodules.bvh import BVHReader
from magnet.errors import DataError
from magnet.export.reading import READ, read
from magnet.export.unread import ADVICE, advice_for


@pytest.mark.parametrize("suffix", ADVICE)
def test_a_file_of_another_kind_is_refused_with_what_to_do(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"take{suffix}"
    path.touch()
    with pytest.raises(ValueError, match="cannot read") as caught:
        read(path)
    assert str(caught.value).endswith(f"{suffix}: {ADVICE[suffix]}") and "\n" not in str(caught.value)
    assert suffix not in READ
    with pytest.raises(DataError, match=r"no \.bvh file") as caught:
        BVHReader(tmp_path)
    assert str(caught.value).endswith(ADVICE[suffix])


def test_positions_in_an_npz_are_sent_to_a_table(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", joints=np.zeros((4, 22, 3)), fps=30)
    with pytest.raises(ValueError, match=r"lacks poses, transl; .*positions of joints are read from a table, .csv"):
        read(tmp_path / "a.npz")
    assert advice_for([".npz"]) == ""
