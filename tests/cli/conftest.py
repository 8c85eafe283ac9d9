"""What several tests of the command share."""

from pathlib import Path

import pytest

from tests.toys import play


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty working folder, and toys in place of the real models and data."""
    return play(monkeypatch, tmp_path)
