"""A link in one process that loses, delays and reorders messages: for tests, and for measuring what that costs."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import torch


@dataclass
class Lossy:
    """Messages by receiver and by the turn in which they come.

    Args:
        loss: share of the messages that never come.
        delay: turns until a message comes; 0: in the same turn, to those whose turn comes later.
        jitter: up to so many turns more, for each message by itself, which changes their order.
        generator: of what is lost and late.
    """

    loss: float = 0.0
    delay: int = 0
    jitter: int = 0
    generator: torch.Generator | None = None
    waiting: dict[int, list[tuple[int, list[bytes]]]] = field(default_factory=lambda: defaultdict(list))

    def send(self, receiver: int, parts: list[bytes], turn: int) -> None:
        """Send a message in some turn, or lose it."""
        lost, more = torch.rand(2, generator=self.generator).tolist()
        if lost >= self.loss:
            self.waiting[receiver].append((turn + self.delay + int(more * (self.jitter + 1)), parts))

    def due(self, receiver: int, turn: int) -> list[list[bytes]]:
        """What has come by some turn, in the order in which it comes."""
        come = sorted((each for each in self.waiting[receiver] if each[0] <= turn), key=lambda each: each[0])
        self.waiting[receiver] = [each for each in self.waiting[receiver] if each[0] > turn]
        return [parts for _, parts in come]
