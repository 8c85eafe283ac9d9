"""What a model cannot go on from is refused at every way in, and what it is not given may hold anything."""

from __future__ import annotations

import copy
import dataclasses
import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch

from magnet.api import Model
from magnet.denoiser.module import Denoiser
from magnet.generation.conditioning import require_finite
from magnet.generation.live import Live
from magnet.generation.partner import Partner
from magnet.generation.rollout import generate, stream
from magnet.generation.trace import record
from magnet.motion.scene import Scene
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tasks.agentic import AgenticSync
from magnet.tasks.joint import Generation, JointFuture
from magnet.tasks.partner import MotionControl, PartnerInpainting
from magnet.testing import random_scene, tiny_denoiser
from tests.cases import few

FAST = SamplerOptions(steps=2)
CONTEXT, FRAMES = 32, 16
GIVEN = {name: 0 if name in ("generation", "partner_inpainting") else CONTEXT for name in registry.names()}


@pytest.fixture(scope="module")
def model() -> Denoiser:
    return tiny_denoiser(max_agents=3, window=12)


@pytest.fixture
def duet() -> Scene:
    return random_scene(1, CONTEXT + FRAMES, 2, torch.Generator().manual_seed(5))


def answered(model: Denoiser, scene: Scene) -> Scene:
    partner = Partner(model, scene.slice(0, CONTEXT), (1,), FAST)
    return partner.answer(scene.slice(CONTEXT, CONTEXT + 4))


WAYS: dict[str, Callable[[Denoiser, Scene], Any]] = {
    "generate": lambda model, scene: generate(model, scene, JointFuture(), CONTEXT, FRAMES, options=FAST),
    "stream": lambda model, scene: next(stream(model, scene, JointFuture(), CONTEXT, None, options=FAST, chunk=1)),
    "predict": lambda model, scene: Model(model, FAST).predict(scene, frames=FRAMES),
    "continue_": lambda model, scene: Model(model, FAST).continue_(scene, frames=FRAMES),
    "inpaint": lambda model, scene: Model(model, FAST).inpaint(scene, agent=1),
    "react": lambda model, scene: Model(model, FAST).react(scene, agent=1),
    "partner": answered,
    "record": lambda model, scene: record(model, scene, JointFuture(), CONTEXT, FRAMES, FAST),
    "live": lambda model, scene: Live(model, start=scene),
    "live partner": lambda model, scene: Live(model, start=scene.replace(fps=30.0), partner=scene),
}
"""Ways in; of the second person `inpaint` is given nothing."""


def with_roots(scene: Scene, frame: int, agent: int, value: float) -> Scene:
    T = scene.T_world_root.clone()
    T[:, frame, agent] = value
    return scene.replace(T_world_root=T)


def lifted(scene: Scene, metres: float) -> Scene:
    T = scene.T_world_root.clone()
    T[..., 1, 3] += metres
    return scene.replace(T_world_root=T)


@pytest.mark.parametrize("way", WAYS)
def test_every_way_in_takes_what_is_right(way, model, duet):
    made = WAYS[way](model, duet)
    scene = made if isinstance(made, Scene) else getattr(made, "scene", None)
    assert made is not None and (scene is None or bool(scene.T_world_root.isfinite().all()))


@pytest.mark.parametrize("way", WAYS)
def test_another_frame_rate_is_refused_at_every_way_in(way, model, duet):
    with pytest.raises(ValueError, match=r"runs at 60 fps, the model at 30: bring it there"):
        WAYS[way](model, duet.replace(fps=60.0))


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("way", WAYS)
def test_what_is_given_and_not_finite_is_refused_at_every_way_in(way, value, model, duet):
    with pytest.raises(ValueError, match=r"^scene 0, agent 0: frame 5 is not finite"):
        WAYS[way](model, with_roots(duet, 5, 0, value))


@pytest.mark.parametrize("way", [way for way in WAYS if way not in ("stream", "live", "live partner")])
def test_motion_of_a_broken_network_is_refused_and_not_waited_for(way, model, duet):
    """One weight that is not a number: whole turns of NaN were counted for ever."""
    broken = copy.deepcopy(model)
    with torch.no_grad():
        broken.transformer.out_proj.bias[-1] = math.nan  # of a pairwise transform
        broken.transformer.out_proj.bias[broken.layout.latent] = math.nan
    with pytest.raises(ValueError, match=r"^scene 0, agent \d: the model makes motion that is not finite"):
        WAYS[way](broken, duet)


