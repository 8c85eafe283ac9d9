"""The pace of a process, and how it meets others, in a made-up time."""

from __future__ import annotations

import pytest
import torch

from magnet.agents.agent import Player
from magnet.agents.gate import Gate
from magnet.agents.message import Message, pack, unpack
from magnet.agents.run import LOST, PERIOD, Pace, Process
from magnet.testing import random_scene


def drifting(rates: list[float], tokens: int, pull: bool = True) -> list[list[float]]:
    """When each agent sends each token, in true time; their clocks run at these rates, and begin a little apart."""
    paces = [Pace(0.03 * number * rate) for number, rate in enumerate(rates)]
    sent: list[list[float]] = [[] for _ in rates]
    for index in range(tokens):
        now = [pace.due(index) / rate for pace, rate in zip(paces, rates, strict=True)]
        for me, (pace, rate) in enumerate(zip(paces, rates, strict=True)):
            sent[me].append(now[me])
            for other, at in enumerate(now):
                if pull and other != me:
                    pace.heard(str(other), index, (at + 0.002) * rate)
            pace.sent(index, now[me] * rate)
    return sent


@pytest.mark.parametrize("rates", [[1.0, 1.01], [0.99, 1.0, 1.005, 1.01]])
def test_agents_keep_one_pace_though_their_clocks_drift(rates):
    """Two minutes: clocks a percent apart would be a second apart; together they stay within a token."""
    tokens = round(120 / PERIOD)
    alone, together = drifting(rates, tokens, False), drifting(rates, tokens)
    assert max(each[-1] for each in alone) - min(each[-1] for each in alone) > 1
    spread = [max(each) - min(each) for each in zip(*together, strict=True)]
    assert max(spread[30:]) < PERIOD
    assert 0.985 < (together[0][-1] - together[0][0]) / 120 < 1.015


def test_who_is_far_behind_sets_its_clock_anew():
    pace = Pace(0.0)
    assert pace.sent(0, 2 * LOST) == pytest.approx(2 * LOST)
    assert pace.resets == 1 and pace.due(1) == pytest.approx(2 * LOST + PERIOD)
    pace.heard("B", 1, pace.due(1) + 5 * LOST)  # somebody else who is far behind is not waited for
    assert not pace.lateness


class Line:
    """A link whose time passes while it is listened to; `coming` is heard at once."""

    def __init__(self, coming: list[tuple[str, list[bytes]]]) -> None:
        self.now, self.coming, self.sent = 0.0, coming, []

    def send(self, parts: list[bytes]) -> None:
        self.sent.append((self.now, unpack(parts)))

    def receive(self, seconds: float) -> list[tuple[str, list[bytes]]]:
        self.now += 0.001 if self.coming else seconds
        return [self.coming.pop(0)] if self.coming else []


def played(line: Line, coming: int, speed: float = 1.0) -> tuple[Process, Player]:
    """B, who plays a recording, and messages of A, who plays the same and is so many tokens on."""
    start, recording = (random_scene(1, frames, people, torch.Generator()) for frames, people in ((8, 2), (400, 1)))
    other, member = (Player(recording, start, "AB", name) for name in "AB")
    told = [other.step() for _ in range(coming)]
    line.coming += [("A", pack(message)) for message in told if message is not None]
    return Process(member, line, Gate("AB", "B", "", 0), {"A"}, clock=lambda: line.now, session=1, speed=speed), member


def test_hellos_are_not_answered_by_hellos():
    line = Line([])
    process, _ = played(line, 0)
    hello = Message("hello", "A", "A", 1, -1, 0.0)
    line.coming += [("A", pack(hello))] * 200
    process.meet = 1.0
    process.begin()
    assert 10 <= len(line.sent) <= 12  # one each tenth of a second, whatever comes


def test_who_has_fallen_behind_goes_on_where_the_others_are():
    line = Line([])
    process, member = played(line, 0)
    process.meet = 0.0
    process.begin()
    assert process.turn() and member.next == 1
    later, _ = played(line, 60)
    assert later.member is not member
    while line.coming:
        process.listen(0.0)
    assert process.turn()
    assert member.next == 61 and process.report.jumps == 1
    assert process.turn() and process.report.jumps == 1


def test_where_the_clock_runs_slower_tokens_are_due_later_and_nothing_else_changes():
    """Ten tokens at a quarter of real time take as long as forty."""
    took, reports = [], []
    for speed in (1.0, 0.25):
        line = Line([])
        process, _ = played(line, 0, speed)
        process.meet = 0.0
        begun = line.now
        reports.append(process.run(10))
        took.append(line.now - begun)
    assert took[1] == pytest.approx(4 * took[0], rel=0.02)
    assert reports[0]["late"] == reports[1]["late"] == 0 and reports[1]["tokens"] == 10


def test_a_recording_keeps_the_pace_of_the_others_where_that_is_asked_for():
    """What is ten seconds ahead of the others would be refused by them."""
    line = Line([])
    process, member = played(line, 0)
    process.meet, process.real_time = 0.0, False
    process.begin()
    line.coming.append(("A", pack(Message("hello", "A", "A", 0, -1, 0.0))))
    process.listen(0.0)
    assert process.turn() and line.now < 1.0
    assert process.turn() and line.now > process.patience, "A has not told its first token, and is waited for"
    told, _ = played(line, 2)
    assert told.member is not member
    begun = line.now
    assert process.turn() and member.next == 3 and line.now - begun < 1.0
    for _ in range(20):
        process.turn()
    begun = line.now
    assert process.turn() and line.now == pytest.approx(begun), "who is gone is not waited for"
