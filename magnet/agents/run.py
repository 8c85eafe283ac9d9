"""An agent's process: it meets the others, keeps their pace, and goes on whatever of them is late or lost."""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from magnet.agents.agent import PAST, Member
from magnet.agents.gate import GONE, Gate
from magnet.agents.message import TOKEN, Message, pack
from magnet.agents.news import News
from magnet.motion.scene import FPS

PERIOD = TOKEN / FPS
"""Seconds of a token."""
HELLO = 0.1
"""Seconds between two hellos of who has not begun."""
GATHER = 0.5
"""Seconds for which somebody who comes back listens to what it is told."""
AT_ONCE = 2
"""Tokens that others may be ahead when one begins with them; where they are further, it joins them."""
PULL = 0.1
"""Share of the difference to the others' pace that is taken up with each token."""
MOST = 0.005
"""Seconds that are taken up with each token, at most."""
LOST = 1.0
"""Seconds behind after which one's own clock is set anew, and after which one goes on where the others are."""
RECENT = 32
"""Tokens, four seconds, of which what they took says what the next one takes."""
AWAY = GONE / FPS
"""Seconds after which who has told nothing counts no longer."""


class Channel(Protocol):
    """What messages pass by: `magnet.agents.zeromq.Link`, or a test's."""

    def send(self, parts: list[bytes]) -> None: ...
    def receive(self, seconds: float) -> list[tuple[str, list[bytes]]]: ...


@dataclass
class Pace:
    """When tokens are due: so that all keep one pace though their clocks do not.

    Each agent compares how late after their time the others' tokens come with how late its own are sent, which it tells
    them, and moves its clock a little towards the middle of all, or towards the other's where there is one. So one
    alone whose clock is wrong moves nobody's in a group. No clock is ever read by another. What two tell each other
    of their lags differs by twice what their clocks do; what is common to both is the way of a message, for which
    nobody waits. Of who tells no lag, as another program, all of it counts.

    Args:
        start: when token `first` is due, in seconds.
        first: a token.

    Attributes:
        lateness: of those who are heard, in seconds.
        lags: by how much later they come than one's own were sent, in seconds.
        resets: how often the clock was set anew, being behind.
        lost: seconds by which it was, together.
    """

    start: float
    first: int = 0
    lateness: dict[str, float] = field(default_factory=dict)
    lags: dict[str, float] = field(default_factory=dict)
    resets: int = 0
    lost: float = 0.0
    _told: dict[str, float] = field(default_factory=dict, init=False, repr=False)
    _theirs: dict[str, float | None] = field(default_factory=dict, init=False, repr=False)

    def due(self, index: int) -> float:
        return self.start + (index - self.first) * PERIOD

    def reached(self, at: float) -> int:
        """The token that one would be at, had one never been late."""
        return self.first + math.floor((at - self.start + self.lost) / PERIOD)

    def heard(self, name: str, index: int, at: float, lag: float | None = None) -> None:
        """A token of somebody has come, who says by how much later they hear oneself than they tell."""
        now = at - self.due(index)
        if abs(now) < LOST:
            self._theirs[name] = lag if lag is not None and abs(lag) < LOST else None
            self.lateness[name], self._told[name] = 0.7 * self.lateness.get(name, now) + 0.3 * now, at

    def sent(self, index: int, at: float) -> float:
        """An own token has been sent. Returns by how much it was late."""
        late = at - self.due(index)
        self.lateness = {name: each for name, each in self.lateness.items() if at - self._told[name] <= AWAY}
        self.lags = {name: each - late for name, each in self.lateness.items()}
        if late > LOST:
            self.start, self.lost, self.resets = self.start + late, self.lost + late, self.resets + 1
            self.lateness.clear()
            self.lags.clear()
        elif self.lags:
            offs = [lag if (one := self._theirs[name]) is None else (lag - one) / 2 for name, lag in self.lags.items()]
            off = statistics.median(offs if len(offs) == 1 else [*offs, 0.0])
            self.start += max(-MOST, min(MOST, PULL * off))
        return late


