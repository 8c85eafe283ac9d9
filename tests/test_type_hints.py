"""What type checkers and editors know of the package."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """\
import magnet
from magnet import Motion
from magnet.tokenizer import Tokenizer

motion: Motion = magnet.load("duet").generate(2, 8)
for part in (motion.slice(0, 4), motion.select([0]), motion.replace(valid=None), motion.pad_agents(3)):
    part.joints()
magnet.nothing  # wrong
magnet.tokenizer.nothing  # wrong
Tokenizer.load("duet").nothing()  # wrong
"""


@pytest.mark.slow
def test_parts_of_a_motion_are_motions_and_names_that_are_none_are_seen(tmp_path: Path) -> None:
    """In strict mode, as a user's own settings may be."""
    pytest.importorskip("mypy")
    script, settings = tmp_path / "script.py", tmp_path / "mypy.ini"
    script.write_text(SCRIPT)
    settings.write_text("[mypy]\nstrict = true\nfollow_imports = silent\n")
    command = [sys.executable, "-m", "mypy", "--config-file", str(settings), "--cache-dir", str(tmp_path), str(script)]
    told = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[1]).stdout
    wrong = [number for number, line in enumerate(SCRIPT.splitlines(), start=1) if line.endswith("# wrong")]
    assert [int(line.split(":")[1]) for line in told.splitlines() if "error:" in line] == wrong, told
