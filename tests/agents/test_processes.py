"""Agents in real processes, by ZeroMQ."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet.agents.agent import poses_of
from magnet.agents.message import POSE, Message, pack, unpack
from magnet.agents.zeromq import Link, engine, make_keys
from magnet.cli import agent
from magnet.cli.agent import peers
from magnet.cli.errors import CommandError
from magnet.datamodules.fakes.body import write_body
from magnet.denoiser.module import Denoiser
from magnet.generation.rollout import generate
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.testing import random_scene, tiny_denoiser
from tests.agents.addresses import addresses_of, ports
from tests.denoiser.test_module import save
from tests.scripts import module_at

Lossy = module_at(Path(__file__).parents[2] / "benchmarks" / "agents.py").Lossy

DOCS = Path(__file__).parents[2] / "docs" / "agents.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A small model and a start scene."""
    folder = tmp_path_factory.mktemp("agents")
    save(tiny_denoiser(max_agents=4, window=8), folder / "model.ckpt")
    random_scene(1, 24, 4, torch.Generator().manual_seed(5)).save(folder / "four.npz")
    random_scene(1, 24, 2, torch.Generator().manual_seed(5)).save(folder / "two.npz")
    return folder


def started(folder: Path, people: int, name: str, addresses: dict[str, str], *more: str) -> subprocess.Popen:
    scene = {2: "two.npz", 4: "four.npz"}[people]
    words = [
        sys.executable,
        "-m",
        "magnet",
        "agent",
        "--name",
        name,
        "--scene",
        scene,
        "--listen",
        addresses[name],
    ]
    for other in sorted(set(addresses) - {name}):
        words += ["--connect", f"{other}={addresses[other]}"]
    words += ["--model", "model.ckpt", "--steps", "2", "--out", f"{name}.npz", "--report", f"{name}.json", *more]
    return subprocess.Popen(words, cwd=folder, env={**os.environ, "OMP_NUM_THREADS": "1"})


@pytest.mark.slow
@pytest.mark.parametrize("task", ["agentic_sync", "agentic_async"])
def test_two_processes_make_what_one_makes_bit_for_bit(folder, task):
    addresses = addresses_of("AB")
    exact = ("--task", task, "--pace", "others", "--precision", "reference", "--seconds", "2", "--patience", "60")
    both = [started(folder, 2, name, addresses, *exact, "--meet", "120") for name in "AB"]
    assert [each.wait(300) for each in both] == [0, 0]
    start = Scene.load(folder / "two.npz")
    plan, options = (
        AgenticSync() if task == "agentic_sync" else AgenticAsync(),
        SamplerOptions(2, precision="reference"),
    )
    model = Denoiser.load(folder / "model.ckpt")
    whole = generate(model, start, plan, 24, 60, 1, options, torch.Generator().manual_seed(0)).slice(24)
    for slot, name in enumerate("AB"):
        told = poses_of(whole.permute_agents(torch.tensor([slot])))
        made = poses_of(Scene.load(folder / f"{name}.npz"))
        assert (torch.from_numpy(made) - torch.from_numpy(told)).abs().max() < 1e-6
        assert json.loads((folder / f"{name}.json").read_text())["gaps"] == 0


@pytest.mark.slow
def test_three_go_on_when_one_is_killed_and_it_comes_back(folder):
    addresses = addresses_of("ABCD")
    meet = ("--meet", "120")
    group = {name: started(folder, 4, name, addresses, *meet, "--seconds", "900") for name in "ABCD"}
    link = Link("watcher", f"tcp://127.0.0.1:{ports(1)[0]}", addresses)
    seen: dict[str, int] = {}

    def watch(until, seconds: float = 300) -> None:
        end = time.monotonic() + seconds
        while not until() and time.monotonic() < end:
            for peer, parts in link.receive(0.2):
                message = unpack(parts)
                if message.kind == "frames" and message.agent == peer:
                    seen[peer] = message.frame
        assert until(), seen

    watch(lambda: all(seen.get(name, 0) > 40 for name in "ABCD"))
    os.kill(group["D"].pid, signal.SIGKILL)
    group["D"].wait()
    at = dict(seen)
    watch(lambda: all(seen[name] > at[name] + 40 for name in "ABC"))
    group["D"] = started(folder, 4, "D", addresses, *meet, "--seconds", "4")
    watch(lambda: seen["D"] > at["D"] + 40)
    assert group["D"].wait(120) == 0
    for name in "ABC":
        group[name].send_signal(signal.SIGTERM)
    assert [group[name].wait(120) for name in "ABC"] == [0, 0, 0]
    link.close()
    back = json.loads((folder / "D.json").read_text())
    assert back["joined"] * 4 >= at["D"] and back["tokens"] == 30 and back["refused"] == {}


