"""Agents in processes and network namespaces of their own, through a line that delays, loses and reorders packets."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from magnet.agents.agent import poses_of
from magnet.denoiser.module import Denoiser
from magnet.generation.rollout import generate
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.tasks.agentic import AgenticAsync
from magnet.testing import random_scene, tiny_denoiser
from tests.denoiser.test_module import save
from tests.scripts import module_at

lines = module_at(Path(__file__).parents[2] / "benchmarks" / "agents_line.py")
ENV = {**os.environ, "OMP_NUM_THREADS": "1"}

SENDS = """
import socket, time
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for number in range(400):
    out.sendto(f"{number} {time.monotonic()}".encode(), ("10.7.0.2", 5601))
    time.sleep(0.002)
"""
HEARS = """
import socket, time
inn = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
inn.bind(("10.7.0.2", 5601))
inn.settimeout(5)
print("ready", flush=True)
try:
    while True:
        number, sent = inn.recv(99).split()
        print(int(number), time.monotonic() - float(sent), flush=True)
        inn.settimeout(1)
except TimeoutError:
    pass
"""


@pytest.fixture(scope="module", autouse=True)
def namespaces() -> None:
    if why := lines.refused():
        pytest.skip(f"network namespaces with a TUN device cannot be made here: {why}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A small model and a start scene."""
    folder = tmp_path_factory.mktemp("line")
    save(tiny_denoiser(max_agents=4, window=8), folder / "model.ckpt")
    random_scene(1, 24, 2, torch.Generator().manual_seed(5)).save(folder / "two.npz")
    return folder


def begun(line, folder: Path, *more: str) -> list[subprocess.Popen]:
    options = ("--model", str(folder / "model.ckpt"), "--steps", "2", "--meet", "120", *more)
    return list(lines.agents(line, folder, folder / "two.npz", "AB", options, env=ENV).values())


def test_the_line_loses_delays_and_reorders_what_passes():
    """UDP, which mends nothing: 400 packets, a fifth lost, the rest 30 to 60 ms late."""
    line = lines.BadLine(0.03, 0.03, 0.2, seed=3)
    line.start()
    hears = line.begin("10.7.0.2", [sys.executable, "-c", HEARS], stdout=subprocess.PIPE, text=True)
    assert hears.stdout is not None and hears.stdout.readline() == "ready\n"
    sends = line.begin("10.7.0.1", [sys.executable, "-c", SENDS])
    assert sends.wait(60) == 0
    told = [row.split() for row in hears.communicate(timeout=60)[0].splitlines()]
    line.stop()
    numbers, late = [int(row[0]) for row in told], [float(row[1]) for row in told]
    assert len(numbers) == len(set(numbers)) == 400 - line.lost and 40 < line.lost < 120
    assert numbers != sorted(numbers) and line.reordered > 20
    assert min(late) >= 0.03


@pytest.mark.slow
def test_through_a_bad_line_two_namespaces_make_what_one_process_makes_bit_for_bit(folder):
    """With the pace of the others nothing is missing in the end: what the line loses is sent again below."""
    line = lines.BadLine(0.02, 0.03, 0.05)
    line.start()
    exact = ("--task", "agentic_async", "--pace", "others", "--precision", "reference", "--seconds", "2")
    both = begun(line, folder, *exact, "--patience", "60")
    assert [each.wait(300) for each in both] == [0, 0]
    line.stop()
    assert line.lost > 0 and line.reordered > 0
    model, options = Denoiser.load(folder / "model.ckpt"), SamplerOptions(2, precision="reference")
    start, generator = Scene.load(folder / "two.npz"), torch.Generator().manual_seed(0)
    whole = generate(model, start, AgenticAsync(), 24, 60, 1, options, generator).slice(24)
    for slot, name in enumerate("AB"):
        told = poses_of(whole.permute_agents(torch.tensor([slot])))
        made = poses_of(Scene.load(folder / f"{name}.npz"))
        assert (torch.from_numpy(made) - torch.from_numpy(told)).abs().max() < 1e-6
        report = json.loads((folder / f"{name}.json").read_text())
        assert report["gaps"] == 0 and report["refused"] == {}


@pytest.mark.slow
def test_in_real_time_agents_go_on_through_a_bad_line_and_count_what_came_late(folder):
    """A tenth of the packets is lost, the rest 60 to 160 ms late and out of order: a token is due each 133 ms."""
    line = lines.BadLine(0.06, 0.1, 0.1)
    line.start()
    both = begun(line, folder, "--seconds", "8")
    assert [each.wait(300) for each in both] == [0, 0]
    line.stop()
    assert line.lost > 0 and line.reordered > 0
    reports = [json.loads((folder / f"{name}.json").read_text()) for name in "AB"]
    for report in reports:
        assert report["tokens"] == 60 and report["refused"] == {} and report["taken"] > 20
    assert sum(report["gaps"] for report in reports) > 0 and sum(report["filled"] for report in reports) > 0
