"""Scenes that are handed out chunk by chunk are those that are made at once, and cost no more memory."""

import functools
import itertools
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from magnet.generation.blending import cat_time
from magnet.generation.conditioning import known_tokens, mask_unknown, receptive_field, task_lookahead_limit
from magnet.generation.plan import first_changed, periodic_plan
from magnet.generation.rollout import Rollout, generate, stream
from magnet.generation.stats import SamplingStats
from magnet.generation.world import WorldState
from magnet.motion.scene import Scene
from magnet.sampling.grid import planning_grid
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import NoiseStream
from magnet.sampling.options import SamplerOptions
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import Grid
from magnet.tasks import registry
from magnet.tasks.agentic import AgenticAsync
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.joint import JointFuture
from magnet.tasks.partner import MotionControl, PartnerInpainting, PartnerPrediction
from magnet.testing import random_scene, tiny_denoiser, tiny_tokenizer
from magnet.testing.poses import blocks_of
from tests.cases import few, some_quick, some_slow

FAST = SamplerOptions(steps=2, stride=2)
TOKENS = 36
LONG, SHORT = 85, 64
"""Frames of causal scenes after eight of context: rows are let go, and the last token is a part of one."""

TASKS = {
    **{name: registry.get(name)() for name in registry.names()},
    "one agent's keyframes, far apart": Inbetweening(keys=(22, -1), agents=(1,)),
    "one keyframe, nothing before": Inbetweening(keys=(30,), agents=(0,)),
    "some given for long": PartnerInpainting((1,)),
    "some end": PartnerPrediction((2,)),
    "blocks": MotionControl((0, 2), block=2),
    "turns": AgenticAsync(offset=0.5, order=(2, 0)),
}
FROM_NOTHING = ("generation", "one keyframe, nothing before")


@pytest.fixture(scope="module")
def recording() -> Scene:
    return random_scene(2, 4 * TOKENS, 3, torch.Generator().manual_seed(3))


