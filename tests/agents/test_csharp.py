"""The Unity client of docs/agents.md, compiled by Mono with stand-ins for Unity and NetMQ, speaks to this package."""

from __future__ import annotations

import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from magnet.agents.gate import Gate
from magnet.agents.message import Message, pack

DOCS = Path(__file__).parents[2] / "docs" / "agents.md"
STAND_INS = Path(__file__).with_name("stand_ins.cs")


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    """The client as it stands in the docs, as a program."""
    if shutil.which("mcs") is None or shutil.which("mono") is None:
        pytest.skip("no C# compiler: Debian's package mono-mcs has one")
    folder = tmp_path_factory.mktemp("csharp")
    (folder / "client.cs").write_text(DOCS.read_text().split("```csharp\n")[1].split("```")[0])
    words = ["mcs", "-warnaserror+", "-nowarn:649,414", f"-out:{folder / 'client.exe'}", "client.cs", str(STAND_INS)]
    made = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=300)
    assert made.returncode == 0, made.stdout + made.stderr
    return folder / "client.exe"


def lines(parts: list[bytes]) -> str:
    return " ".join("." + part.hex() for part in parts) + "\n"


def test_the_unity_client_is_heard_and_shows_what_it_hears(program):
    pose = np.zeros((4, 91), np.float32)
    pose[:, 3:].reshape(4, 22, 4)[..., 3] = 1
    pose[3, :3] = 3.0, 1.0, -2.0
    pose[3, 3:7] = pose[3, 7:11] = 0.5, 0.5, -0.5, 0.5
    hello = Message("hello", "A", "A", 1, -1, 0.0)
    told = Message("frames", "A", "A", 1, 40, 0.0, poses=pose)
    process = subprocess.Popen(["mono", str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None and process.stdout is not None
    gate, taken, shown = Gate(("A", "B"), "A", "", 0), [], ""
    end = time.monotonic() + 60
    waiting = [hello, told]
    for line in process.stdout:
        if line.startswith("V "):
            shown = line
        else:
            parts = [bytes.fromhex(part[1:]) for part in line.split()[1:]]
            taken.append(gate.take(parts, time.monotonic(), "B"))
        if waiting and len(taken) > 3 * (3 - len(waiting)):
            process.stdin.write(lines(pack(waiting.pop(0))))
            process.stdin.flush()
        if len(taken) > 20 or time.monotonic() > end:
            break
    process.kill()
    process.communicate()
    assert gate.refused == {} and len(taken) > 20
    hellos = [each for each in taken if each.kind == "hello"]
    frames = [each for each in taken if each.kind == "frames"]
    assert hellos[0].heard == () and hellos[-1].heard == ("A",)
    assert [each.frame for each in frames] == list(range(44, 44 + len(frames))) and len(frames) > 5
    # its own body, mirrored: (-1, 0.95, 2) with a turn about x, each joint turned about y
    expected = [1, 0.95, 2, 0.6, 0, 0, 0.8, *([0, -0.6, 0, 0.8] * 21)]
    np.testing.assert_allclose(frames[0].poses[0], np.array(expected, np.float32), atol=1e-6)
    # the newest of the frames that it heard, mirrored
    numbers = [float(each) for each in shown.split()[1:]]
    np.testing.assert_allclose(numbers, [-3, 1, -2, *([0.5, -0.5, 0.5, 0.5] * 2)], atol=1e-6)
