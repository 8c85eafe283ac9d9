"""Made-up downloads of the data set that a test module is called after, such as test_dd100."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from magnet.datamodules.catalogue import NAMES


@pytest.fixture(scope="module")
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`TAKES` takes of `FRAMES` frames, for tests that change nothing."""
    module = request.module
    name = module.__name__.rpartition("test_")[2]
    root = tmp_path_factory.mktemp(name)
    NAMES[name].load_fake()(root, module.TAKES, module.FRAMES)
    return root


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """The same, to be changed."""
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy"
