"""A crowd is sampled in views of neighbours, at a cost that is linear in people; small groups are as ever."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import pytest
import torch

import magnet
from magnet.body.apart import APART, excess_depth, kept_apart, lifted
from magnet.denoiser.module import Denoiser
from magnet.denoiser.options import Sampling
from magnet.generation.crowd import CrowdRollout, generate_crowd
from magnet.generation.crowd_start import compose, start_crowd
from magnet.generation.rollout import generate
from magnet.generation.stats import SamplingStats
from magnet.motion.frames import pairwise, to_9d
from magnet.motion.scene import Scene, concatenate
from magnet.motion.tokens import TOKEN_FRAMES, pairwise_by_token
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.testing import random_scene, standing_people, tiny_denoiser
from tests.cases import some_slow

QUICK = SamplerOptions(steps=2, stride=2)


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "posterior"])
def model(request: pytest.FixtureRequest) -> Denoiser:
    return tiny_denoiser(max_agents=4, window=8, network={"pairwise_posterior": request.param})


def each_model(name: str, cases: Iterable[Any], *quick: tuple[bool, Any]) -> Any:
    """Every case with both models, without and with a posterior; the quick ones run with the quick tests."""
    every = list(itertools.product([False, True], cases))
    return pytest.mark.parametrize(("model", name), some_slow(every, *(set(every) - set(quick))), indirect=["model"])


def crowd(people: int, frames: int = 16, spacing: float = 2.0) -> Scene:
    """Couples of smooth random motion, composed."""
    generator = torch.Generator().manual_seed(people)
    couples = random_scene(3, frames, 2, generator)
    return compose([couples.select([number]) for number in range(3)], people, generator, spacing)


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(5)


FIELDS: dict[str, dict[str, Any]] = {"inbetweening": {"every": 4}}


@each_model("task", registry.names(), (False, "motion_control"), (False, "inbetweening"), (True, "joint_future"))
def test_small_groups_are_sampled_as_ever_bit_for_bit(model: Denoiser, task: str) -> None:
    for people in (2, 3, 4):
        scene = random_scene(1, 24, people, torch.Generator().manual_seed(people))
        made = registry.get(task)(**FIELDS.get(task, {}))
        usual = generate(model, scene, made, 8, 16, 1, QUICK, seeded())
        crowded = generate_crowd(model, scene, made, 8, 16, 1, QUICK, seeded())
        for name, tensor in usual.tensors().items():
            assert torch.equal(tensor, crowded.tensors()[name]), (people, name)


@each_model("task", ["joint_future", "motion_control", "inbetweening"], (True, "motion_control"))
def test_a_crowd_costs_a_view_a_person_and_no_more(model: Denoiser, task: str) -> None:
    fields = {"motion_control": {"target": (0, 5)}}.get(task, FIELDS.get(task, {}))
    for people in (6, 12):
        stats = SamplingStats()
        scene = crowd(people, 24)
        made = generate_crowd(model, scene, registry.get(task)(**fields), 8, 16, 1, QUICK, seeded(), stats=stats)
        assert made.agents == people and made.frames == 24
        assert bool(made.T_world_root.isfinite().all())
        assert people / 4 <= stats.windows / stats.calls <= people, "views a step"
        assert torch.equal(made.T_world_root[:, :8], scene.T_world_root[:, :8])


def test_what_tokens_say_of_partners_is_where_these_stand(model: Denoiser) -> None:
    """All views are placed together, and whoever becomes a partner is in the tokens from then on."""
    met = []

    class Watched(CrowdRollout):
        def meet(self, stage: Any, *rest: Any) -> None:
            super().meet(stage, *rest)
            met.append(len(rest[1]))
            start = stage.start - self.first
            done = stage.active[0] - self.first
            world = self.world.T_world_can[:, start * TOKEN_FRAMES : done * TOKEN_FRAMES]
            truth = pairwise_by_token(to_9d(pairwise(world, self.model.layout.partners())))
            pairs = self.model.layout.unpack(self.model.normalizer.denormalize(self.tokens[:, start:done]))[2]
            torch.testing.assert_close(pairs, truth, rtol=0, atol=1e-4)

    scene = crowd(9, spacing=2.0)
    rollout = Watched(model, scene, registry.get("joint_future")(), 16, 64, QUICK, seeded())
    frames = sum(piece.frames for piece in rollout.chunks())
    assert frames == 80 and sum(met) > 0, "an untrained model lets people drift past each other"


@pytest.mark.slow
def test_bodies_are_kept_apart_as_they_are_shown_in_the_end() -> None:
    """A block decoded alone is of other poses than in the middle of its scene; those would be kept apart in vain."""
    model, options = magnet.load("duet1").denoiser, SamplerOptions.preset("steady", steps=3)  # which rolls
    seen: list[tuple[int, torch.Tensor, torch.Tensor]] = []
    errors: list[tuple[float, float]] = []

    class Watched(CrowdRollout):
        def _decode_rows(self, tokens: torch.Tensor, first: int, stop: int) -> Any:
            near = super()._decode_rows(tokens, first, stop)

            def decode(*rows: torch.Tensor) -> torch.Tensor:
                poses = near(*rows)
                seen.append((stop, poses[:, -TOKEN_FRAMES:], model.tokenizer.decode(*rows)[:, -TOKEN_FRAMES:]))
                return poses

            return decode

        def _decoded(self, *rest: Any) -> Scene:
            layout, rows = self.model.layout, self.tokens.shape[1]
            latent = layout.unpack(model.normalizer.denormalize(self.tokens))[0]
            shown = model.tokenizer.decode(latent, self.world.given.betas, self.world.placed_deltas(0, rows))
            for stop, *both in seen:
                if stop < rows - 2:  # the last ones have nothing behind them
                    truth = shown[:, (stop - 1) * TOKEN_FRAMES : stop * TOKEN_FRAMES]
                    errors.append(tuple(float((made - truth).abs().mean()) for made in both))  # type: ignore[arg-type]
            return super()._decoded(*rest)

    start = start_crowd(model, 9, options, seeded())
    list(Watched(model, start, registry.get("joint_future")(), 32, 40, options, seeded()).chunks())
    near, alone = torch.tensor(errors).mean(dim=0)
    assert near < 0.7 * alone, (near, alone)


def test_how_far_people_see_each_other_is_an_option(model: Denoiser) -> None:
    """Partners of a couple alone, of whoever is within a few metres, and not of anybody by accident."""
    scene = crowd(8, spacing=1.3)
    partners_of = []
    for enter, leave in ((0.01, 0.01), (9.0, 9.0)):
        options = replace(QUICK, crowd_enter=enter, crowd_leave=leave)
        rollout = CrowdRollout(model, scene, registry.get("joint_future")(), 16, 8, options, seeded())
        table = rollout.model.layout.partners()
        partners_of.append((table != torch.arange(8)[:, None]).sum(dim=1))
    assert bool((partners_of[1] == 3).all()) and bool((partners_of[0] < partners_of[1]).any())
    assert bool((partners_of[0] >= 1).all()), "those who belong together see each other however far"
    with pytest.raises(ValueError, match="crowd_leave"):
        SamplerOptions(crowd_enter=2.0, crowd_leave=1.0)


@pytest.mark.slow
def test_pairs_of_a_crowd_are_corrected_where_a_scene_of_two_is() -> None:
    model = tiny_denoiser(max_agents=4, window=8, sampling=Sampling(settle="hold"))
    scene, task = crowd(6), registry.get("joint_future")()
    made = [
        generate_crowd(model, scene, task, 16, 12, 1, replace(QUICK, settle=how), seeded()) for how in ("off", None)
    ]
    assert torch.equal(made[0].T_world_root[:, :16], made[1].T_world_root[:, :16]), "what is given stays"
    assert not torch.equal(made[0].body_rot, made[1].body_rot)


def test_what_a_crowd_answers_live_is_not_corrected_by_what_comes_later() -> None:
    model = tiny_denoiser(max_agents=4, window=8, sampling=Sampling(settle="hold"))
    scene, task = crowd(6, 24), registry.get("motion_control")(target=(0, 5))
    later = scene.T_world_root.clone()
    later[:, 20:, 1:5, 0, 3] += 1.0
    made = [
        generate_crowd(model, each, task, 8, 16, 1, QUICK, seeded()).T_world_root[:, :16, [0, 5]]
        for each in (scene, scene.replace(T_world_root=later))
    ]
    assert torch.equal(made[0], made[1])


@pytest.mark.slow
def test_memory_does_not_grow_with_the_length_of_a_crowd(model: Denoiser) -> None:
    rollout = CrowdRollout(model, crowd(6), registry.get("joint_future")(), 16, None, QUICK, seeded(), chunk=4)
    held = []
    for piece, _ in zip(rollout.chunks(), range(12), strict=False):
        held.append((rollout.tokens.numel(), rollout.world.T_world_can.numel()))
        assert piece.agents == 6
    assert max(held[6:]) <= max(held[:6])


def test_whoever_stands_in_somebody_else_is_moved_apart_and_nobody_else() -> None:
    joints = standing_people(frames=24, agents=12, apart=0.0).clone()
    joints[..., 2] += torch.tensor([0, 0.15, 5, 5.2, 10, 10.1, 15, 15.05, 20, 20.2, 30, 40])[:, None]
    present = torch.ones(1, 12, dtype=torch.bool)
    moved = kept_apart(joints, present)
    after = joints + lifted(moved)[..., None, :]
    for i in range(0, 10, 2):
        assert excess_depth(joints[:, :, i], joints[:, :, i + 1], APART["firm"]).min() > 0.005
        assert excess_depth(after[:, :, i], after[:, :, i + 1], APART["firm"]).max() < 0.001
    assert bool((moved[:, :, 10:] == 0).all()), "nobody is near them"
    still = kept_apart(joints, present, torch.arange(12) == 0)
    assert bool((still[:, :, 0] == 0).all()) and bool((still[:, :, 1] != 0).any())


def test_groups_stand_in_the_cells_of_a_floor_and_keep_their_shape() -> None:
    scene = crowd(50, spacing=4.0)
    assert scene.agents == 50 and bool(scene.present.all())
    middles = scene.T_world_root[0, :, :, [0, 2], 3].mean(dim=0).unflatten(0, (25, 2)).mean(dim=1)
    away = torch.cdist(middles, middles) + 99 * torch.eye(25)
    torch.testing.assert_close(away.amin(dim=1), torch.full((25,), 4.0), rtol=0, atol=1e-3)
    couple = random_scene(3, 16, 2, torch.Generator().manual_seed(50)).select([0])
    torch.testing.assert_close(pairwise(scene.T_world_root[:, :, :2]), pairwise(couple.T_world_root), rtol=0, atol=1e-4)


def test_groups_that_do_not_go_together_are_refused() -> None:
    couple = random_scene(1, 20, 2, torch.Generator().manual_seed(0))
    for other, said in (
        (couple.slice(4), "groups: frames differ, got 16, 20"),
        (couple.replace(fps=60.0), "groups: fps differ, got 30.0, 60.0"),
        (couple.replace(body="smplx-neutral"), "groups: body differ, got open-1, smplx-neutral"),
    ):
        with pytest.raises(ValueError, match=said):
            compose([couple, other], 4, torch.Generator())


def test_a_crowd_that_the_model_begins_is_of_different_people(model: Denoiser) -> None:
    scene = start_crowd(model, 7, QUICK, seeded())
    assert (scene.scenes, scene.frames, scene.agents) == (1, 32, 7)
    assert len(scene.betas[0].unique(dim=0)) == 7
    assert torch.equal(scene.T_world_root, start_crowd(model, 7, QUICK, seeded()).T_world_root)
    with pytest.raises(ValueError, match=r"spacing: got 1, expected 1\.5 to 1000"):
        start_crowd(model, 7, QUICK, seeded(), spacing=1.0)


def test_each_sample_of_a_crowd_from_nothing_begins_anew_and_nothing_was_given(model: Denoiser) -> None:
    made = magnet.Model(model, QUICK).generate(5, 12, samples=2, seed=0)
    assert (made.scenes, made.frames, made.agents, made.context) == (2, 12, 5, 0)
    assert not torch.equal(made.T_world_root[0, 0], made.T_world_root[1, 0])
    assert len(made.betas[0].unique(dim=0)) == 5 and torch.equal(made.betas[0], made.betas[1])


@pytest.mark.parametrize("people", [2, 5])
def test_scenes_from_nothing_keep_their_names(model: Denoiser, people: int) -> None:
    scene = concatenate([crowd(people, 4).replace(names=(name,)) for name in ("market", "square")])
    made = generate_crowd(model, scene, registry.get("generation")(), 0, 4, 2, QUICK, seeded())
    assert made.names == ("market", "market", "square", "square")


@pytest.mark.slow
@each_model("frames", [16, 40], (False, 16))
def test_a_crowd_is_made_from_nothing_in_its_slots_and_of_its_shapes(model: Denoiser, frames: int) -> None:
    scene = crowd(5, 4)
    betas = torch.randn(1, 5, 10, generator=torch.Generator().manual_seed(0))
    scene = scene.replace(present=torch.arange(5)[None] != 2, betas=betas)
    generation = registry.get("generation")()
    made = generate_crowd(model, scene, generation, 0, frames, 2, QUICK, seeded())
    assert (made.scenes, made.frames, made.agents) == (2, frames, 5)
    assert torch.equal(made.present, scene.present.expand(2, -1)) and torch.equal(made.betas[1], betas[0])
    assert not bool(made.given.any()), "nothing was given"
    ground = made.T_world_root[0, 0, scene.present[0]][:, [0, 2], 3]
    assert (torch.cdist(ground, ground) + 99 * torch.eye(4)).min() > 0.01
    assert not torch.equal(made.T_world_root[0], made.T_world_root[1])
    again = generate_crowd(model, scene, generation, 0, frames, 2, QUICK, seeded())
    assert torch.equal(made.T_world_root, again.T_world_root)


def test_what_is_not_made_for_crowds_is_refused(model: Denoiser) -> None:
    def refused(task: str, match: str, people: int = 6, context: int = 8, fields: Any = None, **options: Any) -> None:
        kind, how = registry.get(task)(**(fields or {})), SamplerOptions(steps=2, **options)
        with pytest.raises(ValueError, match=match):
            generate_crowd(model, crowd(people), kind, context, 8, 1, how, seeded())

    refused("generation", "placement", context=0, placement="anchor")
    refused("partner_inpainting", "own_past", fields={"target": (1,)})
    refused("generation", "context 0")
    refused("agentic_sync", "square", people=18)
    refused("joint_future", "placement", placement="anchor")
    refused("joint_future", "settle_blocks", settle_blocks=True)
    refused("joint_future", "body_guidance", body_guidance="light")
    refused("joint_future", "at most", people=201)


def test_somebody_given_who_may_be_far_away_makes_nobody_s_past_faint(model: Denoiser) -> None:
    """In a small group it does, beside whoever is given (test_stabilization.py)."""
    scene, task = random_scene(1, 48, 6, torch.Generator().manual_seed(0)), registry.get("partner_inpainting")

    def made(beside: int | None) -> Scene:
        options = replace(QUICK, guidance=Guidance(stabilization_beside=beside))
        generator = torch.Generator().manual_seed(0)
        return generate_crowd(model, scene, task(target=(0, 1), own_past=True), 16, 32, 1, options, generator)

    assert torch.equal(made(None).T_world_root, made(700).T_world_root)


@pytest.mark.parametrize("people", [2, 6])
@pytest.mark.parametrize("cond", [torch.zeros(3, 5), torch.zeros(1, 5), [[0.0] * 5] * 2], ids=["more", "fewer", "list"])
def test_conditions_are_one_tensor_with_one_for_each_scene(people: int, cond: Any) -> None:
    told = tiny_denoiser(max_agents=4, window=8, network={"cond_dim": 5})
    scenes = random_scene(2, 16, people, torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="cond: got"):
        generate_crowd(told, scenes, registry.get("joint_future")(), 8, 8, 1, QUICK, seeded(), cond=cond)