def client_in_the_docs(folder: Path) -> None:
    """Write it down as client.py."""
    block = next(part.split("```")[0] for part in DOCS.read_text().split("```python\n")[1:] if "OTHERS" in part)
    assert "import magnet" not in block and sum(bool(line.strip()) for line in block.splitlines()) <= 60
    (folder / "client.py").write_text(block)


@pytest.mark.parametrize("come_to", [{"A": 9}, {"A": 9, "C": 999}, {"A": 9, "C": 999, "D": 9}])
def test_the_client_in_the_docs_begins_where_two_others_are_or_the_only_one(come_to: dict[str, int], tmp_path) -> None:
    """And not with what it is told of before, nor where one alone has run ahead."""
    client_in_the_docs(tmp_path)
    addresses = addresses_of("".join(["B", *come_to]))
    links = {name: Link(name, addresses[name], {"B": addresses["B"]}) for name in come_to}
    words = [sys.executable, "client.py", "B", *(addresses[name] for name in ("B", *come_to))]
    client = subprocess.Popen(words, cwd=tmp_path)
    poses, begun, end = np.zeros((4, POSE), np.float32), None, time.monotonic() + 60
    while begun is None and time.monotonic() < end:
        for name, link in links.items():
            for _, parts in link.receive(0.05):
                message = unpack(parts)
                begun = message.frame if begun is None and message.kind == "frames" else begun
                link.send(pack(Message("hello", name, name, 1, -1, 0.0)))
                for index in range(come_to[name] - 9, come_to[name] + 1) if set(message.heard) == set(come_to) else ():
                    link.send(pack(Message("frames", name, name, 1, 4 * index, 0.0, poses=poses)))
    client.kill()
    client.wait()
    for link in links.values():
        link.close()
    assert begun == 40