def test_a_model_made_in_inference_mode_samples_the_same_there_and_outside(model, duet):
    """Its tensors count no versions, by which packed weights are looked up."""

    def sampled(model: Denoiser) -> Scene:
        return generate(model, duet, JointFuture(), CONTEXT, FRAMES, 1, FAST, torch.Generator().manual_seed(0))

    expected = sampled(model).T_world_root
    with torch.inference_mode():
        made = tiny_denoiser(max_agents=3, window=12)
        made.load_state_dict(model.state_dict())
        assert torch.equal(sampled(made).T_world_root, expected)
    assert torch.equal(sampled(made).T_world_root, expected)


def test_weights_that_are_written_unseen_are_sampled_with(model, duet):
    """Torch does not count writes into `.data`, as Lightning's own averages make them."""

    def sampled(model: Denoiser) -> Scene:
        return generate(model, duet, JointFuture(), CONTEXT, FRAMES, 1, FAST, torch.Generator().manual_seed(0))

    written, fresh = copy.deepcopy(model), copy.deepcopy(model)
    before = sampled(written)
    for each in (written, fresh):
        for weight in each.parameters():
            weight.data.mul_(1.01)
    after = sampled(written)
    assert not torch.equal(after.T_world_root, before.T_world_root)
    assert torch.equal(after.T_world_root, sampled(fresh).T_world_root)
    versions = [weight._version for weight in written.parameters()]
    sampled(written)
    assert versions == [weight._version for weight in written.parameters()], "what is the same stays packed"


def test_whoever_is_absent_or_not_yet_there_need_not_be_finite(duet):
    there = torch.ones(duet.frames, 2, dtype=torch.bool)
    require_finite(duet, there, Guidance())
    broken = with_roots(duet, 5, 1, math.nan)
    with pytest.raises(ValueError, match=r"^scene 0, agent 1: the model makes motion that is not finite"):
        require_finite(broken, there, Guidance())
    require_finite(broken.replace(present=torch.tensor([[True, False]])), there, Guidance())
    there[5, 1] = False
    require_finite(broken, there, Guidance())


@pytest.mark.parametrize("task", [JointFuture(), AgenticSync()])
@pytest.mark.parametrize(
    ("guidance", "blamed"),
    [
        (Guidance("history", weight=1e38), "guidance.weight 1e+38"),
        (Guidance("partner", weight=1e38, smooth=1e38), "guidance.weight 1e+38 and guidance.smooth 1e+38"),
    ],
)
def test_guidance_that_is_too_strong_is_blamed_before_the_weights(task, guidance, blamed, duet):
    with pytest.raises(ValueError, match=re.escape(f"(NaN or infinity). {blamed} may be too strong: take less. Else")):
        generate(tiny_denoiser(), duet, task, CONTEXT, FRAMES, 1, dataclasses.replace(FAST, guidance=guidance))


@pytest.mark.parametrize("metres", [1.0, -1.0, 0.4])
@pytest.mark.parametrize("way", WAYS)
def test_another_floor_is_refused_at_every_way_in(way, metres, model, duet):
    where = "over" if metres > 0 else "under"
    with pytest.raises(ValueError, match=rf"^scene 0: everybody stands \d\.\d\d m {where} y = 0.*on_floor"):
        WAYS[way](model, lifted(duet, metres))


@pytest.mark.parametrize("way", [way for way in WAYS if way not in ("live", "live partner")])
def test_an_empty_batch_is_refused_at_every_way_in(way, model, duet):
    with pytest.raises(ValueError, match=r"^got an empty batch of 0 scenes|^got 0 scenes, expected one"):
        WAYS[way](model, duet.select([]))


@pytest.mark.parametrize("way", WAYS)
def test_nobody_at_all_is_refused_at_every_way_in(way, model, duet):
    with pytest.raises(ValueError, match=r"nobody|name some|expected|no such|the grid has|at least 1"):
        WAYS[way](model, duet.permute_agents(torch.tensor([], dtype=torch.long)))


def test_no_frames_are_refused_wherever_some_are_needed(model, duet):
    nothing = duet.slice(0, 0)
    for way in set(WAYS) - {"inpaint"}:
        with pytest.raises(ValueError, match=r"needs 32 frames|needs 4 frames|none to sample|at least|expected 1"):
            WAYS[way](model, nothing)
    assert generate(model, nothing, Generation(), 0, 8, options=FAST).frames == 8
    with pytest.raises(ValueError, match="none to sample"):
        WAYS["inpaint"](model, nothing)


