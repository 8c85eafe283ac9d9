"""What an agent says while it runs of what happens to the others: a line each, when it begins and when it is over."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import numpy as np

from magnet.agents.gate import AHEAD, GONE, STEP
from magnet.agents.message import LARGEST, VERSION
from magnet.motion.scene import FPS

SELDOM = 30.0
"""Seconds for which what happens again and again is not said again."""
LATE = 2.0
"""Seconds after which a token is said to be late."""
WHY = {
    "size": f"of more or fewer than five parts, or over {LARGEST} bytes",
    "checksum": "that do not come as they were sent",
    "version": f"of another version than {VERSION}: take the same release of magnet for all",
    "header": "whose header lacks a field, has another, or holds what it cannot",
    "kind": "that are neither frames nor a hello",
    "topic": "whose topic is not their sender's",
    "shape": "that hold another number of poses than they say, or half a token",
    "sender": "from who is not at that address: compare --connect and --names",
    "agent": "of somebody who is not in the scene",
    "session": "of a process that has ended, or two take part under that name",
    "rate": "over 120 a second",
    "frame": f"of frames over {AHEAD // FPS:.0f} s away from here, or of two tokens",
    "range": "with numbers that are not finite, or of places and shapes that nobody has",
    "speed": f"in which a pelvis moves over {STEP:.0f} m from one frame to the next",
    "rotation": "with rotations that are none",
    "place": "whose token is elsewhere than its poses",
}
"""What the reasons mean by which messages are refused, as said of messages."""


class News:
    """Says what happens, each once until it changes.

    Args:
        say: is told a line.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        self.say = say
        self._jumped: float | None = None
        self._gone: set[str] = set()
        self._looked: float | None = None
        self._refused: set[str] = set()
        self._late: dict[str, float] = {}  # who is heard late, and since when; or when that was said
        self._said: set[tuple[str, str]] = set()

    def begins(
        self, there: Collection[str], missing: Collection[str], deaf: Collection[str], joined: float | None
    ) -> None:
        """It is about to make its first token.

        deaf: who is there and has not heard it; joined: seconds at which the others are, if they have begun before.
        """
        how = "begins" if joined is None else f"joins at {joined:.1f} s"
        beside = f" with {', '.join(sorted(there))}" if there else ""
        without = f", without {', '.join(sorted(missing))}, of whom nothing has come" if missing else ""
        unheard = f"; {', '.join(sorted(deaf))} did not hear it: do they connect to where it listens?" if deaf else ""
        self.say(how + beside + without + unheard)

    def heard(self, name: str) -> None:
        """Somebody has told frames."""
        if name in self._gone:
            self._gone.discard(name)
            self.say(f"{name} is back")

    def look(self, last: Mapping[str, float], at: float) -> None:
        """Whether somebody has been silent for as long as who is gone. last: when each told frames.

        Who has not looked for as long was stopped itself: what the others told is still to be read.
        """
        stopped = self._looked is not None and at - self._looked > GONE / FPS
        self._looked = at
        for name, heard in last.items():
            if at - heard > GONE / FPS and name not in self._gone and not stopped:
                self._gone.add(name)
                self.say(f"{name} is gone: nothing has come for {GONE / FPS:.1f} s")

    def jumped(self, seconds: float, at: float) -> None:
        """It goes on where the others are; who is too slow does so again and again, and says it now and then."""
        if self._jumped is None or at - self._jumped > SELDOM:
            self._jumped = at
            self.say(f"was {seconds:.1f} s behind the others, and goes on where they are")

    def late(self, name: str, seconds: float, at: float) -> None:
        """Somebody's token comes so late. Said of who stays late: lines that carry too little have it queue up."""
        if seconds < LATE:
            self._late.pop(name, None)
        elif at - self._late.setdefault(name, at) > GONE / FPS:
            self._late[name] = at + SELDOM
            self.say(f"{name} is heard {seconds:.1f} s late: the line is too slow for what it tells, or it is itself")

    def refused(self, peer: str, reason: str) -> None:
        """A message was."""
        self._refused.add(peer)
        self._once(peer, reason, f"messages of {peer} are refused ({reason}): {WHY.get(reason, 'of another form')}")

    def ends(self, unheard: Collection[str]) -> None:
        """It is over, and nothing of these has been taken."""
        for refused, line in (
            (False, "never heard {}: are addresses and keys theirs?"),
            (True, "never took anything of {}: their messages were refused"),
        ):
            if names := sorted(name for name in unheard if (name in self._refused) == refused):
                self.say(line.format(", ".join(names)))

    def of_other_weights(self, name: str) -> None:
        """Somebody's tokens are not understood."""
        self._once(name, "weights", f"{name} runs other weights: its poses are read, and not its tokens")

    def first_frame(self, name: str, told: np.ndarray, start: np.ndarray) -> None:
        """Somebody has told the first frame after the start scene, whose last had it here. (91,) each"""
        away = float(np.linalg.norm(told[:3] - start[:3]))
        if away > STEP:
            line = f"{name} begins {away:.1f} m from where the start scene has it: is it the same scene?"
            self._once(name, "start", line)

    def _once(self, name: str, what: str, line: str) -> None:
        """Say it, if nothing of the kind was said of them before."""
        if (name, what) not in self._said:
            self._said.add((name, what))
            self.say(line)
