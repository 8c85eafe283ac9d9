"""What several tests of the command share."""

from pathlib import Path

import pytest

from magnet.cli import train
from magnet.datamodules import registry
from tests.toys import OtherData, ToyData


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty working folder, and toys in place of the real models and data."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MAGNET_DEBUG", raising=False)
    monkeypatch.setattr(train, "MODELS", {"ToyModel": "tests.toys"})
    monkeypatch.setattr(registry, "classes", lambda: {"ToyData": ToyData, "OtherData": OtherData})
    return tmp_path
