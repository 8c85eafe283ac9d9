"""Made-up downloads of the data set that a test module is called after, such as test_dd100; and a small store."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from magnet.datamodules import catalogue
from magnet.datamodules.preparing.canonicalize import Steps
from magnet.datamodules.preparing.convert import Order
from magnet.datamodules.preparing.prepare import prepare
from tests.datamodules.made import ENTRY, NAME, write


@pytest.fixture(scope="module")
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`TAKES` takes of `FRAMES` frames, for tests that change nothing."""
    module = request.module
    name = module.__name__.rpartition("test_")[2]
    root = tmp_path_factory.mktemp(name)
    catalogue.NAMES[name].load_fake()(root, module.TAKES, module.FRAMES)
    return root


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """The same, to be changed."""
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture(scope="module")
def known() -> Iterator[None]:
    """The catalogue has the made-up data set."""
    catalogue.NAMES[NAME] = ENTRY
    yield
    del catalogue.NAMES[NAME]


@pytest.fixture(scope="module")
def store(known: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty takes of two people in shards of two takes each, twelve of them to train on."""
    folder = tmp_path_factory.mktemp("store")
    body = write(folder / "dl", takes=20, frames=80, more=0)
    order = Order(NAME, str(folder / "dl"), {}, str(body), Steps())
    prepare(order, folder / "store", shard_rows=350)
    return folder / "store"