@dataclass
class Report:
    """What an agent's process has to say in the end.

    Attributes:
        tokens: how many were made.
        late: how many of them after they were due.
        joined: the first token, where others had begun before.
        jumps: how often it went on where the others were, having fallen behind.
        speed: see `Process`; what is reported is in real time but for lateness, which is in the scene's.
    """

    tokens: int = 0
    late: int = 0
    joined: int = 0
    jumps: int = 0
    speed: float = 1.0
    took: deque[float] = field(default_factory=lambda: deque(maxlen=10_000))
    lateness: deque[float] = field(default_factory=lambda: deque(maxlen=10_000))

    def cost(self) -> float:
        """Seconds that a token takes as things are: the middle of the last ones."""
        return statistics.median(itertools.islice(reversed(self.took), RECENT)) if self.took else 0.0

    def told(self, member: Member, gate: Gate, pace: Pace | None) -> dict[str, Any]:
        """All counts, JSON-ready."""
        took, late = sorted(self.took), sorted(self.lateness)
        middle = 1000 * statistics.median(took) / self.speed if took else None
        return {
            "tokens": self.tokens, "joined": self.joined, "next": member.next, "late": self.late, "jumps": self.jumps,
            "late_ms_p99": 1000 * late[int(0.99 * len(late))] if late else None,
            "late_ms_most": 1000 * late[-1] if late else None, "made_in_ms": middle,
            "gaps": member.gaps, "filled": member.filled,
            "taken": gate.taken, "passed_over": gate.passed_over, "refused": dict(gate.refused),
            "resets": pace.resets if pace else 0,
        }  # fmt: skip

    def lag(self) -> str | None:
        """What to do where most tokens came late; None: they did not."""
        if 2 * self.late <= self.tokens:
            return None
        made = f", each made in {1000 * statistics.median(self.took) / self.speed:.0f} ms" if self.took else ""
        return (
            f"{self.late} of {self.tokens} tokens came late{made}, where {1000 * PERIOD / self.speed:.0f} ms are due: "
            "give all agents a lower --speed, or this one --settle off or fewer --steps"
        )


