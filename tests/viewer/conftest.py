"""Scenes and a body for the viewer's tests."""

import pytest
import torch

from magnet.body import Body, load_body
from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture(scope="session")
def body() -> Body:
    return load_body("open")


@pytest.fixture
def duet(generator: torch.Generator) -> Scene:
    """One scene of two people, 24 frames."""
    return random_scene(1, 24, 2, generator)
