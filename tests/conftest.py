"""Fixtures that several rooms share."""

import gc
import os
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from magnet.motion.scene import Scene
from magnet.testing import random_scene

# Everything here is tiny: a second thread only waits for the first, and badly so on a busy machine.
torch.set_num_threads(1)

# Machines may be busy: no test is about time.
settings.register_profile("busy", deadline=None)
settings.load_profile("busy")

# What the tests' modules are made of stays to the end: to look for garbage in it again and again takes a tenth
# of the time of all tests.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)
    gc.enable()


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


@pytest.fixture
def scene(generator: torch.Generator) -> Scene:
    """Two scenes of three people, 64 frames of smooth random motion."""
    return random_scene(2, 64, 3, generator)


@pytest.fixture(scope="session")
def cmu_root() -> Path:
    """The folder of real recordings: MAGNET_CMU, or shared/data/cmu beside the repository."""
    beside = Path(__file__).parents[2] / "shared" / "data" / "cmu"
    root = Path(os.environ.get("MAGNET_CMU") or beside)  # set to nothing is not set
    if not root.is_dir():
        pytest.skip(f"no CMU recordings at {root}; set MAGNET_CMU")
    return root
