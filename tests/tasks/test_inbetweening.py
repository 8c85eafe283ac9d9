import dataclasses

import pytest
import torch
from torch import Tensor

from magnet import checkpoints
from magnet.datamodules.synthetic import Synthetic
from magnet.denoiser.module import Denoiser
from magnet.generation.blending import next_known, seam_weights, warp_to_keyframe
from magnet.generation.conditioning import known_tokens, mask_unknown
from magnet.generation.rollout import generate
from magnet.generation.world import WorldState
from magnet.motion.frames import canonical_frame, from_9d, from_planar, inverse, pairwise, to_planar
from magnet.motion.scene import Scene
from magnet.motion.tokens import by_frame, pairwise_by_frame
from magnet.sampling.options import SamplerOptions
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import Grid
from magnet.tasks.inbetweening import Inbetweening, key_positions, next_keys
from magnet.tasks.partner import PartnerInpainting
from magnet.testing import random_scene, tiny_denoiser
from tests.cases import few

# What an untrained model says of pairs contradicts what it says of steps: it is trusted as little as steps allow.
FAST = {
    placement: SamplerOptions(steps=3, stride=2, placement=placement, pairwise_weight=0.003)
    for placement in ("integrate", "fuse")
}


KEY = torch.tensor([[0.03, 0.025]])
"""Metres forward and aside from a known frame to the next."""


@pytest.fixture(params=FAST)
def options(request) -> SamplerOptions:
    return FAST[request.param]


@pytest.fixture(scope="module")
def model():
    return tiny_denoiser(max_agents=4, window=8)


def settled(model, scene, task, options, tokens: int, context: int = 2):
    """The finished world of a task, its tokens, and the tokens it was given."""
    schedule = task.schedule(Grid(tokens, 4, context, 3, 8, 2))
    given = mask_unknown(scene.pad_agents(4), schedule.known)
    world = WorldState(model, given, schedule, options, 1)
    start = known_tokens(model, given, schedule.known)
    generator = torch.Generator().manual_seed(0)
    out = sample(model.denoise, schedule, start, given.present, model.layout, generator, world.make_consistent)
    return world, out, start, schedule.known


# -- the plan ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "keys"),
    [
        (Inbetweening(every=4), {0: {5, 9, 13, 15}, 1: {5, 9, 13, 15}}),
        (Inbetweening(keys=(7, -1)), {0: {7, 15}, 1: {7, 15}}),
        (Inbetweening(keys=(7,), agents=(1,)), {0: set(), 1: {7}}),
        (Inbetweening(pairs=((0, 4), (1, 9))), {0: {4}, 1: {9}}),
        (Inbetweening(keys=(7,), agents=(0,), pairs=((1, 9),)), {0: {7}, 1: {9}}),
        (Inbetweening(pairs=[[0, 4], [1, 9]]), {0: {4}, 1: {9}}),
        (Inbetweening(keys=(-14,)), {0: {2}, 1: {2}}),
        (Inbetweening(), {0: {9, 15}, 1: {9, 15}}),
    ],
)
def test_keyframes_are_where_they_were_asked_for(task, keys):
    schedule = task.schedule(Grid(16, 2, 2, 3))
    for agent, steps in keys.items():
        assert set(schedule.known[:, agent].nonzero()[:, 0].tolist()) == {0, 1} | steps
    assert schedule.finished.all()


def test_without_a_past_keyframes_are_counted_from_the_first_token_step():
    known = Inbetweening(keys=(-16, 7)).schedule(Grid(16, 2, 0, 3)).known
    assert known[:, 0].nonzero()[:, 0].tolist() == [0, 7]
    assert Inbetweening().schedule(Grid(20, 1, 0, 3)).known[:, 0].nonzero()[:, 0].tolist() == [0, 8, 16, 19]