@pytest.mark.parametrize("task", few(registry.names(), 3))
@pytest.mark.parametrize("value", [math.nan, 1e30])
def test_what_a_task_is_not_given_may_hold_anything(task, value, model, duet):
    """And what it is given may not be NaN, whoever and whenever it is."""
    context = GIVEN[task]

    def sampled(scene: Scene) -> Scene:
        generator = torch.Generator().manual_seed(0)
        return generate(model, scene, registry.get(task)(), context, CONTEXT + FRAMES - context, 1, FAST, generator)

    plain = sampled(duet)
    assert plain.given is not None
    given = plain.given[:, :, :2]
    junk = duet.replace(
        T_world_root=torch.where(given[..., None, None], duet.T_world_root, value),
        body_rot=torch.where(given[..., None, None, None], duet.body_rot, value),
    )
    again = sampled(junk)
    assert torch.equal(again.T_world_root, plain.T_world_root) and torch.equal(again.body_rot, plain.body_rot)
    for frame, agent in given[0].nonzero()[[0, -1]].tolist() if given.any() else []:
        with pytest.raises(ValueError, match=f"^scene 0, agent {agent}: frame {frame} is not finite"):
            sampled(with_roots(duet, frame, agent, math.nan))


def test_absent_agents_may_hold_anything(model, duet):
    present = torch.tensor([[True, True, False]])
    scene = duet.pad_agents(3)
    junk = scene.replace(
        T_world_root=torch.where(present[:, None, :, None, None], scene.T_world_root, math.nan),
        betas=torch.where(present[..., None], scene.betas, math.nan),
        present=present,
    )
    sampled = [
        generate(model, each, JointFuture(), CONTEXT, FRAMES, 1, FAST, torch.Generator().manual_seed(0))
        for each in (scene, junk)
    ]
    assert torch.equal(sampled[0].T_world_root[:, :, :2], sampled[1].T_world_root[:, :, :2])


def test_absent_agents_may_hold_anything_where_poses_are_pushed_apart(model):
    """A free slot of one scene is somebody's of the other."""
    present = torch.tensor([[True, False, True], [False, True, True]])
    scene = random_scene(2, CONTEXT, 3, torch.Generator().manual_seed(1), present)
    junk = scene.replace(
        T_world_root=torch.where(present[:, None, :, None, None], scene.T_world_root, math.nan),
        betas=torch.where(present[..., None], scene.betas, math.nan),
    )
    options = SamplerOptions(steps=3, body_guidance="firm", apart="firm", settle="hold", settle_blocks=True)
    made, again = (
        generate(model, each, JointFuture(), CONTEXT, 8, 1, options, torch.Generator().manual_seed(0))
        for each in (scene, junk)
    )
    assert torch.equal(again.T_world_root, made.T_world_root) and torch.equal(again.body_rot, made.body_rot)


def test_which_scene_agent_and_frame_is_wrong_is_said(model):
    scene = random_scene(3, 48, 2, torch.Generator().manual_seed(1)).replace(names=("a", "b", "c"))
    T = scene.T_world_root.clone()
    T[1, 7:10, 1] = math.nan
    with pytest.raises(
        ValueError, match=r"^scene 1 \(b\), agent 1: frame 7 \(and 2 more frames of that scene\) is not"
    ):
        WAYS["generate"](model, scene.replace(T_world_root=T))
    betas = scene.betas.clone()
    betas[2, 0, 3] = math.nan
    with pytest.raises(ValueError, match=r"^scene 2 \(c\), agent 0: betas are not finite"):
        WAYS["generate"](model, scene.replace(betas=betas))


def scaled(scene: Scene) -> Scene:
    return scene.replace(body_rot=1.5 * scene.body_rot)


def mirrored(scene: Scene) -> Scene:
    return scene.replace(body_rot=-scene.body_rot)


def transposed(scene: Scene) -> Scene:
    return scene.replace(T_world_root=scene.T_world_root.transpose(-1, -2))


def emptied(scene: Scene) -> Scene:
    return scene.replace(body_rot=torch.zeros_like(scene.body_rot))


@pytest.mark.parametrize("spoilt", [scaled, mirrored, transposed, emptied], ids=lambda each: each.__name__)
def test_what_is_no_rotation_is_refused(spoilt, model, duet):
    with pytest.raises(ValueError, match=r"scene 0, agent 0: frame 0 .* is no rotation"):
        WAYS["generate"](model, spoilt(duet))


def test_scenes_of_other_float_types_are_sampled_in_float32(model, duet):
    plain = WAYS["generate"](model, duet)
    double = Scene(**{**{k: v.double() if v.is_floating_point() else v for k, v in duet.tensors().items()}})
    got = WAYS["generate"](model, double)
    assert got.T_world_root.dtype == torch.float32
    assert torch.equal(got.T_world_root[:, :CONTEXT], plain.T_world_root[:, :CONTEXT])
    half = duet.replace(body_rot=duet.body_rot.half(), T_world_root=duet.T_world_root.half())
    assert WAYS["generate"](model, half).T_world_root.isfinite().all()


