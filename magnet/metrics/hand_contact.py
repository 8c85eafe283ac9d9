"""Whether hands meet, whether they meet when they did in the recording, and how long they hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from magnet.body.contact import WITHIN, hand_distance
from magnet.body.energy import BEYOND
from magnet.metrics.base import ClipMeans, Of, clip_sums
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures


def holds(contact: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Contacts that last without a break.

    Args:
        contact: (..., T) bool.
        counts: bool that broadcasts to it: frames that are scored.

    Returns:
        Frames in the hold that each frame lies in, 0 outside of any: (..., T) int. And the first frame of each hold
        of which any frame is scored: (..., T) bool.
    """
    begins = contact.clone()
    begins[..., 1:] &= ~contact[..., :-1]
    number = begins.flatten().cumsum(dim=0) - 1  # of the hold that a frame in contact lies in
    frames = torch.bincount(number[contact.flatten()], minlength=1)
    scored = torch.bincount(number[(contact & counts).flatten()], minlength=len(frames)) > 0
    number = number.clamp(min=0).view(contact.shape)
    return torch.where(contact, frames[number], 0), begins & scored[number]


class HandContact(ClipMeans):
    """`hand_contact`: share of frames in which the nearest hands of two people are in contact.

    `hand_contact_precision` is the share of these frames that are in contact in the recording too, and
    `hand_contact_recall` the share of the recorded ones that are met; frame by frame, for each sample and each pair of
    people. `hand_hold` is how long a hold lasts in seconds, `hand_hold_long` the share of frames in contact that lie in
    holds of more than a second. A hold is as long as it is in the whole future, given frames included, and counts where
    any of its frames was generated; the future's ends cut it.

    Args:
        within: metres under which hands are in contact.
        beyond: metres from the wrist to the middle of the hand.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = HandContact()
    >>> metric.update(truth[None], truth)
    >>> round(metric.compute()["hand_contact"].item(), 3)
    0.0
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "hand_contact": Column("hands", "", "real", "share of frames with hands of two people in contact", main=True),
        "hand_contact_precision": Column(
            "hands right", "", "high", "share of hand contact that was recorded too", beside="recording"
        ),
        "hand_contact_recall": Column(
            "hands met", "", "high", "share of recorded hand contact that is met", beside="recording"
        ),
        "hand_hold": Column("hold", "s", "real", "how long hands hold"),
        "hand_hold_long": Column("long holds", "", "real", "share of hand contact in holds over 1 s"),
    }

    def __init__(self, within: float = WITHIN, beyond: float = BEYOND, of: Of = "generated", **kwargs: Any) -> None:
        compared = ["hand_contact_precision", "hand_contact_recall"] if of == "generated" else []
        super().__init__(["hand_contact", *compared, "hand_hold", "hand_hold_long"], of=of, **kwargs)
        self.within = within
        self.beyond = beyond

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        first, second, counts = futures.pairs()
        there = (futures.present[:, first] & futures.present[:, second])[:, None]

        def contact(joints: Tensor) -> Tensor:
            apart = hand_distance(joints[..., first, :, :], joints[..., second, :, :], self.beyond)
            return (apart < self.within) & there

        held = contact(futures.generated)  # (S, B, T, Q)
        shares = [clip_sums(held.double(), counts)]
        if self.of == "generated":
            recorded = contact(futures.truth).expand_as(held)
            both = (held & recorded).double()
            shares += [clip_sums(both, held & counts), clip_sums(both, recorded & counts)]
        length, begins = (x.movedim(-1, 2) for x in holds(held.movedim(2, -1), counts.movedim(1, -1)))
        long = (length > self.fps).double()
        return [*shares, clip_sums(length.double() / self.fps, begins), clip_sums(long, held & counts)]