@pytest.mark.parametrize(("window", "stride"), [(4, 2), (8, 2), (16, 2), (16, 4), (16, 12)])
@pytest.mark.parametrize("task", [Inbetweening(every=6), Inbetweening(keys=(20, -1)), Inbetweening(pairs=((0, 19),))])
def test_whatever_can_be_is_generated_in_sight_of_the_next_keyframe(task, window, stride):
    schedule = task.schedule(Grid(32, 2, 4, 3, window, stride))
    assert schedule.finished.all()
    for stage in schedule.stages:
        for token, agent in ((stage.levels[0] > 0) & (stage.levels[-1] == 0)).nonzero().tolist():
            step = stage.start + token
            coming = schedule.known[step:, agent].nonzero()
            if len(coming) and int(coming[0]) < window - min(stride, window // 2):
                assert step + int(coming[0]) < stage.stop
        first = int(((stage.levels[0] > 0) & (stage.levels[-1] == 0)).any(dim=1).int().argmax())
        assert first >= min(stage.start + first, stride, window // 2)  # some past is in view, where there is so much


def test_named_keyframes_are_those_that_are_known():
    task = Inbetweening(keys=(7, -1), agents=(0,), pairs=((1, 9), (1, -3)))
    known = task.schedule(Grid(16, 2, 0, 3)).known
    assert task.named(16) == known.any(dim=1).nonzero()[:, 0].tolist() == [7, 9, 13, 15]


def check_position(known: Tensor, grid: Grid, start: int, first: int, done: int) -> None:
    """One position of the window, of keyframes (N, P) bool: what is documented of `key_positions`."""
    N, W = len(known), grid.window
    stop, most = start + min(W, N), min(grid.stride, W // 2)
    keys = next_keys(known)
    assert 0 <= start <= first < done <= stop <= N and not known[first].all()
    assert first - start >= min(first, most), "some past is in view, where there is so much"
    seen = keys[first][~known[first]]
    seen = seen[(seen < N) & (seen - first < W - min(first, most))]
    assert (seen < stop).all(), "a keyframe that fits into the window after its gap is in it"
    if not len(seen):
        assert done <= max(first + grid.stride, W), "with none in sight it goes on stride by stride"
    if done < stop:  # somebody is left to a later window, who will see their keyframe from there
        later = keys[done][~known[done]]
        assert ((later >= stop) & (later < N) & (later - done < W - most)).any()


def test_windows_go_to_the_keyframes_in_sight_and_by_strides_where_there_are_none(generator):
    """Of everybody at once and of each at other times, with a past and without."""
    for trial in range(150):
        N, P, W, stride, context = (
            int(torch.randint(low, high, (), generator=generator))
            for low, high in ((1, 40), (1, 4), (1, 17), (1, 17), (0, 6))
        )
        grid = Grid(N, P, min(context, N), 2, W, min(stride, W))
        scarce = torch.rand((), generator=generator) * 0.3
        known = grid.past() | (torch.rand(N, P if trial % 2 else 1, generator=generator) < scarce)
        after = 0
        for start, first, done in key_positions(known, grid):
            assert first == after + int((~known[after:]).any(dim=1).int().argmax()), "nothing is left out"
            check_position(known, grid, start, first, done)
            after = done
        assert known[after:].all()


def test_bad_keyframes_are_named():
    grid = Grid(16, 2, 2)
    for task, message in [
        (Inbetweening(keys=(16,)), "token step 16: the grid has steps 0 to 15"),
        (Inbetweening(keys=(-17,)), "token step -17: the grid has steps 0 to 15"),
        (Inbetweening(pairs=((-1, 4),)), "agent -1: the grid has agents 0 to 1"),
        (Inbetweening(pairs=((0, 4, 9),)), r"pairs: got \(0, 4, 9\), expected an agent's slot and a token step"),
        (Inbetweening(pairs=4), r"pairs: got 4, expected whole numbers in brackets"),
        (Inbetweening(keys=(3,), agents=(2,)), "agent 2: the grid has agents 0 to 1"),
        (Inbetweening(agents=(1,), pairs=((0, 4),)), "leave agents out, or name keys"),
        (Inbetweening(every=0), "at least 1"),
        (Inbetweening(every=1), "nothing to generate"),
    ]:
        with pytest.raises(ValueError, match=message):
            task.schedule(grid)


# -- the world ---------------------------------------------------------------------------------

TASKS = {
    "regular": Inbetweening(every=5),
    "at the very end": Inbetweening(keys=(-1,)),
    "adjacent": Inbetweening(keys=(5, 6, 7)),
    "one agent's": Inbetweening(keys=(4, 9), agents=(0,)),
}


@pytest.mark.parametrize("people", few([1, 2, 3, 4]))
@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_keyframes_come_back_bit_identical_and_nothing_jumps_there(model, options, generator, people, task):
    scene = random_scene(2, 48, people, generator)
    options = dataclasses.replace(options, blend=10)  # random poses have no speed that one could go on with for longer
    whole = generate(model, scene, task, 8, 40, 1, options, torch.Generator().manual_seed(0))
    known = task.schedule(Grid(12, 4, 2, 3, 8, 2)).known[:, :people].repeat_interleave(4, dim=0)
    there = whole.permute_agents(torch.arange(people))
    assert torch.equal(there.T_world_root[known.expand(2, -1, -1)], scene.T_world_root[known.expand(2, -1, -1)])
    assert torch.equal(there.body_rot[known.expand(2, -1, -1)], scene.body_rot[known.expand(2, -1, -1)])
    assert there.T_world_root.isfinite().all()
    seam, inside = changes(there, known)
    for what, most in seam.items():
        assert (most < 1.2 * inside[what]).all(), what


@pytest.mark.parametrize("task", few(TASKS.values(), 1), ids=TASKS)
def test_nothing_jumps_at_the_keyframes_of_the_model_that_ships(task):
    """As it samples by default, but for the number of steps, on a scene that it made and on people it never saw."""
    model, options = Denoiser.load("duet"), SamplerOptions(steps=6)
    made = Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz").slice(0, 64)
    handshake = Synthetic(test_clips=1).scene("test", 2).scene.slice(0, 64)
    for scene in (made, handshake):
        whole = generate(model, scene, task, 8, 56, 2, options, torch.Generator().manual_seed(0))
        there = whole.permute_agents(torch.arange(scene.agents))
        seam, inside = changes(there, there.given[0])
        for what, most in seam.items():
            assert (most < 1.2 * inside[what]).all(), what


def changes(scene: Scene, known: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The largest change from frame to frame of each agent's root and body: at seams, and between generated frames."""
    root = scene.T_world_root.diff(dim=1).flatten(-2).norm(dim=-1)
    body = scene.body_rot.diff(dim=1).flatten(-3).norm(dim=-1)
    seam, inside = known[1:] != known[:-1], ~known[1:] & ~known[:-1]
    here = scene.present.any(dim=0) & seam.any(dim=0)

    def most(where: Tensor) -> dict[str, Tensor]:
        found = {"root": root.masked_fill(~where, 0), "body": body.masked_fill(~where, 0)}
        return {what: change.amax(dim=(0, 1))[here] for what, change in found.items()}

    return most(seam), most(inside)


@pytest.mark.parametrize("task", [*TASKS.values(), Inbetweening(keys=(-1,), agents=(1,))], ids=[*TASKS, "other's"])
@pytest.mark.parametrize("tokens", few([12, 26], 1))
def test_tokens_agree_with_the_world_everywhere(model, options, generator, task, tokens):
    """Gaps shorter and longer than the window of 8; steps into keyframes too."""
    scene = random_scene(2, tokens * 4, 3, generator)
    world, out, _, _ = settled(model, scene, task, options, tokens)
    _, steps, pairs = model.layout.unpack(model.normalizer.denormalize(out))
    T_world_can = world.T_world_can
    assert world.placed[:, :3].all()
    assert torch.allclose(T_world_can[:, :-1] @ from_9d(by_frame(steps))[:, 1:], T_world_can[:, 1:], atol=2e-3)
    assert torch.allclose(from_9d(pairwise_by_frame(pairs)), pairwise(T_world_can), atol=2e-3)


def test_of_known_tokens_only_the_step_into_them_changes(model, options, scene):
    _, out, start, known = settled(model, scene, Inbetweening(keys=(6, 7)), options, 12)
    own = model.layout.latent + 36
    first = torch.zeros(own, dtype=torch.bool)
    first[model.layout.latent : model.layout.latent + 9] = True
    assert torch.equal(out[:, known][..., :own][..., ~first], start[:, known][..., :own][..., ~first])
    changed = (out[..., :own][..., first] != start[..., :own][..., first]).any(dim=-1).any(dim=0)
    entered = torch.zeros_like(known)
    entered[6] = True
    assert torch.equal(changed & known, entered)


def test_keyframes_without_a_past_place_the_scene(model, options, generator):
    """Nothing is known before: whoever arrives first takes the others along, and distances stay as generated."""
    scene = random_scene(2, 48, 2, generator)
    task = Inbetweening(keys=(6,), agents=(0,))
    whole = generate(model, scene, task, 0, 48, 1, options, torch.Generator().manual_seed(0))
    whole = whole.permute_agents(torch.arange(2))
    assert torch.equal(whole.T_world_root[:, 24:28, 0], scene.T_world_root[:, 24:28, 0])
    step = (whole.T_world_root[:, 1:, :, :3, 3] - whole.T_world_root[:, :-1, :, :3, 3]).norm(dim=-1)
    assert step[:, 23].max() < 0.5 and step.isfinite().all()


def test_moving_the_world_moves_what_is_between(model, options, scene):
    T = from_planar(torch.tensor(0.9), torch.tensor([4.0, -2.0]))
    a, b = (
        generate(model, s, Inbetweening(every=5), 8, 40, 1, options, torch.Generator().manual_seed(0))
        for s in (scene, scene.transformed(T))
    )
    assert torch.allclose(a.transformed(T).T_world_root[:, :, :3], b.T_world_root[:, :, :3], atol=2e-3)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_with_the_true_tokens_everybody_is_where_they_were(model, options, scene, task):
    """Placement alone: what is left is the guess of the one step into each keyframe, spread over its gap."""
    scene = scene.slice(0, 48).pad_agents(4)
    schedule = task.schedule(Grid(12, 4, 2, 3, 8, 2))
    given = mask_unknown(scene, schedule.known)
    world = WorldState(model, given, schedule, options, 1)
    truth = known_tokens(model, scene, torch.ones_like(schedule.known))
    position = iter([stage for stage in schedule.stages for _ in range(len(stage.levels) - 1)])

    def oracle(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        stage = next(position)
        return truth[:, stage.start : stage.stop]

    start = known_tokens(model, given, schedule.known)
    out = sample(oracle, schedule, start, scene.present, model.layout, on_stage_end=world.make_consistent)
    true = canonical_frame(scene.T_world_root)
    yaw, ground = to_planar(inverse(true) @ world.T_world_can)
    assert yaw[:, :, :3].abs().max() < 0.02 and ground[:, :, :3].abs().max() < 0.02
    steps, true_steps = (model.layout.unpack(model.normalizer.denormalize(x))[1] for x in (out, truth))
    assert torch.allclose(steps[:, 1:, :3], true_steps[:, 1:, :3], atol=0.02)


def test_given_partners_beside_keyframes_are_not_moved(model, options, scene):
    whole = generate(model, scene, PartnerInpainting((1,)), 8, 40, 1, options, torch.Generator().manual_seed(0))
    assert torch.equal(whole.T_world_root[:, :, [0, 2]], scene.T_world_root[:, :48, [0, 2]])


# -- the parts ---------------------------------------------------------------------------------


def path(generator: torch.Generator, frames: int = 40) -> Tensor:
    return canonical_frame(random_scene(3, frames, 1, generator).T_world_root)[:, :, 0]


def test_a_path_that_arrives_is_hardly_bent(generator):
    """Real paths meet their own continuation; the guess of one step is all that is spread."""
    whole = path(generator)
    bent = warp_to_keyframe(whole[:, :30], whole[:, 30], inverse(whole[:, 30]) @ whole[:, 31])
    assert torch.allclose(bent, whole[:, :30], atol=1e-2)


def test_a_path_that_misses_is_bent_and_adds_no_speed_at_its_ends(generator):
    whole = path(generator)
    off = from_planar(torch.tensor(0.6), torch.tensor([0.5, -0.8]))
    key = whole[:, 30] @ off
    step = inverse(whole[:, 30]) @ whole[:, 31]
    bent = torch.cat([warp_to_keyframe(whole[:, :30], key, step), key[:, None]], dim=1)
    assert torch.allclose(bent[:, 0], whole[:, 0])
    yaw_steps = (
        to_planar(inverse(bent[:, :-1]) @ bent[:, 1:])[0] - to_planar(inverse(whole[:, :30]) @ whole[:, 1:31])[0]
    )
    assert yaw_steps[:, [0, -1]].abs().max() < 0.2 * yaw_steps.abs().max()
    way = to_planar(inverse(bent[:, :-1]) @ bent[:, 1:])[1].norm(dim=-1)
    assert (way[:, -1] < 1.05 * way.max(dim=1).values).all()


def test_a_path_arrives_as_fast_as_it_goes_on(generator):
    """Predicted: half as fast, straight on, past the known frame; known: four centimetres and a tenth of a turn."""
    time = torch.arange(40.0)
    slow = from_planar(torch.zeros(40), torch.stack([0.02 * time, torch.zeros(40)], dim=-1))[None].double()
    key, step = from_planar(torch.tensor([0.5]), torch.tensor([[0.8, 0.3]])), from_planar(torch.tensor([0.03]), KEY)
    key, step = key.double(), step.double()

    def last_steps(arrives: int):
        bent = torch.cat([warp_to_keyframe(slow, key, step, arrives), key[:, None], (key @ step)[:, None]], dim=1)
        assert torch.allclose(bent[:, 0], slow[:, 0])
        turn, way = to_planar(inverse(bent[:, :-1]) @ bent[:, 1:])
        return turn[0, -4:].diff().abs().max(), way[0, -4:].diff(dim=0).norm(dim=-1).max()

    before, after = last_steps(0), last_steps(18)
    assert after[0] < before[0] / 4 and after[1] < before[1] / 4


def test_seams_fade_on_both_sides_and_share_a_short_gap():
    keep = torch.tensor([1, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0, 1], dtype=torch.bool)[:, None]
    behind, ahead = seam_weights(keep, 4)[0][:, 0], seam_weights(keep.flip(0), 4)[0].flip(0)[:, 0]
    assert torch.allclose(behind[1:4] + ahead[1:4], torch.ones(3))
    assert (behind[1:4].diff() < 0).all() and (ahead[1:4].diff() > 0).all()
    assert behind[9] == 0 and ahead[8] == 0 and ahead[11] > ahead[10] > 0
    assert next_known(keep)[:, 0].tolist() == [0, 4, 4, 4, 4, 5, *[12] * 7]
