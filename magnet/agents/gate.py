"""What is let in from the network: messages whose form, numbers, rate and sender are right, and nothing else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magnet.agents.message import POSE, TOKEN, Message, RefusedMessage, unpack
from magnet.motion.scene import FPS

FAR = 1000.0
"""Metres from the origin, at most."""
HIGH = 10.0
"""Metres that a pelvis is over or under the floor, at most."""
STEP = 1.0
"""Metres that a pelvis moves from one frame to the next, at most: 30 m/s."""
SHAPE = 10.0
"""Numbers of a body shape, at most."""
LATENT = 100.0
"""Normalized numbers of a latent, at most."""
UNIT = 1e-2
"""How far the length of a quaternion may be from 1; it is made 1 when it is read."""
AHEAD, BEHIND = 300, 300
"""Frames after and before one's own that are of use."""
GONE = 64
"""Frames, 2.1 s, after which who has told nothing may come back anywhere: models look no further back."""


class Gate:
    """Takes the parts of messages and gives those that are right.

    Args:
        names: the agents of the scene.
        me: who does not hear itself.
        model: fingerprint of one's own model; tokens of another are left out, and the poses are taken.
        latent: numbers of a latent.
        rate: messages a second that a sender may send in the long run.
        burst: messages that a sender may send at once.

    Attributes:
        taken: how many were.
        refused: how many were not, by the reason.
        reason: why the last one was not; empty: it was.
        strangers: who told tokens of other weights.
        passed_over: how many were right in form and of no use here: what somebody else who comes back is told of its
            own past, and what oneself is told of a past that is long over.
        now: own frame, about which frames of others are taken; None: any.
        due: own frame by one's own clock, about which they are taken too: who was stopped is behind it.
    """

    def __init__(
        self, names: Sequence[str], me: str, model: str, latent: int, rate: float = 120.0, burst: float = 240.0
    ) -> None:
        self.names, self.me, self.model, self.latent = tuple(names), me, model, latent
        self.rate, self.burst = rate, burst
        self.taken, self.passed_over, self.refused = 0, 0, Counter[str]()
        self.reason, self.strangers = "", set[str]()
        self.now: int | None = None
        self.due = 0
        self._sessions: dict[str, tuple[int, float]] = {}  # whose newest process that is, and when it was last heard
        self._left: dict[str, tuple[float, float]] = {}  # messages that a sender may send still, and since when
        # Where whose pelvis was by whom, by frame. What one sender tells of another binds nobody else.
        self._places: dict[tuple[str, str], dict[int, np.ndarray]] = {}

    def take(self, parts: Sequence[bytes], at: float, peer: str | None = None) -> Message | None:
        """A message, if it is right and for this agent; None, and a count more, if not.

        Args:
            parts: as they came.
            at: now, in seconds of any clock that does not go back.
            peer: who is known to be at the other end; None: not known.
        """
        self.reason = ""
        try:
            message = unpack(parts)
            self._sent_by(message, at, peer)
            if message.agent not in (message.sender, self.me) or self._over(message):
                self.passed_over += 1
                return None
            if message.model != self.model:  # who has other weights does not understand it
                self.strangers |= {message.sender} if message.model and self.model else set()
                message = replace(message, model="", token=None)
            self._numbers(message)
        except RefusedMessage as reason:
            self.reason = str(reason)
            self.refused[self.reason] += 1
            return None
        self._sessions[message.sender] = message.session, at
        self._note(message)
        self.taken += 1
        return message

    def _sent_by(self, message: Message, at: float, peer: str | None) -> None:
        sender = message.sender
        if sender not in self.names or sender == self.me or peer not in (None, sender):
            raise RefusedMessage("sender")
        if message.agent not in self.names:
            raise RefusedMessage("agent")
        session, heard = self._sessions.get(sender, (0, at))
        if message.session < session and at - heard <= GONE / FPS:  # later a clock may have gone back, as at a start
            raise RefusedMessage("session")
        left, since = self._left.get(sender, (self.burst, at))
        left = min(self.burst, left + self.rate * max(at - since, 0.0))
        self._left[sender] = (max(left - 1, 0.0), at)
        if left < 1:
            raise RefusedMessage("rate")
        if message.kind == "frames" and message.agent in (sender, self.me):
            first, last = message.frame, message.frame + len(message.poses) - 1
            if first < 0 or first // TOKEN != last // TOKEN:
                raise RefusedMessage("frame")
            if self.now is None or self._over(message):
                return
            if not self.now - BEHIND <= first <= max(self.now, self.due) + AHEAD:
                raise RefusedMessage("frame")

    def _over(self, message: Message) -> bool:
        """Whether these frames of oneself are long over: an answer to who comes back, later than its first token."""
        return self.now is not None and message.agent == self.me and 0 <= message.frame < self.now - BEHIND

    def _numbers(self, message: Message) -> None:
        poses = message.poses
        if not np.isfinite(poses).all() or max(map(abs, message.betas)) > SHAPE:
            raise RefusedMessage("range")
        place, units = poses[:, :3], poses[:, 3:].reshape(len(poses), (POSE - 3) // 4, 4)
        if (np.abs(place[:, [0, 2]]) > FAR).any() or (np.abs(place[:, 1]) > HIGH).any():
            raise RefusedMessage("range")
        if (np.linalg.norm(np.diff(place, axis=0), axis=1) > STEP).any() or self._jumps(message):
            raise RefusedMessage("speed")
        with np.errstate(over="ignore"):
            lengths = np.linalg.norm(units.astype(np.float64), axis=2)
        if (np.abs(lengths - 1) > UNIT).any():
            raise RefusedMessage("rotation")
        if message.token is not None:
            self._token(message.token, place)

    def _jumps(self, message: Message) -> bool:
        """Whether a pelvis is further from where it was taken to be, at most `GONE` frames away, than it can move."""
        known = self._places.get((message.sender, message.agent))
        if not known or not len(message.poses):
            return False
        own = message.frame + np.arange(len(message.poses))
        away = np.abs(own[:, None] - np.array(list(known)))
        moved = np.linalg.norm(message.poses[:, None, :3] - np.array(list(known.values())), axis=-1)
        return bool(((away <= GONE) & (moved > STEP * np.maximum(away, 1))).any())

    def _note(self, message: Message) -> None:
        known = self._places.setdefault((message.sender, message.agent), {})
        known.update({message.frame + n: pose[:3].copy() for n, pose in enumerate(message.poses)})
        while len(known) > AHEAD + BEHIND:
            del known[next(iter(known))]  # told first, which is not the first: else who told of far ahead may jump

    def _token(self, token: np.ndarray, place: np.ndarray) -> None:
        if len(token) != self.latent + TOKEN * 16:
            raise RefusedMessage("shape")
        if not np.isfinite(token).all() or (np.abs(token[: self.latent]) > LATENT).any():
            raise RefusedMessage("range")
        frames = token[self.latent :].reshape(TOKEN, 4, 4).astype(np.float64)
        flat = frames.copy()
        flat[:, [0, 2], 3] = 0.0  # turns about the vertical, and places on the floor
        turn = flat[:, :3, :3]
        if np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max() > 1e-3 or (np.linalg.det(turn) < 0).any():
            raise RefusedMessage("rotation")
        if np.abs(flat[:, 1] - [0, 1, 0, 0]).max() > 1e-3 or np.abs(flat[:, 3] - [0, 0, 0, 1]).max() > 1e-6:
            raise RefusedMessage("rotation")
        if (np.abs(frames[:, [0, 2], 3] - place[:, [0, 2]]) > STEP).any():
            raise RefusedMessage("place")
