"""Sampling that keeps bodies in order: the settle step after a block, and guidance by bodies inside of it."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import pytest
import torch

import magnet
from magnet.bench.speed import standing
from magnet.body import load_body
from magnet.body.apart import Apart
from magnet.body.contact import deepest
from magnet.body.energy import CONTACT
from magnet.body.holding import holds
from magnet.body.settle import DOFS
from magnet.body.settle_wishes import FIRM
from magnet.generation import chunk_bodies, settling
from magnet.generation.body_guidance import FARTHEST, STEP
from magnet.generation.causal_bodies import EXPECTED
from magnet.generation.rollout import generate, stream
from magnet.generation.settling import (
    FINISHED,
    GLIDE,
    PACE,
    Corrected,
    around,
    carried_on,
    settled_chunk,
)
from magnet.metrics import hand_distance
from magnet.motion.scene import Scene, cat_time
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions, Separation, Settling
from magnet.sampling.schedule import Grid
from magnet.synthesis import synthesize
from magnet.tasks import registry
from magnet.testing import random_scene
from magnet.testing.poses import pose_law
from tests.cases import few, some_quick, some_slow

BOTH = SamplerOptions(
    steps=3, stride=2, pyramid_offset=0, body_guidance="firm", settle="hold", settle_blocks=True, smooth_path=True
)
BEHIND = 4 * EXPECTED
GRID = Grid(10, 2, 4, steps=2, window=8, stride=2, pyramid_offset=0)


def run(model, scene: Scene, name: str, options: SamplerOptions, **more) -> Scene:
    context = 0 if name == "generation" else 16
    generator = torch.Generator().manual_seed(0)
    return generate(model, scene, registry.get(name)(), context, 40 - context, 1, options, generator, **more)


def test_every_choice_but_off_has_its_sizes() -> None:
    assert set(get_args(Separation)) - {"off"} == set(CONTACT) == set(FARTHEST) == set(STEP)
    assert set(get_args(Settling)) - {"off"} == {*CONTACT, *FIRM}
    assert SamplerOptions().settle is None and SamplerOptions().body_guidance == "off"


@pytest.mark.parametrize("name", some_quick(registry.names(), "partner_inpainting", "inbetweening"))
def test_whoever_is_given_stays_bit_identical_in_every_task(model, name) -> None:
    scene = random_scene(1, 40, 3, torch.Generator().manual_seed(2))
    plain = run(model, scene, name, replace(BOTH, body_guidance="off", settle="off"))
    made = run(model, scene, name, BOTH)
    assert torch.equal(plain.given, made.given)
    for before, after in ((scene.body_rot, made.body_rot), (scene.T_world_root, made.T_world_root)):
        assert torch.equal(before[made.given], after[made.given]) and after.isfinite().all()
    assert not torch.equal(plain.T_world_root, made.T_world_root)


CAUSAL = [name for name in registry.names() if registry.get(name)().schedule(GRID).causal]
WHATS = [{"body_guidance": "firm"}, {"settle": "firm"}, {"settle": "hold", "smooth_path": True}]


@pytest.mark.parametrize("what", few(WHATS[::-1], 1), ids=str)
@pytest.mark.parametrize("name", some_slow(CAUSAL, *{*CAUSAL} - {"motion_control"}))
def test_no_pose_depends_on_what_is_not_known_when_it_is_shown(name, what) -> None:
    assert pose_law(registry.get(name)(), GRID, SamplerOptions(**what, settle_blocks=True))


@pytest.mark.parametrize("name", some_slow(["partner_inpainting", "joint_future"], "partner_inpainting"))
def test_what_is_not_given_is_not_read(model, name) -> None:
    scene, other = (random_scene(1, 40, 3, torch.Generator().manual_seed(seed)) for seed in (2, 3))
    plain = run(model, scene, name, BOTH)
    mixed = scene.replace(
        body_rot=torch.where(plain.given[..., None, None, None], scene.body_rot, other.body_rot),
        T_world_root=torch.where(plain.given[..., None, None], scene.T_world_root, other.T_world_root),
    )
    made = run(model, mixed, name, BOTH)
    assert torch.equal(plain.T_world_root, made.T_world_root) and torch.equal(plain.body_rot, made.body_rot)


def test_scenes_do_not_depend_on_those_beside_them(model) -> None:
    """Up to rounding, which corrections magnify where bodies begin deep in each other: of eight seeds two are then
    off by millimetres or centimetres, as with other weights of pairwise transforms others are."""
    scenes = random_scene(2, 40, 2, torch.Generator().manual_seed(4))

    def sampled(rows: list[int]) -> Scene:
        generators = [torch.Generator().manual_seed(row) for row in rows]
        return generate(model, scenes.select(rows), registry.get("joint_future")(), 16, 24, 1, BOTH, generators)

    together, alone = sampled([0, 1]), sampled([1])
    assert torch.allclose(together.T_world_root[1], alone.T_world_root[0], atol=2e-3)


def test_it_goes_together_with_history_guidance_and_rolling(model) -> None:
    scene = random_scene(1, 40, 2, torch.Generator().manual_seed(2))
    options = SamplerOptions(steps=8, pyramid_offset=2, body_guidance="firm", guidance=Guidance(kind="self"))
    made = run(model, scene, "joint_future", options)
    plain = run(model, scene, "joint_future", replace(options, body_guidance="off"))
    assert made.T_world_root.isfinite().all() and not torch.equal(made.T_world_root, plain.T_world_root)


@pytest.mark.slow
def test_people_of_a_shipped_model_are_out_of_each_other() -> None:
    duet, body = magnet.load("duet1"), load_body()  # whose people run through each other more than those of `duet`

    def depth(**how: Separation) -> float:
        """Centimetres beyond 5, mean over frames of the two who are worst."""
        model = replace(duet, sampler=replace(duet.sampler, steps=2, **how))
        joints = body.joints(model.generate(people=3, frames=48, samples=2, seed=2).plain())
        pairs = [joints[:, :, pair].flatten(0, 1).unbind(1) for pair in ([0, 1], [0, 2], [1, 2])]
        worst = torch.stack([deepest(one, other)[:, 1] for one, other in pairs]).amax(dim=0)
        return 100 * float((worst - 0.05).clamp_min(0).mean())

    plain, guided, settled = depth(), depth(body_guidance="firm"), depth(settle="firm")
    assert plain > 0.5, "two steps from nothing: people do run through each other"
    assert guided < 0.9 * plain and settled < 0.1 * plain


def test_hands_hold_on_from_a_chunk_to_the_next() -> None:
    body = load_body()
    shake = synthesize("handshake", 2, 150, torch.Generator().manual_seed(1), body).scene.slice(56, 88)
    assert bool(holds(body.joints(shake), shake.present)[0][:, -1].any())
    root = shake.T_world_root.clone()
    away = (root[:, :, 1, :3, 3] - root[:, :, 0, :3, 3]) * torch.tensor([1.0, 0.0, 1.0])
    root[:, :, 1, :3, 3] += 0.25 * away / away.norm(dim=-1, keepdim=True)
    apart, nobody = shake.replace(T_world_root=root), torch.zeros(32, 2, dtype=torch.bool)

    def together(scene: Scene) -> int:
        joints = body.joints(scene)
        return int((hand_distance(joints[:, :, 0], joints[:, :, 1]) < 0.2).sum())

    _, past = settled_chunk(shake, nobody, "hold", None)
    assert together(settled_chunk(apart, nobody, "hold", None)[0]) < 3  # they have not met
    assert together(settled_chunk(apart, nobody, "hold", past)[0]) > 20
    assert together(settled_chunk(apart, nobody, "firm", past)[0]) < 3


def test_what_is_left_deep_in_a_finished_chunk_is_corrected_anew_and_nobody_is_thrown(monkeypatch) -> None:
    """A runs through B, who is given, at 11 m/s, and back at once, beside a scene in which nobody moves."""
    still, body = standing(2, 40, 2, torch.device("cpu")), load_body()
    root = still.T_world_root.clone()
    root[0, :, 0, 0, 3] = root[0, :, 1, 0, 3] + (torch.arange(40) - 20).abs() / 30 * 11.0 - 0.8
    root[0, :, 0, 2, 3] = root[0, :, 1, 2, 3]
    running, fixed = still.replace(T_world_root=root), torch.tensor([False, True]).expand(40, -1)

    made, _ = settled_chunk(running, fixed, "firm", None)
    monkeypatch.setattr(settling, "TOO_DEEP", Apart(body=9.0, arms=9.0))
    once, _ = settled_chunk(running, fixed, "firm", None)
    joints = [body.joints(each.replace(body=body.id))[0] for each in (once, made)]
    deep, depth = (float(deepest(both[:, 0], both[:, 1])[:, 1].max()) for both in joints)
    assert deep > 0.085 > 0.08 > depth
    quick, acceleration = (float(900 * both[:, 0].diff(n=2, dim=0).norm(dim=-1).max()) for both in joints)
    assert acceleration < quick + 70  # m/s2; where bodies pass in two frames it is 110 to 200 more
    assert torch.equal(made.T_world_root[1], once.T_world_root[1])  # other scenes stay as they were
    assert torch.equal(made.T_world_root[:, :, 1], running.T_world_root[:, :, 1])


def test_each_correction_of_a_finished_chunk_follows_where_the_one_before_left_people_deep(monkeypatch) -> None:
    apart, nobody = standing(1, 12, 2, torch.device("cpu")), torch.zeros(12, 2, dtype=torch.bool)
    within = apart.replace(T_world_root=apart.T_world_root[:, :, :1].repeat(1, 1, 2, 1, 1))
    ways, in_vain = [], torch.zeros(1, 12, 2, DOFS)
    monkeypatch.setattr(settling, "settling", lambda *all, **_: ways.append(all[4]) or in_vain.clone())
    for scene in (apart, within):
        settled_chunk(scene, nobody, "firm", None)
    assert ways == [FINISHED, FINISHED, *settling.ANEW]


def test_where_nobody_is_nothing_is_corrected() -> None:
    scene = standing(1, 8, 2, torch.device("cpu"))
    empty = scene.replace(present=torch.zeros(1, 2, dtype=torch.bool))
    made, past = settled_chunk(empty, torch.zeros(8, 2, dtype=torch.bool), "hold", None)
    assert torch.equal(made.T_world_root, empty.T_world_root) and past.who == ()
    settled_chunk(scene, torch.zeros(8, 2, dtype=torch.bool), "hold", past)


@pytest.mark.parametrize("speed", [1.7, 6.0])
def test_who_is_made_through_another_is_led_past_in_the_first_correction(speed: float, monkeypatch) -> None:
    still, body = standing(1, 40, 2, torch.device("cpu")), load_body()
    root = still.T_world_root.clone()
    root[0, :, 0, 0, 3] = root[0, :, 1, 0, 3] + (torch.arange(40) - 20) / 30 * speed
    root[0, :, 0, 2, 3] = root[0, :, 1, 2, 3]
    monkeypatch.setattr(settling, "ANEW", ())
    made, _ = settled_chunk(still.replace(T_world_root=root), torch.tensor([False, True]).expand(40, -1), "firm", None)
    joints = body.joints(made.replace(body=body.id))[0]
    assert float(deepest(joints[:, 0], joints[:, 1])[:, 1].max()) < 0.08
    pelvis = made.T_world_root[0, :, 0, :3, 3]
    assert float(30 * pelvis.diff(dim=0).norm(dim=-1).max()) < speed + 2.0


def test_people_who_may_not_be_moved_are_not_corrected_anew(monkeypatch) -> None:
    """Two who are given stand in each other, then a metre apart, where they may be moved."""
    scene = standing(1, 40, 2, torch.device("cpu"))
    root = scene.T_world_root.clone()
    root[0, :20, 0, :3, 3] = root[0, :20, 1, :3, 3] + torch.tensor([0.1, 0.0, 0.0])
    scene, fixed = scene.replace(T_world_root=root), (torch.arange(40) < 20)[:, None].expand(-1, 2)
    calls: list[int] = []
    plain = settling.settling
    monkeypatch.setattr(settling, "settling", lambda *words, **more: calls.append(1) or plain(*words, **more))
    settled_chunk(scene, fixed, "firm", None)
    assert len(calls) == 1


@pytest.mark.parametrize("chunk", [3, 100])
def test_groups_from_nothing_hold_hands_only_where_that_is_asked_for(model, monkeypatch, chunk) -> None:
    """Couples hold as the model is best sampled, in whatever batch; three who go on from a past do, too."""
    monkeypatch.setattr(model, "sampling", replace(model.sampling, settle="hold"))
    asked: list[tuple[str, int]] = []
    plain = chunk_bodies.settled_chunk

    def settled(scene: Scene, fixed: torch.Tensor, how: str, past: Corrected | None) -> tuple[Scene, Corrected]:
        asked.append((how, scene.scenes))
        assert past is None or len(past.offset) == scene.scenes
        return plain(scene, fixed, how, past)

    monkeypatch.setattr(chunk_bodies, "settled_chunk", settled)
    present = torch.tensor([[True, True, True], [True, True, False], [True, True, True]])
    scene = random_scene(3, 24, 3, torch.Generator().manual_seed(2), present)

    def made(scene: Scene, task: str, seeds: list[int], settle: Settling | None = None) -> Scene:
        asked.clear()
        options, context = SamplerOptions(steps=2, stride=2, settle=settle), 0 if task == "generation" else 16
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        more = (context, 24 - context, 1, options, generators)
        return cat_time(list(stream(model, scene, registry.get(task)(), *more, chunk=chunk)))

    mixed = made(scene, "generation", [0, 1, 2])
    assert sorted(set(asked)) == [("firm", 2), ("hold", 1)]
    plainly = made(scene, "generation", [0, 1, 2], "off")
    far = (mixed.T_world_root[:, None] - plainly.T_world_root).flatten(2).norm(dim=-1)  # (3, 3)
    assert far.argmin(dim=1).tolist() == [0, 1, 2], "in their order"
    for b, how in enumerate(("firm", "hold", "firm")):
        made(scene.select([b]), "generation", [b])
        assert set(asked) == {(how, 1)} and len(asked) == (2 if chunk == 3 else 1)
    made(scene, "generation", [0, 1, 2], "hold")
    assert set(asked) == {("hold", 3)}
    made(scene, "joint_future", [0, 1, 2])
    assert set(asked) == {("hold", 3)}
    monkeypatch.setattr(model, "sampling", replace(model.sampling, settle_groups="light"))
    made(scene, "generation", [0, 1, 2])
    assert set(asked) == {("light", 2), ("hold", 1)}, "as the model says"


def test_whoever_is_not_seen_any_further_is_expected_to_go_on() -> None:
    scene = random_scene(2, 24, 3, torch.Generator().manual_seed(0))
    root = scene.T_world_root.clone()
    root[:, :, 1, :3, 3] = torch.arange(24)[:, None] * torch.tensor([0.02, 0.01, -0.01])  # up as well
    scene = scene.replace(T_world_root=root)
    agents = torch.tensor([False, True, False])
    made = carried_on(scene, agents, 8)
    for before, after in ((scene.T_world_root, made.T_world_root), (scene.body_rot, made.body_rot)):
        assert torch.equal(after[:, :9], before[:, :9])
        assert torch.equal(after[:, :, ~agents], before[:, :, ~agents])
    moved = made.T_world_root[:, 8:, 1, :3, 3] - root[:, 8:9, 1, :3, 3]
    step = moved.diff(dim=1)
    torch.testing.assert_close(step[:, 0], torch.tensor([0.02, 0.0, -0.01]).expand(2, 3), rtol=0.05, atol=1e-6)
    assert (step[..., 0].diff(dim=1) < 0).all()  # ever slower
    assert (moved[..., 0] < 0.02 * GLIDE).all()
    assert torch.equal(made.body_rot[:, 8:, 1], scene.body_rot[:, 8:9, 1].expand(-1, 16, -1, -1, -1))


def test_what_comes_after_does_not_tell_how_somebody_is_expected_to_go_on() -> None:
    scene = random_scene(1, 24, 2, torch.Generator().manual_seed(0))
    agents = torch.tensor([False, True])
    other = scene.replace(T_world_root=scene.T_world_root.clone(), body_rot=scene.body_rot.clone())
    other.T_world_root[:, 9:, 1, :3, 3] += 1.0
    other.body_rot[:, 9:, 1] = other.body_rot[:, 8:9, 1]
    one, two = carried_on(scene, agents, 8), carried_on(other, agents, 8)
    assert torch.equal(one.T_world_root[:, :, 1], two.T_world_root[:, :, 1])
    assert torch.equal(one.body_rot[:, :, 1], two.body_rot[:, :, 1])


@pytest.mark.parametrize("frame", [0, 1, PACE])
def test_with_few_frames_before_somebody_stands_still_or_goes_on_by_those(frame) -> None:
    scene = random_scene(1, 12, 2, torch.Generator().manual_seed(0))
    made = carried_on(scene, torch.tensor([True, True]), frame)
    still = made.T_world_root[:, frame:] - made.T_world_root[:, frame : frame + 1]
    assert (still[..., [0, 2], 3].abs().amax() == 0) == (frame == 0)


def test_nobody_makes_way_for_whom_nothing_is_known_of(model) -> None:
    """Who is not generated, as the other in partner prediction, stands still in the scene and is no body to who is."""
    scene, task = random_scene(1, 40, 2, torch.Generator().manual_seed(2)), registry.get("partner_prediction")()
    options = SamplerOptions(steps=2, stride=2, settle="firm")
    made = generate(model, scene, task, 16, 24, 1, options, torch.Generator().manual_seed(0))
    plain = generate(model, scene, task, 16, 24, 1, replace(options, settle="off"), torch.Generator().manual_seed(0))
    seen = plain.replace(present=torch.tensor([[True, False, False]]))
    expected, both = (settled_chunk(each, made.given[0], "firm", None)[0] for each in (seen, plain))
    assert not torch.equal(expected.T_world_root[:, :, 0], both.T_world_root[:, :, 0])
    assert torch.equal(made.T_world_root[:, :, 0], expected.T_world_root[:, :, 0])
    assert torch.equal(made.T_world_root[:, :, 1], plain.T_world_root[:, :, 1])


def test_only_frames_around_a_moment_are_corrected_more_loosely() -> None:
    frames = torch.zeros(2, 60, dtype=torch.bool)
    frames[0, 30] = True
    share = around(frames)
    assert share.shape == (2, 60) and not share[1].any()
    assert (share[0, 30 - settling.REACH : 31 + settling.REACH] == 1).all()
    assert (share[0, : 30 - 3 * settling.REACH] == 0).all() and (share[0, 31 + 3 * settling.REACH :] == 0).all()
    assert (share[0, 30:].diff() <= 0).all() and (share[0, :31].diff() >= 0).all()
