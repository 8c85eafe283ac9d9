"""Commands that scripts run one after another."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from magnet.cli.child import run_to_its_end

SAVES_SLOWLY = """
import signal, sys, time
from pathlib import Path
def end(number, frame):
    time.sleep(0.6)  # longer than subprocess.run waits
    Path("saved").write_text(str(number))
    sys.exit(5)
signal.signal(signal.SIGINT, end)
signal.signal(signal.SIGTERM, end)
Path("ready").touch()
time.sleep(60)
"""
WAITS = """
import sys
from pathlib import Path
from magnet.cli.child import run_to_its_end
sys.exit(run_to_its_end([sys.executable, "child.py"], Path(".")))
"""


def test_the_exit_code_is_the_commands_own(tmp_path: Path) -> None:
    for code in (0, 3):
        assert run_to_its_end([sys.executable, "-c", f"raise SystemExit({code})"], tmp_path) == code
    killed = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    assert run_to_its_end([sys.executable, "-c", killed], tmp_path) == 128 + signal.SIGKILL


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_who_is_interrupted_saves_before_it_ends(number: int, tmp_path: Path) -> None:
    (tmp_path / "child.py").write_text(SAVES_SLOWLY)
    (tmp_path / "waits.py").write_text(WAITS)
    root = {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    heeded = partial(signal.signal, number, signal.SIG_DFL)  # a shell's background job ignores SIGINT
    waits = subprocess.Popen([sys.executable, "waits.py"], cwd=tmp_path, env=os.environ | root, preexec_fn=heeded)
    while not (tmp_path / "ready").exists():
        assert waits.poll() is None
        time.sleep(0.02)
    waits.send_signal(number)
    assert waits.wait(30) == 5
    sent = signal.SIGTERM if number == signal.SIGHUP else number
    assert (tmp_path / "saved").read_text() == str(int(sent))
