"""What is shown live is corrected: hands hold, feet stand, and nobody is thrown or walks through somebody."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from magnet.bench.speed import standing
from magnet.body import load_body
from magnet.body.contact import deepest
from magnet.body.holding import holds
from magnet.body.joints import TOES
from magnet.body.settle import DOFS, LEAD, corrected
from magnet.body.settle_wishes import LAG
from magnet.generation import live_settling
from magnet.generation.causal_bodies import EXPECTED
from magnet.generation.live_settling import PRESSED, REMEMBERED, parted_for, settled_on, thrown
from magnet.generation.settling import Corrected
from magnet.motion.scene import Scene, cat_time
from magnet.synthesis import synthesize
from tests.cases import few

BLOCK, BEHIND = 4, 4 * EXPECTED


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

    def answer(
        few: Scene, body: object, how: str, fixed: Tensor, settle: object, *rest: object, **more: object
    ) -> Tensor:
        asked.append(settle)
        return push.clone() if settle is PRESSED[-1] else torch.zeros_like(push)

    monkeypatch.setattr(live_settling, "settling", answer)
    new, sees = torch.tensor([True, False]).expand(BLOCK + BEHIND, -1), torch.zeros(2, 2, dtype=torch.bool)
    made, now = settled_on(ahead, scene.slice(0, BLOCK), new, BLOCK, sees, "firm", None)
    assert asked[-1] is PRESSED[-1] and now.ahead is not None
    offset = push if goes else torch.zeros_like(push)
    assert torch.equal(torch.cat([now.offset, now.ahead], dim=1), offset[:, BLOCK - LEAD :])
    assert torch.equal(made.T_world_root, corrected(ahead, offset).T_world_root)


def test_each_correction_goes_on_from_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = beside(so_deep(0.105, 0.120), 2 * BLOCK + BEHIND)
    guesses: list[Tensor | None] = []

    def made(*arguments: object, guess: Tensor | None = None, **more: object) -> Tensor:
        guesses.append(guess)
        return pushed(BLOCK + BEHIND, 0.001 * len(guesses), 1)

    monkeypatch.setattr(live_settling, "settling", made)
    new, sees = torch.tensor([True, False]).expand(BLOCK + BEHIND, -1), torch.zeros(2, 2, dtype=torch.bool)
    ahead, before = scene.slice(BLOCK), scene.slice(0, BLOCK)
    _, now = settled_on(ahead, before, new, BLOCK, sees, "firm", None)
    first, *rest = guesses
    assert first is None and len(rest) == len(PRESSED)
    for number, guess in enumerate(rest, 1):
        assert guess is not None and torch.equal(guess, pushed(BLOCK + BEHIND, 0.001 * number, 1))
    settled_on(ahead, before, new, BLOCK, sees, "firm", now)
    first = guesses[1 + len(PRESSED)]  # what was expected of these frames, its end held
    assert now.ahead is not None and first is not None
    assert torch.equal(first, torch.cat([now.ahead, now.ahead[:, -1:].expand(-1, BLOCK, -1, -1)], dim=1))


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


def test_hands_that_held_hold_before_the_next_block_and_are_remembered_for_a_while() -> None:
    body, who = load_body(), (0, 1)
    shake = synthesize("handshake", 2, 150, torch.Generator().manual_seed(1), body).scene.slice(56, 60)
    away = (shake.T_world_root[:, :, 1, :3, 3] - shake.T_world_root[:, :, 0, :3, 3]) * torch.tensor([1.0, 0.0, 1.0])

    def moved(metres: float) -> Scene:
        root = shake.T_world_root.clone()
        root[:, :, 1, :3, 3] += metres * away / away.norm(dim=-1, keepdim=True)
        return shake.replace(T_world_root=root)

    def after(scene: Scene, parted: torch.Tensor | None, who: tuple[int, ...] = who) -> torch.Tensor:
        past = None if parted is None else Corrected(torch.zeros(1, 2, 2, DOFS), parted, (0, 1))
        return parted_for(scene, body.joints(scene), past, who, 4)

    held = holds(body.joints(shake), shake.present)[0][:, -1]
    met = after(shake, None)
    assert held.any() and torch.equal(met == 0, held) and met[~held].isinf().all()
    assert torch.equal(after(moved(0.3), met) == 0, held)  # they have not parted
    assert after(moved(0.3), None).isinf().all()  # nobody remembers that they met
    assert after(moved(0.3), met, (0, 2)).isinf().all()  # others met
    parted = after(moved(0.8), met)
    assert (parted[held] == 4).all()
    for _ in range(REMEMBERED // 4 - 1):
        parted = after(moved(0.8), parted)
    assert (parted[held] == REMEMBERED).all()
    assert torch.equal(after(moved(0.3), parted) == 0, held)  # near again soon enough
    forgotten = after(moved(0.8), parted)
    assert (forgotten[held] == REMEMBERED + 4).all()
    assert (after(moved(0.3), forgotten) > REMEMBERED).all()


def glided(speed: float, frames: int, block: int = 4) -> tuple[Scene, Scene]:
    """One who stands and whom the model moves on at so many m/s, as shown block by block, and as it was made."""
    still = standing(1, frames, 1, torch.device("cpu"))
    root = still.T_world_root.clone()
    root[0, :, 0, 0, 3] += speed * (torch.arange(frames) - block).clamp(min=0) / 30.0
    sliding = still.replace(T_world_root=root)
    new, sees = torch.ones(block + BEHIND, 1, dtype=torch.bool), torch.zeros(1, 1, dtype=torch.bool)
    shown, past = [sliding.slice(0, block)], None
    for start in range(block, frames - BEHIND, block):
        ahead = sliding.slice(start, start + block + BEHIND)
        made, past = settled_on(ahead, shown[-1], new, block, sees, "firm", past)
        shown.append(made.slice(0, block))
    return cat_time(shown), sliding


def test_feet_shown_standing_stay_there_block_after_block() -> None:
    """While the model moves the body on at 0.15 m/s; corrected block by block, each knowing what was shown alone."""
    frames, body = 36, load_body()
    toes, slid = (body.joints(each.replace(body=body.id))[0, :, 0][:, TOES, 0] for each in glided(0.15, frames))
    last = frames - BEHIND - 4
    assert float((slid[last] - slid[0]).mean()) > 0.09
    assert float((toes[last] - toes[0]).abs().max()) < 0.03
    assert float(toes.diff(dim=0).abs().max()) < 0.005


def test_feet_that_a_gliding_body_has_left_behind_are_let_go() -> None:
    """While the model glides on at 0.4 m/s for half a metre with both feet down: nobody leans after them."""
    body, frames = load_body(), 48
    shown, sliding = (each.slice(0, frames - 8) for each in glided(0.4, frames))
    feet = [body.joints(each.replace(body=body.id))[0, :, 0][:, TOES, 0] for each in (shown, sliding)]
    lag = (feet[1] - feet[0]) - (sliding.T_world_root - shown.T_world_root)[0, :, 0, 0, 3, None]
    assert float((feet[1][-1] - feet[1][0]).min()) > 0.4
    assert 0.10 < float(lag.max()) < LAG + 0.08


def walked_on(scenes: int, speed: float, frames: int = 44, block: int = 4) -> Scene:
    """Shown block by block: the model lets A walk through B, who stands. Scenes but the first: A stands, too."""
    still = standing(scenes, frames, 2, torch.device("cpu"))
    root = still.T_world_root.clone()
    root[:, :, 0, 0, 3], root[:, :, 0, 2, 3] = root[:, :, 1, 0, 3] - 0.8, root[:, :, 1, 2, 3]
    root[0, :, 0, 0, 3] += speed / 30 * (torch.arange(frames) - block).clamp(min=0)
    walking, body = still.replace(T_world_root=root), load_body()
    new = torch.tensor([True, False]).expand(block + BEHIND, -1)
    shown, past = [walking.slice(0, block)], None
    for start in range(block, frames - BEHIND, block):
        ahead = walking.slice(start, start + block + BEHIND)
        made, past = settled_on(ahead, shown[-1], new, block, torch.zeros(2, 2, dtype=torch.bool), "firm", past)
        shown.append(made.slice(0, block))
    return cat_time(shown).replace(body=body.id)


@pytest.mark.parametrize("speed", few([1.0, 1.5], 1))
def test_whoever_would_walk_through_somebody_is_kept_out_block_by_block(speed) -> None:
    joints = load_body().joints(walked_on(1, speed))[0]
    assert float(deepest(joints[:, 0], joints[:, 1])[:, 1].max()) < 0.08


@pytest.mark.parametrize("known", [True, False])
def test_whoever_is_given_the_block_is_made_way_for_in_it(known) -> None:
    """B comes at A at 2.5 m/s from half a metre, and stands until the block begins: who sees the block steps aside."""
    frames, block, body = 12, 4, load_body()
    still = standing(1, frames, 2, torch.device("cpu"))
    root = still.T_world_root.clone()
    root[0, :, 1, 2, 3] = root[0, :, 0, 2, 3]
    root[0, :, 1, 0, 3] = root[0, :, 0, 0, 3] + 0.5 - 2.5 / 30 * (torch.arange(frames) - block + 1).clamp(0, block)
    scene = still.replace(T_world_root=root)
    new, sees = torch.tensor([True, False]).expand(2 * block, -1), torch.tensor([[False, known], [False, False]])
    before, plain = scene.slice(0, block), scene.slice(block, frames)
    made, _ = settled_on(plain, before, new, block, sees, "firm", None)
    assert torch.equal(made.T_world_root[:, :, 1], plain.T_world_root[:, :, 1])
    was, now = (
        deepest(*body.joints(each.replace(body=body.id))[0, :block].unbind(dim=1))[-1, 1] for each in (plain, made)
    )
    assert (float(now) < float(was) - 0.02) == known
    later = plain.T_world_root.clone()
    later[:, block:, 1, 0, 3] += 1.0
    again, _ = settled_on(plain.replace(T_world_root=later), before, new, block, sees, "firm", None)
    assert torch.equal(again.T_world_root[:, :, 0], made.T_world_root[:, :, 0])  # nobody knows what comes after


def test_corrections_made_anew_in_one_scene_change_no_other() -> None:
    two, one = walked_on(2, 1.0, frames=28), walked_on(1, 1.0, frames=28)
    torch.testing.assert_close(two.select(torch.tensor([0])).T_world_root, one.T_world_root, rtol=0, atol=1e-5)
    still = walked_on(2, 0.0, frames=28)
    torch.testing.assert_close(two.T_world_root[1], still.T_world_root[1], rtol=0, atol=1e-5)