@pytest.mark.slow
def test_the_client_in_the_docs_is_heard_and_hears(folder):
    """As it stands there, in a process of its own, without this package."""
    client_in_the_docs(folder)
    addresses = addresses_of("AB")
    agent = started(folder, 2, "A", addresses, "--seconds", "3", "--meet", "6")
    client = subprocess.Popen(
        [sys.executable, "client.py", "B", addresses["B"], addresses["A"]],
        cwd=folder,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert agent.wait(180) == 0
    client.kill()
    heard = client.communicate()[0].splitlines()
    report = json.loads((folder / "A.json").read_text())
    assert report["taken"] > 3 and report["refused"] == {} and report["tokens"] == 22
    assert len(heard) > 3 and heard[-1].startswith("A ")


def test_keys_that_are_there_stay_and_those_that_are_not_are_named(tmp_path, capsys):
    assert agent.main(["--name", "A", "--make_keys", "--keys", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert f"{tmp_path / 'A.key'}, which the others need" in said
    assert f"{tmp_path / 'A.key_secret'}, which stays here" in said
    before = (tmp_path / "A.key_secret").read_text()
    with pytest.raises(ValueError, match=r"A\.key_secret is there already"):
        make_keys(tmp_path, "A")
    assert (tmp_path / "A.key_secret").read_text() == before
    with pytest.raises(ValueError, match=r"got '\.\./evil'"):
        make_keys(tmp_path / "keys", "../evil")
    with pytest.raises(ValueError, match=r"B\.key is missing"):
        Link("A", "tcp://127.0.0.1:5601", {"B": "tcp://127.0.0.1:5602"}, tmp_path)


@pytest.mark.parametrize(
    ("connect", "said"),
    [
        (["B=tcp://127.0.0.1:99999"], "got port 99999, expected 1 to 65535"),
        (["B=tcp://127.0.0.1:5601"], "that is this agent's own"),
        (["B=tcp://127.0.0.1:5602", "B=tcp://127.0.0.1:5603"], "B is said twice"),
        (["X=tcp://127.0.0.1:5602"], "with a name of B, C"),
    ],
)
def test_addresses_that_cannot_be_are_refused(connect, said):
    with pytest.raises(CommandError, match=re.escape(said)):
        peers(connect, ("A", "B", "C"), "A", "tcp://127.0.0.1:5601")


def relayed(stop: threading.Event, source: str, address: str, lossy: Lossy) -> None:
    """Hand on what an agent tells, but for what a bad line loses, makes late and reorders; a turn is 30 ms."""
    zmq = engine()
    context = zmq.Context()
    inn, out = context.socket(zmq.SUB), context.socket(zmq.PUB)
    inn.subscribe(b"")
    inn.connect(source)
    out.bind(address)
    while not stop.is_set():
        turn = int(time.monotonic() / 0.03)
        if inn.poll(10):
            lossy.send(0, inn.recv_multipart(), turn)
        for parts in lossy.due(0, turn):
            out.send_multipart(parts)
    context.destroy(linger=0)


@pytest.mark.slow
def test_over_a_bad_line_processes_go_on_and_fill_in_what_was_late(folder):
    """A fifth of the messages is lost, the rest 60 to 240 ms late and out of order."""
    addresses, behind = addresses_of("AB"), addresses_of("AB")
    stop = threading.Event()
    both = []
    for name, other in ("AB", "BA"):
        line = Lossy(0.2, 2, 6, torch.Generator().manual_seed(len(both)))
        threading.Thread(target=relayed, args=(stop, addresses[name], behind[name], line), daemon=True).start()
        seen = {name: addresses[name], other: behind[other]}
        both.append(started(folder, 2, name, seen, "--seconds", "8", "--meet", "120"))
    assert [each.wait(300) for each in both] == [0, 0]
    stop.set()
    reports = [json.loads((folder / f"{name}.json").read_text()) for name in "AB"]
    for report in reports:
        assert report["tokens"] == 60 and report["refused"] == {} and report["taken"] > 30
    assert sum(report["gaps"] for report in reports) > 0 and sum(report["filled"] for report in reports) > 0


def test_an_agent_who_hears_nobody_says_so(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("magnet.cli.agent.take_part", lambda *_: None)
    words = ["--name", "A", "--scene", str(folder / "two.npz"), "--model", str(folder / "model.ckpt")]
    assert agent.main([*words, "--listen", addresses_of("A")["A"]]) == 0
    assert "A runs alone, and hears nobody: --connect B=tcp://HOST:PORT" in capsys.readouterr().err


def test_agents_may_be_threads(folder: Path, tmp_path: Path) -> None:
    scene, where = str(folder / "two.npz"), addresses_of("AB")
    words = ["--scene", scene, "--play", scene, "--pace", "others", "--seconds", "0.5"]
    with ThreadPoolExecutor(2) as threads:  # as in a notebook
        for name, other in ("AB", "BA"):
            place = ["--listen", where[name], "--connect", f"{other}={where[other]}", "--out", str(tmp_path / name)]
            threads.submit(agent.main, [*words, "--name", name, "--person", str("AB".index(name)), *place])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["A.npz", "B.npz"]


@pytest.mark.parametrize("trained", ["smplx-neutral", "open-1"])
def test_an_agent_whose_model_learned_from_another_body_says_so(
    trained: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tiny_denoiser(max_agents=4, window=8)
    model.trained_body = trained
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda _: model)
    monkeypatch.setattr("magnet.cli.agent.take_part", lambda *_: None)
    assert agent.main(["--name", "A", "--scene", str(folder / "two.npz"), "--listen", addresses_of("A")["A"]]) == 0
    said = "magnet: the model was trained with body 'smplx-neutral', but these people have 'open-1', "
    assert (said in capsys.readouterr().err) == (trained != "open-1")


def test_people_of_another_body_take_part_once_its_file_is_said_and_are_written_as_theirs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magnet.cli.agent.signal.signal", lambda *_: None)
    scene = random_scene(1, 24, 2, torch.Generator().manual_seed(5)).replace(body="made-up-smplx")
    start, made = str(scene.save(tmp_path / "start.npz")), tmp_path / "made.npz"
    words = ["--name", "A", "--scene", start, "--play", start, "--meet", "0", "--pace", "others", "--out", str(made)]
    words += ["--listen", addresses_of("A")["A"]]
    with pytest.raises(ValueError, match=r"'made-up-smplx'.* give its file: --body FILE"):
        agent.main(words)
    assert agent.main([*words, "--body", str(write_body(tmp_path / "body.npz"))]) == 0
    assert Scene.load(made).body == "made-up-smplx"
