"""A scene for the page's tests."""

from __future__ import annotations

import pytest
import torch

from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture
def duet(generator: torch.Generator) -> Scene:
    """One scene of two people, 24 frames."""
    return random_scene(1, 24, 2, generator)