def test_people_who_really_are_up_there_are_taken_if_one_says_so(model, duet):
    high = lifted(duet, 1.0)
    options = dataclasses.replace(FAST, any_floor=True)
    got = generate(model, high, JointFuture(), CONTEXT, FRAMES, options=options)
    assert torch.equal(got.T_world_root[:, :CONTEXT, :2], high.T_world_root[:, :CONTEXT])
    assert Partner(model, high.slice(0, CONTEXT), (1,), options).past.frames == CONTEXT


def test_a_jump_does_not_end_an_answer(model, duet):
    partner = Partner(model, duet.slice(0, CONTEXT), (1,), FAST)
    assert partner.answer(lifted(duet, 0.9).slice(CONTEXT, CONTEXT + 4)).frames == 4


def test_only_those_who_are_given_are_asked_where_their_floor_is(model, duet):
    """Keyframes, too, and whoever is filled in stands nowhere yet."""
    T = duet.T_world_root.clone()
    T[:, :, 0, 1, 3] += 5.0
    scene = duet.replace(T_world_root=T)
    generate(model, scene, PartnerInpainting(target=(0,)), 0, CONTEXT, options=FAST)
    generate(model, scene, JointFuture(), CONTEXT, FRAMES, options=FAST)  # the other one stands on the floor
    with pytest.raises(ValueError, match="everybody stands 4"):
        generate(model, scene, PartnerInpainting(target=(1,)), 0, CONTEXT, options=FAST)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((-4, 16, 1), "context: got -4, expected at least 0"),
        ((16.0, 16, 1), "context: got 16.0, expected a whole number"),
        ((16, -8, 1), "frames: got -8, expected at least 0"),
        ((16, 0.5, 1), "frames: got 0.5, expected a whole number"),
        ((16, 16, 0), "samples: got 0, expected at least 1"),
        ((16, 16, True), "samples: got True, expected a whole number"),
        ((0, 0, 1), "tokens: got 0, expected at least 1"),
        ((48, 0, 1), None),
    ],
)
def test_counts_that_are_none_are_named(numbers, message, model, duet):
    context, frames, samples = numbers
    task = MotionControl() if context == 48 else JointFuture()
    if message is None:
        assert torch.equal(
            generate(model, duet, task, context, frames, samples, FAST).T_world_root[:, :, :2], duet.T_world_root
        )
        return
    with pytest.raises(ValueError, match=message):
        generate(model, duet, task, context, frames, samples, FAST)


CALLS: dict[str, Callable[[Model, Scene], object]] = {
    "generate": lambda own, scene: own.generate(frames=8),
    "predict": lambda own, scene: own.predict(scene, context=CONTEXT, frames=8),
    "continue_": lambda own, scene: own.continue_(scene, 8),
    "inpaint": lambda own, scene: own.inpaint(scene),
    "react": lambda own, scene: own.react(scene),
    "partner": lambda own, scene: own.partner(scene),
}


@pytest.mark.parametrize("call", CALLS)
def test_people_of_another_body_are_warned_of_at_the_line_of_the_user(call, duet):
    model = tiny_denoiser(max_agents=2)
    model.trained_body = "smplx-neutral"
    with pytest.warns(UserWarning, match="trained with body 'smplx-neutral'") as caught:
        CALLS[call](Model(model, FAST), duet)
    assert [each.filename for each in caught] == [__file__]


def test_a_model_that_was_never_trained_is_refused(duet):
    model = Denoiser(tokenizer="raw", network={"width": 16, "layers": 1, "heads": 2})
    with pytest.raises(ValueError, match="denoiser is not trained"):
        WAYS["generate"](model, duet)


def test_sampling_a_model_in_training_mode_drops_nothing_out(duet):
    model = tiny_denoiser(max_agents=2, network={"dropout": 0.5})

    def sampled() -> torch.Tensor:
        return generate(model, duet, JointFuture(), CONTEXT, FRAMES, 1, FAST, torch.Generator().manual_seed(0)).body_rot

    expected = sampled()
    model.train()
    assert torch.equal(sampled(), expected) and model.training and model.transformer.training


@pytest.mark.parametrize("task", ["joint_future", JointFuture])
def test_a_name_or_a_class_in_place_of_a_task_is_told_how_one_is_had(task: object, generator: torch.Generator) -> None:
    with pytest.raises(ValueError, match=r"task: got .*oint.*, expected a task, such as magnet\.tasks\.registry\.get"):
        generate(tiny_denoiser(), random_scene(1, 16, 2, generator), task, 16, 8)  # type: ignore[arg-type]
