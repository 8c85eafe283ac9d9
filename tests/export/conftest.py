"""A small scene, and pixels counted by hue."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from PIL import Image

from magnet.body import Body, load_body
from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture(scope="session")
def body() -> Body:
    return load_body("open")


@pytest.fixture(scope="session")
def blender() -> str:
    """A Python that has Blender as its module `bpy`: this one, or the one that MAGNET_BLENDER names.

    bpy asks for one Python version and an older NumPy than ours, so it mostly lives in an environment of its own.
    """
    python = os.environ.get("MAGNET_BLENDER")
    if python is None:
        if importlib.util.find_spec("bpy") is None:
            pytest.skip("needs Blender's bpy: make test-blender, or MAGNET_BLENDER=PYTHON_WITH_BPY")
        python = sys.executable
    return python


@pytest.fixture
def duet() -> Scene:
    """Two people who wander for 12 frames, two metres apart."""
    scene = random_scene(1, 12, 2, torch.Generator().manual_seed(5))
    T_world_root = scene.T_world_root.clone()
    T_world_root[:, :, :, [0, 2], 3] -= T_world_root[:, :1, :, [0, 2], 3]
    T_world_root[:, :, 0, 0, 3] -= 1.0
    T_world_root[:, :, 1, 0, 3] += 1.0
    return scene.replace(T_world_root=T_world_root, names=())


@pytest.fixture(scope="session")
def pixels_like() -> Callable[[Image.Image, tuple[int, int, int]], int]:
    """How many pixels have nearly a colour's hue and are not grey, however they are lit."""

    def count(image: Image.Image, colour: tuple[int, int, int]) -> int:
        hue = np.asarray(Image.new("RGB", (1, 1), colour).convert("HSV"))[0, 0, 0]
        hsv = np.asarray(image.convert("RGB").convert("HSV")).astype(int)
        away = np.abs((hsv[..., 0] - int(hue) + 128) % 256 - 128)
        return int(((away < 7) & (hsv[..., 1] > 70) & (hsv[..., 2] > 60)).sum())

    return count
