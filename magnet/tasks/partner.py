"""Tasks that generate some agents, given something of the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from magnet.checks import require_flag, require_wholes
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks.registry import register_task


def chosen(grid: Grid, target: tuple[int, ...], name: str = "target", has: str = "the grid has agents") -> Tensor:
    """Which agents are generated. (P,) bool

    Args:
        grid: what they are part of.
        target: their slots.
        name: of the argument that gives them, for messages.
        has: words before the range of slots, for messages.

    Raises:
        ValueError: no such agent, one named twice, or nobody is left to be given.
    """
    require_wholes(name, target)
    mask = torch.zeros(grid.agents, dtype=torch.bool)
    if len(set(target)) != len(target):
        raise ValueError(f"{name} {target}: name each agent once")
    for agent in target:
        if not 0 <= agent < grid.agents:
            raise ValueError(f"{name} {agent}: {has} 0 to {grid.agents - 1}")
        mask[agent] = True
    if not mask.any() or mask.all():
        if grid.agents == 1:
            adds = "`magnet predict --people 2` adds another, in Python inpaint(agent=1)"
            raise ValueError(f"{name} {target}: there is one person alone, and somebody has to be given; {adds}")
        raise ValueError(f"{name} {target}: name some of the {grid.agents} agents, not none and not all")
    return mask


@register_task("partner_inpainting")
@dataclass(frozen=True)
class PartnerInpainting:
    """The whole motion of some agents, given the whole motion of the others (paper 3.3).

    Args:
        target: slots of the agents to generate; nothing of their motion is read, unless `own_past`.
        own_past: give them their own past too, and generate what follows it: P(A_t:L | A_0:t-1, B_0:L).
    """

    formula: ClassVar[str] = "P(A_0:L | B_0:L, ...)"
    target: tuple[int, ...] = (0,)
    own_past: bool = False

    def schedule(self, grid: Grid) -> MaskSchedule:
        require_flag("own_past", self.own_past)
        unknown = chosen(grid, self.target).expand(grid.tokens, -1)
        if self.own_past:
            if grid.context == 0:
                raise ValueError(
                    "partner_inpainting with own_past goes on from a past: give it context frames, 4 or more"
                )
            unknown = unknown & ~grid.past()
        return MaskSchedule.full_sequence(~unknown, unknown, grid)


@register_task("partner_prediction")
@dataclass(frozen=True)
class PartnerPrediction:
    """The future of some agents from everybody's past; the others' future stays unknown (paper 3.3).

    Args:
        target: slots of the agents to generate.
    """

    formula: ClassVar[str] = "P(A_t:t+L | A_0:t-1, B_0:t-1, ...)"
    target: tuple[int, ...] = (0,)

    def schedule(self, grid: Grid) -> MaskSchedule:
        if grid.context == 0:
            raise ValueError("partner_prediction continues a recording: give it context frames, 4 or more")
        return MaskSchedule.full_sequence(grid.past(), chosen(grid, self.target) & ~grid.past(), grid)


@register_task("motion_control")
@dataclass(frozen=True)
class MotionControl:
    """Some agents' next motion, given their past and the others' motion up to now, which may be live (paper A.9).

    Args:
        target: slots of the agents to generate.
        block: token steps generated at a time; the others are seen up to the end of the block.
    """

    formula: ClassVar[str] = "P(A_t | A_0:t-1, B_0:t, ...)"
    target: tuple[int, ...] = (0,)
    block: int = 1

    def schedule(self, grid: Grid) -> MaskSchedule:
        if grid.context == 0:
            raise ValueError("motion_control continues a recording: give it context frames, 4 or more")
        unknown = chosen(grid, self.target) & ~grid.past()
        return MaskSchedule.autoregressive(~unknown, unknown, grid, self.block, lookahead=False)
