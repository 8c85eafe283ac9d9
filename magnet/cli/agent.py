"""`magnet agent --name A --scene START ...`: one agent of a scene in a process of its own, together with others."""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import signal
import string
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from magnet.cli import scene_files
from magnet.cli.errors import CommandError
from magnet.cli.flags import PlainParser

if TYPE_CHECKING:
    from magnet.agents.agent import Member
    from magnet.agents.zeromq import Link
    from magnet.motion.scene import Scene

EPILOG = """\
START is a scene of all agents, the same for all processes; a second of motion is enough. Each process generates one
agent (or plays a recording, --play) and receives the others by ZeroMQ. Tokens that are lost or late are unknown to the
model until they arrive. docs/agents.md describes the message, for other programs. Addresses of other machines need
keys: `--make_keys --keys FOLDER --name A` writes A.key, which the others need, and A.key_secret, which stays here.

for example, in two terminals:
  magnet agent --name A --scene start.npz --listen tcp://127.0.0.1:5601 --connect B=tcp://127.0.0.1:5602
  magnet agent --name B --scene start.npz --listen tcp://127.0.0.1:5602 --connect A=tcp://127.0.0.1:5601
"""
MOST_THREADS = 1024


def parser() -> argparse.ArgumentParser:
    options = PlainParser("agent", __doc__, EPILOG)
    add = options.add_argument
    add("--name", required=True, help="which agent this process is")
    add("--scene", metavar="START", help="scene of all agents to start from")
    add("--body", metavar="FILE", help="SMPL-X npz the shapes of all files belong to (default: the open body)")
    add("--names", metavar="A,B", help="all agents, in the order of the scene's slots (default: A, B, C ...)")
    add("--listen", metavar="ADDRESS", help="where the others receive from it, such as tcp://127.0.0.1:5601")
    add("--connect", action="append", default=[], metavar="NAME=ADDRESS", help="where another sends from; repeated")
    add("--task", choices=("agentic_sync", "agentic_async"), default="agentic_sync", help="in step, or in turns")
    add("--model", default=None, metavar="NAME", help="shipped model or checkpoint")
    add("--steps", type=int, default=4, help="denoising steps (default: %(default)s)")
    settle = "correct poses (default: as the model is best sampled)"
    add("--settle", choices=("off", "light", "firm", "hold"), help=settle)
    add("--precision", default=None, help="reference, float32, bf16 or int8 (default: the sampler's)")
    add("--seed", type=int, default=0, help="of the noise, the same for all (default: %(default)s)")
    add("--play", metavar="FILE", help="play the motion in this file instead of generating any")
    add("--person", type=int, default=0, help="person of that file (default: the first)")
    add("--seconds", type=float, default=None, help="how long to take part (default: until interrupted)")
    add("--pace", choices=("real", "others"), default="real", help="by the clock, or as soon as all tokens are there")
    add("--speed", type=float, default=1.0, help="of the clock of all: 0.25 is a quarter of real time (default: 1)")
    add("--patience", type=float, default=5.0, help="seconds to wait for a token with --pace others")
    add("--meet", type=float, default=30.0, help="seconds to wait for the others to connect (default: %(default)s)")
    add("--keys", type=Path, metavar="FOLDER", help="folder of CURVE keys; without them only this machine is reached")
    add("--make_keys", action="store_true", help="write this agent's keys into --keys, and stop")
    add("--threads", type=int, default=1, help="threads of torch (default: %(default)s)")
    add("--out", type=Path, metavar="NPZ", help="write the agent's own motion")
    add("--report", type=Path, metavar="JSON", help="write counts: late tokens, gaps, refused messages")
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code."""
    given = parser().parse_args(list(arguments))
    from magnet.agents import zeromq

    if given.make_keys:
        if given.keys is None:
            raise CommandError("--make_keys writes into a folder: name it with --keys FOLDER")
        secret = zeromq.make_keys(given.keys, given.name)
        print(f"written: {secret.with_suffix('.key')}, which the others need, and {secret}, which stays here")
        return 0
    if given.scene is None or given.listen is None:
        raise CommandError("--scene START and --listen ADDRESS say what to begin with and where the others hear it")
    if not 0 < given.speed <= 1:
        raise CommandError(f"--speed is {given.speed:g}, expected over 0 and at most 1, real time")
    if given.seconds is not None and not 0 < given.seconds < float("inf"):
        raise CommandError(f"--seconds is {given.seconds:g}, expected a number over 0")
    for name in ("patience", "meet"):
        if not 0 <= getattr(given, name) < float("inf"):
            raise CommandError(f"--{name} is {getattr(given, name):g}, expected seconds, 0 or more")
    if not 1 <= given.threads <= MOST_THREADS:
        raise CommandError(f"--threads is {given.threads}, expected 1 to {MOST_THREADS}")
    import torch

    from magnet.api import read
    from magnet.files import npz_path, require_place

    if given.out is not None:
        given.out = npz_path(given.out, "of it `magnet export` makes other formats")
        scene_files.require_unread(given.out, list(filter(None, (given.scene, given.play))), [1])
    for out in filter(None, (given.out, given.report)):  # written when it is over
        require_place(out)
    torch.set_num_threads(given.threads)
    start = read(given.scene, body=given.body).plain()
    names = tuple(map(str.strip, given.names.split(",") if given.names else string.ascii_uppercase[: start.agents]))
    connect = peers(given.connect, names, given.name, given.listen)
    if not connect and given.play is None and (others := [name for name in names if name != given.name]):
        print(
            f"magnet: {given.name} runs alone, and hears nobody: --connect {others[0]}=tcp://HOST:PORT, where "
            f"{others[0]} listens, connects it",
            file=sys.stderr,
        )
    member = member_of(given, start, names)
    link = zeromq.Link(given.name, given.listen, connect, given.keys, lambda line: say(given.name, line))
    try:
        take_part(given, member, link, set(connect))
    finally:
        link.close()
    return 0


def say(name: str, line: str) -> None:
    """Tell, while it runs, what happens to an agent."""
    print(f"magnet agent: {name}: {line}", file=sys.stderr, flush=True)


def peers(connect: Sequence[str], names: Sequence[str], me: str, listen: str = "") -> dict[str, str]:
    """Addresses by name."""
    found: dict[str, str] = {}
    for address in (listen, *(each.partition("=")[2] for each in connect)):
        port = re.fullmatch(r"tcp://.*:(\d+)", address)
        if port and not 1 <= int(port[1]) <= 65535:
            raise CommandError(f"{address}: got port {port[1]}, expected 1 to 65535")
    for each in connect:
        name, equals, address = each.partition("=")
        if not equals or name not in names or name == me:
            others = ", ".join(other for other in names if other != me)
            raise CommandError(f"--connect {each}: expected NAME=ADDRESS, with a name of {others}")
        if name in found or address == listen:
            whose = f"{name} is said twice" if name in found else "that is this agent's own, of --listen"
            raise CommandError(f"--connect {each}: {whose}; expected each of the others once, where it listens")
        found[name] = address
    return found


def member_of(given: argparse.Namespace, start: Scene, names: Sequence[str]) -> Member:
    """The agent, or the recording that stands for one."""
    import torch

    from magnet.agents.agent import Agent, Player
    from magnet.api import read
    from magnet.denoiser.core import DenoiserCore
    from magnet.generation.inputs import other_body
    from magnet.sampling.options import SamplerOptions
    from magnet.tasks.agentic import AgenticAsync, AgenticSync

    if given.play is not None:
        recording = read(given.play, body=given.body).plain()
        if not 0 <= given.person < recording.agents:
            raise CommandError(f"--person {given.person}: {given.play} has people 0 to {recording.agents - 1}")
        return Player(recording.permute_agents(torch.tensor([given.person])), start, names, given.name)
    asked = {name: value for name in ("precision", "settle") if (value := getattr(given, name)) is not None}
    options = SamplerOptions(steps=given.steps, **asked)
    task = AgenticSync() if given.task == "agentic_sync" else AgenticAsync()
    model = DenoiserCore.load(given.model)
    if said := other_body(model, start.body):
        print(f"magnet: {said}", file=sys.stderr)
    return Agent(model, start, names, given.name, task, options, given.seed)


def take_part(given: argparse.Namespace, member: Member, link: Link, others: set[str]) -> None:
    """Run until it is over, and write what was asked for."""
    from magnet.agents.agent import HELD, Agent, motion_told
    from magnet.agents.gate import Gate
    from magnet.agents.message import Message
    from magnet.agents.run import PERIOD, Process

    told: list[Message] = []
    code, latent = (member.print, member.model.layout.latent) if isinstance(member, Agent) else ("", 0)
    gate = Gate(member.names, given.name, code, latent)
    process = Process(
        member,
        link,
        gate,
        others,
        given.pace == "real",
        given.patience,
        given.meet,
        kept=told.append if given.out else lambda _: None,
        speed=given.speed,
        say=link.say,
    )
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):  # also where a shell began it in the background, ignoring them
            signal.signal(number, signal.default_int_handler)
    print(f"magnet agent: {given.name} is at {given.listen}   (Ctrl+C ends it)", file=sys.stderr, flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        process.run(None if given.seconds is None else round(given.seconds / PERIOD))
    process.news.ends(process.unheard)
    if lag := process.report.lag():
        print(f"magnet: {lag}", file=sys.stderr)
    report = process.report.told(member, gate, process.pace) | {"closed": dict(link.closed)}
    print(json.dumps(report))
    if given.report is not None:
        from magnet.files import write_text

        write_text(given.report, json.dumps(report, indent=1) + "\n")
    if given.out is not None and told:
        made = motion_told(told).replace(body=member.start.body)
        print(f"written: {made.save(given.out)}")
        if made.valid is not None:
            print(
                f"magnet: {int((~made.valid).sum())} of its {made.frames} frames were not made, where {given.name} "
                "joined later or went on where the others were: they are held, and marked as not valid",
                file=sys.stderr,
            )
        if left_out := told[-1].frame + len(told[-1].poses) - made.frames:
            print(
                f"magnet: {left_out} more frames that {given.name} did not make are left out, for no more than "
                f"{HELD} in a row are held: in files of the others what follows comes later by so many",
                file=sys.stderr,
            )
