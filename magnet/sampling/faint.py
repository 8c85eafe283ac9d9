"""How noisy finished tokens are shown to the model: what was given clean, what it made as `Guidance` says."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.sampling.guidance import Guidance
from magnet.sampling.schedule import Stage

AFTER_UNSEEN = 1
"""Token steps after the last given one that are shown clean where `stabilization_unseen` counts."""


def faint_levels(
    guidance: Guidance, known: Tensor, stage: Stage, since: Tensor | None = None, live: bool = False
) -> Tensor | None:
    """Levels at which a stage shows what is finished. (N, P) int, None: all clean

    Args:
        guidance: says how noisy.
        known: (N, P) bool, tokens that were given; they are shown clean.
        stage: on the same rows.
        since: (P,) int, as for `shown_clean`.
        live: whether poses are final as soon as their tokens are; then nobody's are fainter `beside` others.
    """
    levels = None
    if guidance.stabilization_level:
        sure = shown_clean(known, guidance.stabilization_after, since)
        levels = torch.where(sure, 0, guidance.stabilization_level)
    if guidance.stabilization_unseen and stage.unseen:
        lately = torch.where(shown_clean(known, AFTER_UNSEEN, since), 0, guidance.stabilization_unseen)
        levels = lately if levels is None else torch.maximum(levels, lately)
    if guidance.stabilization_beside and not live:
        given = known[stage.start : stage.stop].all(dim=0)
        beside = (given.sum() > given.long()) & ~known  # somebody else is given throughout
        highest = max(guidance.stabilization_beside, guidance.stabilization_level or 0)
        levels = torch.where(beside, highest, 0 if levels is None else levels)
    return levels


def shown_clean(known: Tensor, after: int, since: Tensor | None = None) -> Tensor:
    """Tokens that were given, or come within `after` token steps of one or of the beginning. (N, P) bool -> same

    since (P,) int of `steps_since`, of the rows before; None: there are none.
    """
    row = torch.arange(len(known))[:, None]
    last = torch.where(known, row, -1 if since is None else -since).cummax(dim=0).values
    return row - last <= after


def steps_since(known: Tensor, since: Tensor | None = None) -> Tensor:
    """Token steps from each one's last given one, or the beginning, to the row after these. (N, P) bool -> (P,) int

    since (P,) the same for the rows before; None: there are none.
    """
    row = torch.arange(len(known))[:, None]
    return len(known) - torch.where(known, row, -1 if since is None else -since).amax(dim=0)