class Process:
    """An agent's process.

    Args:
        member: who takes part.
        link: what messages pass by.
        gate: what lets them in.
        others: whom to meet.
        real_time: keep the pace of the motion; False: as fast as the others' tokens come.
        patience: seconds to wait for a token of somebody, without real time.
        meet: seconds to wait for the others to come.
        session: when this process began, in nanoseconds.
        clock: seconds of a clock that does not go back.
        speed: seconds of the scene in a second of the clock, the same for all: less than 1 where processors are slow.
        kept: called with each own message.
        say: told in a line what happens.
    """

    def __init__(
        self,
        member: Member,
        link: Channel,
        gate: Gate,
        others: set[str],
        real_time: bool = True,
        patience: float = 5.0,
        meet: float = 30.0,
        session: int | None = None,
        clock: Callable[[], float] = time.monotonic,
        kept: Callable[[Message], object] = lambda _: None,
        speed: float = 1.0,
        say: Callable[[str], object] = lambda _: None,
    ) -> None:
        self.member, self.link, self.gate, self.others = member, link, gate, others
        self.real_time, self.patience, self.meet, self.kept = real_time, speed * patience, speed * meet, kept
        self.clock: Callable[[], float] = lambda: speed * clock()
        self.session = time.time_ns() if session is None else session
        self.name = member.names[member.me]
        self.pace: Pace | None = None
        self.report, self.news = Report(speed=speed), News(say)
        self._heard: set[str] = set()
        self._heard_by: set[str] = set()
        self._running: dict[str, float] = {}  # who tells its frames, and when it last did
        self._answered: Counter[str] = Counter()

    def listen(self, seconds: float) -> None:
        """Take in what comes within some time of the scene, and what has come."""
        for peer, parts in self.link.receive(seconds / self.report.speed):
            at = self.clock()
            message = self.gate.take(parts, at, peer)
            if message is None:
                if self.gate.reason:
                    self.news.refused(peer, self.gate.reason)
                continue
            self._heard.add(message.sender)
            if message.kind == "hello":
                if self.name in message.heard:
                    self._heard_by.add(message.sender)
                if self.pace is not None:
                    self._answer(message, at)
                continue
            if message.agent == message.sender:
                self._hear(message, at)
            elif self.pace is None:  # who has begun knows better where it is than others do
                self.member.hear(message)
        self.news.look(self._running, self.clock())

    def _hear(self, message: Message, at: float) -> None:
        """Frames of who tells them."""
        member, name, index = self.member, message.sender, message.frame // TOKEN
        slot = member.names.index(name)
        self._running[name] = at
        self.news.heard(name)
        if name in self.gate.strangers:
            self.news.of_other_weights(name)
        if message.frame == 0 and member.come(slot, -1):
            self.news.first_frame(name, message.poses[0], member.pieces[slot][-1].poses[-1])
        again = member.come(slot, index)  # as somebody is told who comes back, and all hear
        member.hear(message)
        if self.pace is not None and not again:
            self.pace.heard(name, index, at, message.lags.get(self.name))
            self.news.late(name, at - self.pace.due(index), at)

    def _answer(self, hello: Message, at: float) -> None:
        """Tell somebody who has come back how things are, at most every two seconds."""
        if self._answered[hello.sender] < int(at / 2.0) + 1:
            self._answered[hello.sender] = int(at / 2.0) + 1
            for message in self.member.history(self.member.names.index(hello.sender)):
                self._send(message)

    def _send(self, message: Message) -> None:
        lags = self.pace.lags if self.pace is not None and message.agent == self.name else {}
        self.link.send(pack(replace(message, session=self.session, clock=time.time(), lags=lags)))

    def _hello(self) -> None:
        self._send(Message("hello", self.name, self.name, 0, -1, 0.0, heard=tuple(sorted(self._heard))))

    @property
    def unheard(self) -> list[str]:
        """Those who should take part and of whom nothing has come."""
        return sorted(self.others - self._heard)

    def begin(self) -> None:
        """Meet the others, and begin with them; or join them where they are."""
        end = self.clock() + self.meet
        while self.clock() < end and not self._running:
            self._greet()
            if self.others <= self._heard_by:  # and who has heard one has been heard
                break
        self._hello()
        member = self.member
        met = self.others <= self._heard_by and self.others <= self._heard
        if self._running and not (met and self._there() <= AT_ONCE):  # who has just met needs not be told of before
            self._gather(GATHER)
            there = self._there()
            begun = sum(map(self._far_on, self._running)) >= min(2, len(self._running))
            late = there > AT_ONCE if self.real_time else begun
            if late:
                member.join(there + 1)
                self.report.joined = member.next
        self.pace = Pace(self.clock() + PERIOD, member.next)
        deaf = set() if self._running else self._heard - self._heard_by  # who has begun says no hello
        self.news.begins(self._heard, self.unheard, deaf, PERIOD * member.next if self.report.joined else None)

    def _there(self) -> int:
        """The newest token that two have come to, of the others and the own clock; where one other tells, its own.

        So one alone who runs ahead takes nobody along, and who is slow follows one who is on time.
        """
        now, member = self.clock(), self.member
        told = [member.names.index(name) for name, at in self._running.items() if now - at <= AWAY]
        come = sorted(last for slot in told if (last := member.last(slot)) >= 0)
        if len(come) < 2:
            return max(come, default=-1)
        return max(come[-2], min(come[-1], -1 if self.pace is None else self.pace.reached(now)))

    def _far_on(self, name: str) -> bool:
        """Whether somebody's first tokens are no longer to be had."""
        pieces = self.member.pieces[self.member.names.index(name)]
        return any(index >= 0 for index in pieces) and not all(index in pieces for index in range(max(pieces) + 1))

    def _gather(self, seconds: float) -> None:
        end = self.clock() + seconds
        while self.clock() < end:
            self._greet()

    def _greet(self) -> None:
        """Say hello, and listen until it is time to say it again: an answer to each would be answered by all."""
        again = self.clock() + HELLO
        self._hello()
        while (left := again - self.clock()) > 0:
            self.listen(left)

    def turn(self) -> bool:
        """Wait for what the next token is to see, as long as there is time, make it and tell it. False: it is over."""
        member, pace, cost = self.member, self.pace, self.report.cost()
        assert pace is not None
        if self.real_time and (behind := ((there := self._there()) - member.next) * PERIOD) > LOST:
            self.news.jumped(behind, self.clock())
            member.join(there + 1)  # too slow for them all the time, or stopped for a while
            pace = self.pace = Pace(self.clock() + PERIOD, member.next)
            self.report.jumps += 1
        index = member.next
        self.gate.now, self.gate.due = index * TOKEN, pace.reached(self.clock()) * TOKEN if self.real_time else 0
        given_up = self.clock() + self.patience
        while True:
            now = self.clock()
            if self.real_time:
                earliest, latest = pace.due(index) - PERIOD, pace.due(index) - 1.2 * cost
                wait = (latest if member.awaited() else min(earliest, latest)) - now
            else:
                wait = given_up - now if member.awaited() or self._ahead() else 0.0
            if wait <= 0:
                break
            self.listen(min(wait, 0.05))
        self.listen(0.0)
        begun = self.clock()
        message = member.step()
        if message is None:
            return False
        self._send(message)
        ended = self.clock()
        self.report.took.append(ended - begun)
        self.report.tokens += 1
        late = pace.sent(index, ended)
        if self.real_time:
            self.report.lateness.append(late)
            self.report.late += late > 0
        self.kept(message)
        return True

    def _ahead(self) -> bool:
        """Whether somebody lags a token behind and is not gone: a recording, which awaits nobody, keeps their pace."""
        told = (self.member.last(self.member.names.index(name)) for name in self._heard)
        return any(self.member.next - PAST <= last < self.member.next - 1 for last in told)

    def run(self, tokens: int | None = None) -> dict[str, Any]:
        """Take part for so many tokens, or until it is over. Returns the report."""
        self.begin()
        while (tokens is None or self.report.tokens < tokens) and self.turn():
            pass
        return self.report.told(self.member, self.gate, self.pace)
