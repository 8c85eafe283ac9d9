"""What an agent says of what happens: each in a line, and once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from magnet.agents import message as form
from magnet.agents.gate import Gate
from magnet.agents.message import Message, pack
from magnet.agents.news import WHY
from magnet.agents.run import AWAY, Process
from tests.agents.test_gate import WRONG
from tests.agents.test_run import Line, begun, hears, third, told


def saying(process: Process) -> list[str]:
    """What it says from now on."""
    said: list[str] = []
    process.news.say = said.append
    return said


def test_an_agent_says_with_whom_it_begins_and_who_is_missing():
    line = Line([("A", pack(Message("hello", "A", "A", 1, -1, 0.0)))])
    process, _ = third(line)
    process.meet, said = 1.0, saying(process)
    process.begin()
    deaf = "; A did not hear it: do they connect to where it listens?"
    assert said == ["begins with A, without C, of whom nothing has come" + deaf]
    both = [("A", pack(Message("hello", "A", "A", 1, -1, 0.0, heard=("B",))))]
    process, _ = third(Line(both))
    process.meet, said = 1.0, saying(process)
    process.begin()
    assert said == ["begins with A, without C, of whom nothing has come"]


def test_an_agent_says_where_it_joins():
    process, member = third(Line([told("A", 90), told("C", 90)]))
    said = saying(process)
    process.begin()
    assert member.next == 91 and said == ["joins at 12.1 s with A, C"]


def test_an_agent_says_who_is_gone_who_is_back_and_that_it_was_behind():
    line, process, _ = begun()
    said = saying(process)
    hears(line, process, told("A", 1), told("C", 1))
    for token in (2, 3):
        line.now += 0.6 * AWAY
        hears(line, process, told("C", token))
    process.turn()
    assert said == ["A is gone: nothing has come for 2.1 s"]
    hears(line, process, told("A", 40), told("C", 40))
    process.turn()
    assert said[1] == "A is back" and said[2].endswith(" s behind the others, and goes on where they are")
    hears(line, process, told("A", 60), told("C", 60))
    process.turn()
    assert process.report.jumps == 2 and len(said) == 3, "not each time"


def test_who_was_stopped_itself_takes_nobody_for_gone():
    """What the others told meanwhile is still to be read, of some later than of others."""
    line, process, _ = begun()
    said = saying(process)
    hears(line, process, told("A", 1), told("C", 1))
    line.now += 3 * AWAY
    hears(line, process, told("A", 40), told("C", 40))
    line.now += 0.5 * AWAY
    hears(line, process, told("A", 44))
    assert said == []


def test_an_agent_says_who_is_heard_late_for_long():
    """Over a line that carries less than is told; not of who was late once, as where one was stopped oneself."""
    line, process, _ = begun()
    said, pace = saying(process), process.pace
    assert pace is not None
    for index in range(1, 60):
        line.now = pace.due(index) + (4.0 if index < 4 or index > 20 else 0.1)
        hears(line, process, told("A", index))
    assert said == ["A is heard 4.0 s late: the line is too slow for what it tells, or it is itself"]


def test_an_agent_says_once_why_messages_of_somebody_are_refused():
    line, process, _ = begun()
    said = saying(process)
    hears(line, process, *[told("A", 1, frame=4000)] * 5, ("C", told("A", 1)[1]), ("C", [b"?"]))
    assert said == [
        "messages of A are refused (frame): of frames over 10 s away from here, or of two tokens",
        "messages of C are refused (sender): from who is not at that address: compare --connect and --names",
        "messages of C are refused (size): of more or fewer than five parts, or over 65536 bytes",
    ]


def test_each_reason_has_words():
    assert set(WRONG) | {"sender", "session", "rate"} == set(WHY)


@pytest.mark.parametrize("away", [0.2, 3.0])
def test_an_agent_says_that_another_begins_elsewhere_than_the_start_scene_has_it(away: float):
    """They began from two files: neither is where the other takes it to be."""
    line, process, member = begun()
    said, poses = saying(process), member.pieces[0][-1].poses.copy()
    poses[:] = poses[-1]
    poses[:, 0] += away
    hears(line, process, ("A", pack(Message("frames", "A", "A", 1, 0, 0.0, poses=poses))))
    poses[:, 0] += 0.5
    hears(line, process, ("A", pack(Message("frames", "A", "A", 1, 0, 0.0, poses=poses))))
    assert said == ["A begins 3.0 m from where the start scene has it: is it the same scene?"] * (away > 1)


@pytest.mark.parametrize(("own", "said"), [("feed", True), ("beef", False), ("", False)])
def test_an_agent_says_that_somebody_runs_other_weights(own: str, said: bool):
    """Not where it reads no tokens itself, as who plays a recording."""
    line = Line([])
    process, _ = third(line)
    process.gate = Gate("ABC", "B", own, 16, 1e9, 1e9)
    heard, numbers = saying(process), np.concatenate([np.zeros(16), np.tile(np.eye(4), (4, 1, 1)).ravel()])
    name, parts = told("A", 1)
    poses = np.frombuffer(parts[2], "<f4").reshape(4, form.POSE).copy()
    numbers[16:].reshape(4, 4, 4)[:, [0, 2], 3] = poses[:, [0, 2]]
    sent = Message("frames", "A", "A", 1, 4, 0.0, poses=poses, model="beef", token=numbers.astype(np.float32))
    for frame in (4, 8):
        hears(line, process, (name, pack(dataclasses.replace(sent, frame=frame))))
    assert heard == ["A runs other weights: its poses are read, and not its tokens"] * said


def test_at_the_end_it_says_of_whom_nothing_came_and_of_whom_nothing_was_taken():
    process, _ = third(Line([("A", pack(Message("hello", "A", "A", 1, -1, 0.0)))]))
    said = saying(process)
    process.news.ends([])
    process.news.refused("C", "version")
    process.news.ends(["A", "B", "C"])
    assert said[1:] == [
        "never heard A, B: are addresses and keys theirs?",
        "never took anything of C: their messages were refused",
    ]
    said.clear()
    process.news.ends(["C"])
    assert said == ["never took anything of C: their messages were refused"]
