"""How a process meets others and goes on with them, in a made-up time."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from magnet.agents.agent import Player
from magnet.agents.gate import Gate
from magnet.agents.message import Message, pack, unpack
from magnet.agents.run import AWAY, GATHER, PERIOD, Process, Report
from magnet.testing import random_scene


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


def test_a_hello_is_answered_once_in_two_seconds_with_what_is_known():
    line, process, member = begun()
    hello = ("A", pack(Message("hello", "A", "A", 1, -1, 0.0)))
    counts = []
    for seconds in (0.0, 0.1, 2.0, 0.1):
        line.now += seconds
        before = len(line.sent)
        hears(line, process, *[hello] * 5)
        counts.append([message.kind for _, message in line.sent[before:]])
    assert counts == [["frames"] * member.next, [], ["frames"] * member.next, []]


def test_who_awaits_nobody_tells_a_token_a_token_before_it_is_due():
    line = Line([])
    process, _ = played(line, 0)
    process.meet = 0.0
    process.begin()
    started = line.now
    for _ in range(3):
        process.turn()
    sent = [at - started for at, message in line.sent if message.kind == "frames"]
    assert sent == pytest.approx([0.0, PERIOD, 2 * PERIOD], abs=0.02)


@pytest.mark.parametrize(("there", "joined"), [(0, 0), (2, 0), (3, 4), (9, 10)])
def test_who_comes_while_the_others_begin_begins_too_and_later_joins(there, joined):
    line = Line([told("A", there), told("C", there)])
    process, member = third(line)
    process.begin()
    assert process.report.joined == member.next == joined


def test_without_a_clock_one_alone_who_is_far_on_takes_nobody_along_in_a_group():
    for coming, joined in (([told("A", 30), told("C", 0)], 0), ([told("A", 30), told("C", 20)], 21)):
        process, member = third(Line(coming))
        process.real_time = False
        process.begin()
        assert process.report.joined == member.next == joined


def test_who_has_met_all_begins_with_them_though_one_has_told_its_first_token_by_then():
    """It was a hello quicker; who listened to what had been before missed its own first tokens."""
    line = Line([])
    process, member = played(line, 1)
    line.coming.insert(0, ("A", pack(Message("hello", "A", "A", 1, -1, 0.0, heard=("B",)))))
    process.begin()
    assert member.next == 0 and process.report.joined == 0 and line.now < GATHER
    back, other = played(line, 1)  # it has not heard whom A has heard
    begun = line.now
    back.begin()
    assert other.next == 0 and line.now - begun > GATHER


def test_what_is_told_again_makes_nobody_late():
    """Who comes back is told the last ten tokens by the others, and everybody hears it."""
    line, process, _ = begun()
    hears(line, process, told("A", 1), told("C", 1))
    assert process.pace is not None
    before = dict(process.pace.lateness)
    line.now += 0.9
    hears(line, process, told("A", 1))
    assert process.pace.lateness == before
    hears(line, process, told("A", 2))
    assert process.pace.lateness["A"] > before["A"]


def test_each_token_says_how_late_the_others_are_heard_and_a_hello_does_not():
    line, process, _ = begun()
    hears(line, process, told("A", 0))
    for _ in range(2):
        process.turn()
    lags = [message.lags for _, message in line.sent]
    assert lags[:3] == [{}, {}, {}] and list(lags[-1]) == ["A"]


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


def told(name: str, index: int, **fields) -> tuple[str, list[bytes]]:
    """A token of A or C, who stand beside B all the time."""
    start, recording = (random_scene(1, frames, people, torch.Generator()) for frames, people in ((8, 3), (800, 1)))
    member = Player(recording, start, "ABC", name)
    member.next = index
    message = member.step()
    assert message is not None
    return name, pack(dataclasses.replace(message, **fields))


def third(line: Line) -> tuple[Process, Player]:
    """B, who plays a recording with A and C."""
    start, recording = (random_scene(1, frames, people, torch.Generator()) for frames, people in ((8, 3), (800, 1)))
    member = Player(recording, start, "ABC", "B")
    gate = Gate("ABC", "B", "", 0, 1e9, 1e9)
    return Process(member, line, gate, {"A", "C"}, clock=lambda: line.now, session=1), member


def begun() -> tuple[Line, Process, Player]:
    """B, who has told a token with nobody there yet."""
    line = Line([])
    process, member = third(line)
    process.meet = 0.0
    process.begin()
    assert process.turn() and member.next == 1
    return line, process, member


def hears(line: Line, process: Process, *coming: tuple[str, list[bytes]]) -> None:
    line.coming += coming
    while line.coming:
        process.listen(0.0)


def test_one_alone_who_runs_ahead_takes_nobody_along_in_a_group():
    line, process, member = begun()
    hears(line, process, told("A", 60), told("C", 1))
    assert process.turn() and member.next == 2 and process.report.jumps == 0
    hears(line, process, told("A", 70), told("C", 40))
    assert process.turn() and member.next == 42 and process.report.jumps == 1, "behind all others: where two are"


def test_who_is_left_with_one_other_goes_with_them():
    line, process, member = begun()
    hears(line, process, told("A", 60), told("C", 1))
    line.now += AWAY + 0.1
    hears(line, process, told("A", 61))
    assert process.turn() and member.next == 63 and process.report.jumps == 1


def test_who_is_slow_goes_on_with_who_is_on_time_though_another_is_slow_too():
    """A person in a headset, and two agents on one slow machine: their own clocks say that the person is right."""
    line, process, member = begun()
    for index in range(1, 30):
        line.now += 0.2  # what a token takes
        hears(line, process, told("A", int(line.now / PERIOD)), told("C", index))
        process.turn()
        if process.report.jumps:
            break
    assert 12 < index < 29 and member.next - 1 == pytest.approx(line.now / PERIOD, abs=2)
    hears(line, process, told("A", 90), told("C", member.next))
    next_, _ = member.next, process.turn()
    assert member.next == next_ + 1, "and no further than that"


def test_who_was_stopped_for_longer_than_frames_are_taken_ahead_goes_on_where_the_others_are():
    line, process, member = begun()
    line.now += 20.0
    hears(line, process, told("A", 150), told("C", 150))
    assert process.turn() and process.gate.refused == {"frame": 2}, "only now it looks at its clock"
    hears(line, process, told("A", 151), told("C", 151))
    assert process.turn() and member.next == 153 and process.report.jumps == 1
    hears(line, process, told("A", 199))
    assert process.turn() and member.next == 154
    hears(line, process, told("A", 199, frame=4 * 240))
    assert process.gate.refused == {"frame": 3}, "what is ahead of one's clock is refused as ever"


def test_who_comes_back_joins_where_two_are():
    line = Line([told("A", 90), told("C", 30)])
    process, member = third(line)
    process.begin()
    assert process.report.joined == member.next == 31


def test_what_others_tell_of_oneself_counts_only_until_one_has_begun():
    """Else anybody says where one is, for when one goes on where the others are."""
    line = Line([told("A", 30), told("A", 29, agent="B")])
    process, member = third(line)
    process.begin()
    assert process.report.joined == 31 and member.come(1, 29)
    hears(line, process, told("A", 40, agent="B"))
    assert not member.come(1, 40) and process.gate.taken == 3


class Slower(Player):
    """Waits for somebody who never tells anything; from token 400 on a token takes it six times as long as before."""

    line: Line

    def awaited(self) -> list[int]:
        return [0]

    def step(self) -> Message | None:
        self.line.now += 0.01 if self.next < 400 else 0.06
        return super().step()


def test_who_becomes_slower_after_long_is_late_for_seconds_and_then_begins_sooner():
    """As where another program takes the processor; what took little an hour ago is not what the next takes."""
    start, recording = (random_scene(1, frames, people, torch.Generator()) for frames, people in ((8, 2), (2000, 1)))
    line, member = Line([]), Slower(recording, start, "AB", "B")
    member.line = line
    process = Process(member, line, Gate("AB", "B", "", 0), {"A"}, meet=0.0, clock=lambda: line.now, session=1)
    assert process.run(400)["late"] <= 1
    at_first = process.report.late
    while process.report.tokens < 440:
        process.turn()
    became = process.report.late
    while process.report.tokens < 480:
        process.turn()
    assert became > at_first and process.report.late == became


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
    process, _ = played(Line([]), 0, 0.25)
    assert (process.patience, process.meet) == (5 / 4, 30 / 4), "who waits does so for as many real seconds"


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


@pytest.mark.parametrize("late", [0, 10, 11, 20])
def test_who_is_mostly_late_is_told_what_to_do(late):
    """In real time: at half the clock's speed a token takes twice what it takes in the scene's."""
    report = Report(tokens=20, late=late, speed=0.5)
    report.took.extend([0.1, 0.2, 0.3])
    told = report.lag()
    if late <= 10:
        assert told is None
    else:
        assert told is not None and told.startswith(f"{late} of 20 tokens came late, each made in 400 ms, where 267 ms")
        assert "--speed" in told
