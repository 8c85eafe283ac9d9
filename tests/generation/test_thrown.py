"""Live corrections rather leave somebody a little deep in another than throw them out."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from magnet.bench.speed import standing
from magnet.body import load_body
from magnet.body.contact import deepest
from magnet.body.settle import DOFS
from magnet.generation import settling
from magnet.generation.settling import PRESSED, settled_on, thrown
from magnet.motion.scene import Scene

BLOCK, BEHIND = 4, 8


def beside(apart: float, frames: int) -> Scene:
    """A stands so far from B, who stands: metres from pelvis to pelvis."""
    still = standing(1, frames, 2, torch.device("cpu"))
    root = still.T_world_root.clone()
    root[:, :, 0, [0, 2], 3] = root[:, :, 1, [0, 2], 3] + torch.tensor([apart, 0.0])
    return still.replace(T_world_root=root)


def depth(scene: Scene) -> float:
    joints = load_body().joints(scene.replace(body=load_body().id))[0]
    return float(deepest(joints[:, 0], joints[:, 1])[:, 1].max())


def so_deep(least: float, most: float) -> float:
    """How far apart two people stand who are so deep in each other."""
    return next(apart for apart in torch.linspace(0.6, 0.0, 121).tolist() if least < depth(beside(apart, 1)) < most)


def pushed(frames: int, metres: float, over: int) -> Tensor:
    """A correction that moves A aside, within so many frames. -> (1, frames, 2, DOFS)"""
    offset = torch.zeros(1, frames, 2, DOFS)
    offset[:, :, 0, 0] = metres * ((torch.arange(frames) + 1) / over).clamp(max=1.0)
    return offset


@pytest.mark.parametrize(
    "least, most, over, goes",
    [(0.080, 0.095, 1, False), (0.080, 0.095, 12, True), (0.105, 0.120, 1, True)],
    ids=["a little deep, at once", "a little deep, smoothly", "deep, at once"],
)
def test_who_is_a_little_deep_is_not_thrown_out(
    least: float, most: float, over: int, goes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = beside(so_deep(least, most), 2 * BLOCK + BEHIND)
    ahead, push = scene.slice(BLOCK), pushed(BLOCK + BEHIND, 0.3, over)
    asked: list[object] = []

    def made(
        few: Scene, body: object, how: str, fixed: Tensor, settle: object, *rest: object, **more: object
    ) -> Tensor:
        asked.append(settle)
        return push.clone() if settle is PRESSED[-1] else torch.zeros_like(push)

    monkeypatch.setattr(settling, "settling", made)
    new, sees = torch.tensor([True, False]).expand(BLOCK + BEHIND, -1), torch.zeros(2, 2, dtype=torch.bool)
    _, now = settled_on(ahead, scene.slice(0, BLOCK), new, BLOCK, sees, "firm", None)
    assert asked[-1] is PRESSED[-1] and torch.equal(now.offset, push if goes else torch.zeros_like(push))


def test_only_what_is_shown_and_who_is_moved_count_as_thrown() -> None:
    scene = beside(2.0, 2 * BLOCK + BEHIND)
    led, ahead = scene.T_world_root[:, :2, :, :3, 3], scene.slice(BLOCK)
    late = pushed(BLOCK + BEHIND, 0.3, 1)
    late[:, : BLOCK + 2] = 0.0
    assert thrown(ahead, pushed(BLOCK + BEHIND, 0.3, 1), led, BLOCK).all()
    assert not thrown(ahead, late, led, BLOCK).any()
    root = ahead.T_world_root.clone()
    root[:, 1:, 1, 0, 3] += 1.0  # whoever is given may leap
    assert not thrown(ahead.replace(T_world_root=root), pushed(BLOCK + BEHIND, 0.3, 12), led, BLOCK).any()