def at_once(model, scene: Scene, task, context: int, frames: int, options: SamplerOptions, seed: int = 0) -> Scene:
    """The whole scene on one world: encoded, sampled and decoded in one go."""
    grid = planning_grid(-(-(context + frames) // 4), 3, context // 4, model.window, options)
    schedule = task.schedule(grid)
    given = mask_unknown(scene, schedule.known)
    world = WorldState(model, given, schedule, options, 1)
    start = known_tokens(model, given, schedule.known, limits=task_lookahead_limit(task, grid))
    generator = torch.Generator().manual_seed(seed)
    noise = NoiseStream((scene.scenes, 3, model.layout.width), generator, eta=options.eta)
    how = {"guidance": options.guidance, "noise": noise, "solver": options.solver}
    out = sample(model.denoise, schedule, start, given.present, model.layout, on_stage_end=world.make_consistent, **how)
    with torch.no_grad():
        return world.scene(out).slice(0, context + frames)


def streamed(model, scene: Scene, task, context: int, frames: int | None, chunk: int, options=FAST, seed: int = 0):
    options = replace(options, precision="reference")  # `at_once` runs the network as it was trained
    return stream(model, scene, task, context, frames, 1, options, torch.Generator().manual_seed(seed), chunk=chunk)


def context_of(name: str) -> int:
    return 0 if name in FROM_NOTHING else 8


def close(a: Scene, b: Scene) -> bool:
    return all(torch.allclose(value, getattr(b, name), atol=1e-5) for name, value in a.tensors().items())


def same(a: Scene, b: Scene) -> bool:
    return all(torch.equal(value, getattr(b, name)) for name, value in a.tensors().items())


# -- the same scene ----------------------------------------------------------------------------


CAUSAL = ("motion_control", "agentic_sync", "agentic_async", "blocks", "turns")


WHOLE = [*((name, 3) for name in TASKS if name not in CAUSAL), ("joint_future", 8), ("some end", 64)]


@pytest.mark.parametrize(("name", "chunk"), few(WHOLE, 2))
def test_pieces_make_up_the_scene_made_at_once(model, recording, name, chunk):
    context = context_of(name)
    frames = 4 * TOKENS - context - 3
    chunks = list(streamed(model, recording, TASKS[name], context, frames, chunk))
    assert [made.frames for made in chunks[:-1]] == [4 * chunk] * (len(chunks) - 1)
    whole = cat_time(chunks)
    assert whole.frames == context + frames
    assert close(at_once(model, recording, TASKS[name], context, frames, FAST), whole)


@pytest.fixture(scope="module")
def made(model, recording) -> Callable[..., Scene]:
    """Scenes of a causal task, put together from chunks; what several laws compare is made once."""

    @functools.cache
    def make(name: str, frames: int = LONG, chunk: int = 64, options: SamplerOptions = FAST) -> Scene:
        return cat_time(list(streamed(model, recording, TASKS[name], 8, frames, chunk, options)))

    return make


@pytest.mark.slow
@pytest.mark.parametrize("name", some_slow(CAUSAL, *CAUSAL[1:]))
def test_people_who_make_way_do_not_depend_on_the_pieces_either(made, name):
    """Nor, in causal plans, on when the scene ends: nobody makes way for what has not been seen."""
    options = replace(FAST, apart="firm")
    whole, rows, short = (made(name, *how, options) for how in ((LONG, 64), (LONG, 1), (SHORT, 64)))
    assert same(whole, rows)
    assert same(whole.slice(0, short.frames), short)
    assert not same(whole, made(name))


@pytest.mark.parametrize("name", some_quick(CAUSAL, "motion_control"))
def test_bodies_of_causal_plans_do_not_depend_on_the_pieces_bit_for_bit(made, name):
    """Nor on when rows are let go: one chunk holds them all."""
    whole, chunks, rows = (made(name, LONG, chunk) for chunk in (64, 5, 1))
    assert same(whole, chunks) and same(whole, rows)


@pytest.mark.parametrize("name", some_quick(CAUSAL, "motion_control", "blocks"))
def test_the_same_happens_however_long_a_causal_scene_goes_on(made, name):
    """Live, nobody knows where it ends."""
    long, short = made(name), made(name, SHORT)
    assert same(long.slice(0, short.frames), short)


@pytest.mark.parametrize("name", some_quick(CAUSAL, "blocks", "turns"))
def test_each_piece_of_a_causal_scene_comes_before_the_next_block_is_begun(model, recording, name):
    done: list[int] = []
    chunks = stream(model, recording, TASKS[name], 8, 96, 1, FAST, progress=done.append, chunk=1)
    blocks = list(blocks_of(TASKS[name].schedule(planning_grid(26, 3, 2, 8, FAST))))
    for row in range(26):
        next(chunks)
        needed = [stages for stages, end in blocks if end <= row] + [b for b, end in blocks if end > row][: row >= 2]
        assert len(done) == sum(len(stage.levels) - 1 for stages in needed for stage in stages)


HOWS = [
    SamplerOptions(steps=2, stride=2, placement="integrate"),
    SamplerOptions(steps=2, stride=2, blend=17),
    SamplerOptions(steps=2, stride=2, smooth_path=True, keep_given=False),
    SamplerOptions(steps=3, stride=2, solver="ddim", spacing="even", eta=1.0, shift=3.0),
    SamplerOptions(steps=5, pyramid_offset=2, solver="dpmpp_2m", spacing="log_snr", eta=0.5, shift=1.0),
    SamplerOptions(steps=2, stride=2, guidance=Guidance(smooth=1e-3)),
]
SLOW_HOWS = [
    SamplerOptions(steps=2, stride=3, placement="anchor", keep_given=False),
    SamplerOptions(steps=2, stride=2, requantize=False),
    SamplerOptions(steps=2, stride=2, smooth_path=True),
    SamplerOptions(steps=4, pyramid_offset=2),
    SamplerOptions(steps=4, pyramid_offset=2, eta=0.5),
    SamplerOptions(steps=4, stride=2, solver="dpmpp_2m", spacing="log_snr", eta=0.0, shift=1.0),
    SamplerOptions(steps=2, stride=2, guidance=Guidance("partner")),
]


@pytest.mark.parametrize("options", some_quick([*HOWS, *SLOW_HOWS], *HOWS[1::2]), ids=str)
def test_pieces_make_up_the_scene_however_it_is_sampled(model, recording, options):
    for task in (JointFuture(), PartnerInpainting((1,))):
        chunks = list(streamed(model, recording, task, 8, 77, 5, options))
        assert close(at_once(model, recording, task, 8, 77, options), cat_time(chunks))


@pytest.mark.slow
def test_generate_returns_the_pieces_of_a_stream_bit_for_bit(model, recording):
    long, plain = random_scene(2, 300, 3, torch.Generator().manual_seed(4)), replace(FAST, precision="reference")
    for task in (JointFuture(), PartnerInpainting()):
        chunks = list(streamed(model, long, task, 8, 292, 64))
        assert [made.frames for made in chunks] == [256, 44]
        assert same(cat_time(chunks), generate(model, long, task, 8, 292, 1, plain, torch.Generator().manual_seed(0)))


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("depth", [1, 2])
def test_long_given_stretches_are_encoded_in_pieces_as_they_are_whole(causal, depth):
    """An encoder looks no further than the decoder's reach."""
    model = tiny_denoiser(max_agents=2)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        model.tokenizer = tiny_tokenizer(network={"depth": depth, "causal": causal}).eval()
    scene = random_scene(1, 400, 2, torch.Generator().manual_seed(5))
    before, after = receptive_field(model)

    def embedded(scene: Scene) -> torch.Tensor:
        model.tokenizer.requantize, kept = (lambda latent: latent), model.tokenizer.requantize
        model.tokenizer.quantizer.nearest = lambda vectors: vectors
        try:
            with torch.no_grad():
                return model.encode(scene)
        finally:
            model.tokenizer.requantize = kept

    whole = embedded(scene)
    part = embedded(scene.slice(4 * (40 - before), 4 * (50 + after)))[:, before : before + 10]
    assert torch.allclose(whole[:, 40:50], part, atol=1e-5)


def test_whoever_ends_stands_still_across_pieces(model, recording):
    whole = cat_time(list(streamed(model, recording, PartnerPrediction((0,)), 8, 100, 4)))
    still = whole.T_world_root[:, 8:, 1:]
    assert torch.equal(still, still[:, :1].expand_as(still))


# -- memory and time ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", some_quick(registry.names(), "generation", "partner_prediction"))
def test_no_more_rows_are_held_for_a_longer_scene(model, name):
    scene = random_scene(1, 160, 3, torch.Generator().manual_seed(6))

    def most_rows(frames: int) -> int:
        context = context_of(name)
        options = SamplerOptions(steps=1, stride=4)
        stream = Rollout(model, scene, TASKS[name], context, frames - context, 1, options, chunk=4)
        held = 0
        for _ in stream.chunks():
            held = max(held, stream.tokens.shape[1] + stream.mask_noise.shape[1])
            held = max(held, stream.world.T_world_can.shape[1] // 4 + stream.world.given.frames // 4)
        return held

    assert most_rows(160) == most_rows(128) < 70


def test_the_first_piece_comes_long_before_the_last(model, recording):
    """A live viewer shows what is there already."""
    done = []
    chunks = stream(model, recording, JointFuture(), 8, 160, 1, FAST, progress=done.append, chunk=4)
    next(chunks)
    whole = JointFuture().schedule(planning_grid(42, 3, 2, 8, FAST))
    assert 0 < len(done) < 0.4 * whole.evaluations


def test_nothing_that_the_stream_sets_is_left_set_between_pieces(model, recording):
    chunks = streamed(model, recording, JointFuture(), 8, 100, 4)
    with torch.autocast("cpu", torch.bfloat16):
        next(chunks)
        assert torch.is_autocast_enabled("cpu") and torch.is_grad_enabled()
    next(chunks)
    assert not torch.is_autocast_enabled("cpu") and torch.is_grad_enabled()


# -- what is final when ------------------------------------------------------------------------


@pytest.mark.parametrize("name", few(list(TASKS)[::-1], 5))
def test_no_stage_changes_rows_before_those_that_it_may_change(model, recording, name):
    context = context_of(name)
    schedule = TASKS[name].schedule(Grid(TOKENS, 3, context // 4, 2, 8, 2))
    given = mask_unknown(recording, schedule.known)
    world = WorldState(model, given, schedule, FAST, 1)
    low = iter(first_changed(schedule))
    before: list[tuple[torch.Tensor, torch.Tensor]] = [(torch.empty(0), world.T_world_can.clone())]

    def on_stage_end(tokens: torch.Tensor, finished: torch.Tensor, decentralized: bool) -> torch.Tensor:
        first = next(low)
        after = world.make_consistent(tokens.clone(), finished, decentralized)
        old_tokens, old_world = before[-1]
        if len(old_tokens):
            assert torch.equal(old_tokens[:, :first], after[:, :first])
        assert torch.equal(old_world[:, : 4 * first], world.T_world_can[:, : 4 * first])
        before.append((after.clone(), world.T_world_can.clone()))
        return after

    start = known_tokens(model, given, schedule.known)
    sample(model.denoise, schedule, start, given.present, model.layout, torch.Generator().manual_seed(0), on_stage_end)
    assert next(low, None) is None


# -- without end -------------------------------------------------------------------------------

GOES_ON = ("joint_future", "generation", "agentic_sync", "agentic_async", "partner_prediction")


@pytest.mark.parametrize(
    ("name", "pyramid_offset"),
    some_quick([*((name, 0) for name in GOES_ON), ("joint_future", 2)], ("generation", 0), ("joint_future", 2)),
)
def test_a_scene_without_end_begins_like_one_with_an_end(model, recording, name, pyramid_offset):
    context = context_of(name)
    options = SamplerOptions(steps=1 + 3 * bool(pyramid_offset), stride=4, pyramid_offset=pyramid_offset)
    short = recording.slice(0, context).select([0])
    ended, begun = (
        cat_time(list(itertools.islice(streamed(model, short, TASKS[name], context, frames, 8, options), 3)))
        for frames in (200, None)
    )
    assert begun.frames == 3 * 32
    assert same(ended, begun)


@pytest.mark.parametrize("name", ["partner_inpainting", "motion_control", "inbetweening"])
def test_tasks_that_are_given_something_later_need_an_end(model, recording, name):
    with pytest.raises(ValueError, match="so it cannot be endless: give the number of frames"):
        streamed(model, recording, TASKS[name], context_of(name), None, 8)


def test_a_plan_that_does_not_repeat_itself_needs_an_end():
    class Odd(JointFuture):
        def schedule(self, grid: Grid):
            plan = super().schedule(grid)
            return type(plan)(plan.tokens, plan.agents, plan.stages[:1], plan.known)

    with pytest.raises(ValueError, match="is not periodic"):
        periodic_plan(Odd(), Grid(4, 3, 2, 2, 8, 2), 3)


def test_bad_requests_are_named_before_anything_is_sampled(model, recording):
    for chunk in (0, 1.5):
        with pytest.raises(ValueError, match=f"chunk: got {chunk}"):
            streamed(model, recording, JointFuture(), 8, 20, chunk)
    with pytest.raises(ValueError, match="context of 7 frames"):
        streamed(model, recording, JointFuture(), 7, 20, 4)
    with pytest.raises(ValueError, match="the task needs 400 frames, the scene has 144"):
        streamed(model, recording, PartnerInpainting(), 8, 392, 4)


# -- one generator for each scene --------------------------------------------------------------


SOLVED = [(name, solver, eta) for solver, eta in (("dpmpp_2m", 0.0), ("ddim", 1.0)) for name in registry.names()]


@pytest.mark.parametrize(
    ("name", "solver", "eta"),
    some_quick(SOLVED, *(case for case in SOLVED if "joint_future" in case), ("inbetweening", "dpmpp_2m", 0.0)),
)
def test_a_batch_of_scenes_equals_single_runs_when_each_has_its_own_noise(model, recording, name, solver, eta):
    context, options = context_of(name), SamplerOptions(steps=3, stride=2, eta=eta, solver=solver)

    def run(scene: Scene, seeds: range, samples: int) -> Scene:
        each = [torch.Generator().manual_seed(seed) for seed in seeds]
        return generate(model, scene, TASKS[name], context, 48 - context, samples, options, each)

    batch = run(recording, range(4), 2)
    for number in (0, 3):  # the first scene's first sample, and the second scene's second
        single = run(recording.select([number // 2]), range(number, number + 1), 1)
        assert close(single, batch.select([number]))


def test_as_many_generators_as_scenes_are_needed(model, recording):
    with pytest.raises(ValueError, match="got 2 generators for 4 scenes"):
        generate(model, recording, JointFuture(), 8, 8, 2, FAST, [torch.Generator(), torch.Generator()])


# -- what it costs -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "guidance", "views", "branches"),
    few(
        [
            ("joint_future", Guidance(), 1, 1),
            ("joint_future", Guidance("history"), 1, 2),
            ("joint_future", Guidance("self"), 1, 5),  # everybody, nobody, and each of three alone
            ("joint_future", Guidance("partner"), 1, 5),
            ("joint_future", Guidance(smooth=0.01), 1, 1),
            ("agentic_sync", Guidance(), 3, 1),
            ("agentic_sync", Guidance("history"), 3, 2),
            ("agentic_async", Guidance(), 1, 1),  # nobody is hidden from one that another sees
            ("agentic_async", Guidance("history"), 1, 2),
        ],
        4,
    ),
)
def test_calls_and_evaluations_are_counted(model, recording, name, guidance, views, branches):
    stats = SamplingStats()
    options = SamplerOptions(steps=3, stride=2, guidance=guidance)
    schedule = registry.get(name)().schedule(planning_grid(7, 3, 4, 8, options))
    for _ in range(2):
        generate(model, recording, registry.get(name)(), 16, 12, 2, options, stats=stats)
    assert stats.calls == 2 * schedule.evaluations
    assert stats.evaluations == schedule.evaluations * views * branches
    means = stats.means()
    assert (means["calls"], means["evaluations"]) == (schedule.evaluations, stats.evaluations)


@pytest.mark.parametrize("name", ["partner_inpainting", "inbetweening", "motion_control"])
def test_a_scene_that_ends_within_a_token_is_enough_for_tasks_given_all_of_it(name, generator):
    """32 and 150 frames, the defaults of `magnet test`, are 45 tokens and a half."""
    model = tiny_denoiser(max_agents=2, window=8)
    scene = random_scene(1, 34, 2, generator)
    out = generate(model, scene, registry.get(name)(), 8, 26, options=SamplerOptions(steps=2))
    assert out.frames == 34
    with pytest.raises(ValueError, match="the task needs"):
        generate(model, scene.slice(0, 30), registry.get(name)(), 8, 26, options=SamplerOptions(steps=2))
