"""Made-up downloads of the data set that a test module is called after, such as test_dd100; and a small store."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from magnet.datamodules import registry
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import PrepareJob
from magnet.datamodules.preparing.prepare import prepare
from tests.datamodules.made import NAME, Made, write


@pytest.fixture(scope="module")
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`TAKES` takes of `FRAMES` frames, for tests that change nothing."""
    module = request.module
    name = module.__name__.rpartition("test_")[2]
    root = tmp_path_factory.mktemp(name)
    registry.reader(name).write_fake(root, module.TAKES, module.FRAMES)
    return root


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """The same, to be changed."""
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture(scope="module")
def known() -> Iterator[None]:
    """The registry has the made-up data set."""
    registry.register_data("tests")(Made)
    yield
    registry.unregister(Made)


@pytest.fixture(scope="module")
def store(known: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty takes of two people in shards of two takes each, twelve of them to train on."""
    folder = tmp_path_factory.mktemp("store")
    body = write(folder / "dl", takes=20, frames=80, more=0)
    order = PrepareJob(NAME, str(folder / "dl"), {}, str(body), CanonicalizeOptions())
    prepare(order, folder / "store", shard_rows=350)
    return folder / "store"
