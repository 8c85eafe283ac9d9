"""Takes are fitted once; what was written of them is read again, or said to be damaged."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from magnet.body import load_body
from magnet.datamodules.preparing.fit_cache import FitCache
from magnet.motion.scene import Scene
from magnet.testing import random_scene


def cache_in(folder: Path, fitted: list[str]) -> FitCache:
    def fit(take: Any, steps: Any) -> tuple[Scene, dict[str, Any]]:
        fitted.append(take.name)
        if take.name == "still":
            raise ValueError("nobody moves")
        return random_scene(1, 8, 1, torch.Generator().manual_seed(0)), {"error of markers": 0.01}

    return FitCache(folder / "fits", load_body(), lambda take: (1, take.name), fit)


def takes_in(folder: Path) -> list[Any]:
    made = []
    for name in ("walk", "still"):
        (folder / name).write_text(name)
        made.append(SimpleNamespace(name=name, files=(folder / name,)))
    return made


def test_a_take_is_fitted_once_and_again_where_its_file_changed(tmp_path: Path) -> None:
    fitted: list[str] = []
    takes = takes_in(tmp_path)
    assert cache_in(tmp_path, fitted).fill("dances", takes) == {"still": "nobody moves"}
    again = cache_in(tmp_path, fitted)
    assert again.fill("dances", takes) == {"still": "nobody moves"} and fitted == ["walk", "still"]
    walked, still = again.scene(takes[0]), again.scene(takes[1])
    assert walked is not None and walked.names == ("walk",) and still is None
    (tmp_path / "walk").write_text("another walk")
    cache_in(tmp_path, fitted).fill("dances", takes)
    assert fitted == ["walk", "still", "walk"]


def test_a_damaged_report_is_named(tmp_path: Path) -> None:
    fitted: list[str] = []
    takes = takes_in(tmp_path)
    cache = cache_in(tmp_path, fitted)
    cache.fill("dances", takes)
    report = cache.file(takes[1]).with_suffix(".json")
    for broken in ('{"error": "no', "[1"):
        report.write_text(broken)
        with pytest.raises(ValueError, match=rf"{report.name} is damaged .*: delete it and the \.npz beside it"):
            cache.lacking(takes)
    report.unlink()
    assert cache.lacking(takes) == [takes[1]]
