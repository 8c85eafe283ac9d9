"""What is given live is encoded as it would be live: no code tells what comes later."""

import itertools

import pytest
import torch

from magnet.generation.blending import cat_time
from magnet.generation.conditioning import encodings, known_tokens, lookahead_limit, mask_unknown, task_lookahead_limit
from magnet.generation.rollout import stream
from magnet.generation.world import WorldState
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import Grid
from magnet.tasks import registry
from magnet.tasks.partner import MotionControl, PartnerInpainting
from magnet.testing import random_scene, tiny_denoiser, tiny_tokenizer
from tests.cases import some_quick, some_slow

FAST = SamplerOptions(steps=2, stride=2)
TOKENS, PAST = 24, 3


def denoiser(causal: bool = False):
    model = tiny_denoiser(max_agents=3, window=8)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        model.tokenizer = tiny_tokenizer(network={"causal": causal})
    generator = torch.Generator().manual_seed(1)
    model.tokenizer.init_codebook([random_scene(4, 32, 3, generator)])
    return model.eval()


@pytest.fixture(scope="module")
def model():
    return denoiser()


@pytest.fixture(scope="module")
def recording() -> Scene:
    return random_scene(2, 4 * TOKENS, 3, torch.Generator().manual_seed(3))


def grid(stride: int = 2, tokens: int = TOKENS) -> Grid:
    return Grid(tokens, 3, PAST, 2, 8, stride)


def replaced(scene: Scene, first: int, agent: int) -> Scene:
    """The same scene, in which an agent does something else from a token step on."""
    other = random_scene(2, scene.frames, 3, torch.Generator().manual_seed(9))
    body_rot, T_world_root = scene.body_rot.clone(), scene.T_world_root.clone()
    body_rot[:, 4 * first :, agent] = other.body_rot[:, 4 * first :, agent]
    T_world_root[:, 4 * first :, agent] = other.T_world_root[:, 4 * first :, agent]
    return scene.replace(body_rot=body_rot, T_world_root=T_world_root)


def sampled(model, scene: Scene, task: MotionControl) -> tuple[WorldState, torch.Tensor, torch.Tensor]:
    """The world, its tokens, and those it began with."""
    schedule = task.schedule(grid())
    given = mask_unknown(scene, schedule.known)
    world = WorldState(model, given, schedule, FAST, 1)
    start = known_tokens(model, given, schedule.known, limits=task_lookahead_limit(task, grid()))
    generator = torch.Generator().manual_seed(0)
    return (
        world,
        sample(model.denoise, schedule, start, given.present, model.layout, generator, world.make_consistent),
        start,
    )


# -- how far codes look --------------------------------------------------------------------------


@pytest.mark.parametrize("stride", [1, 2, 3, 8])
@pytest.mark.parametrize("block", [1, 2, 3, 4, 8])
def test_codes_look_to_the_end_of_their_block_and_before_it_to_where_it_begins(block, stride):
    """As they would live: what has been encoded once is not encoded anew."""
    limits = task_lookahead_limit(MotionControl((1,), block), grid(stride))
    row = torch.arange(TOKENS)
    end = torch.where(row < PAST, PAST, PAST + ((row - PAST) // block + 1) * block)
    assert torch.equal(limits[:, [0, 2]], end.clamp_max(TOKENS)[:, None].expand(-1, 2))
    assert torch.equal(limits[:, 1], limits[:, 0])
    schedule = MotionControl((1,), block).schedule(grid(stride))
    assert (limits <= lookahead_limit(schedule)).all()


@pytest.mark.parametrize("name", sorted({*registry.names()} - {"motion_control"}))
def test_where_nothing_given_is_hidden_codes_look_to_the_end(name):
    assert (task_lookahead_limit(registry.get(name)(), grid()) == TOKENS).all()


def test_every_row_that_is_wanted_is_encoded_once_with_all_that_its_code_depends_on():
    limits = torch.tensor([[0, 12], [4, 12], [4, 12], [4, 12], [6, 12], [6, 12], [9, 12], [9, 12], [9, 12], [12, 12]])
    found = encodings(1, 10, [0, 1], limits, 2)
    assert found == [(1, 1, 4, 4, [0]), (1, 4, 6, 6, [0]), (3, 6, 9, 9, [0]), (1, 9, 10, 10, [0]), (1, 1, 10, 10, [1])]
    assert encodings(1, 10, [0, 1], None, 2) == [(1, 1, 10, 10, [0, 1])]
    assert encodings(1, 10, [0], torch.zeros(10, 1, dtype=torch.long), 2) == []


def test_codes_that_look_to_the_end_are_those_of_the_whole_stretch(model, recording):
    known = PartnerInpainting((0,)).schedule(grid()).known
    given = mask_unknown(recording, known)
    limits = torch.full_like(known, TOKENS, dtype=torch.long)
    assert torch.equal(known_tokens(model, given, known), known_tokens(model, given, known, limits=limits))


def test_codes_are_those_of_a_recording_that_ends_where_they_look_to(model, recording):
    task = MotionControl((0,), block=3)
    known = task.schedule(grid()).known
    limits = task_lookahead_limit(task, grid())
    tokens = known_tokens(model, mask_unknown(recording, known), known, limits=limits)
    latent = model.layout.unpack(model.normalizer.denormalize(tokens))[0]
    for row in range(TOKENS):
        live = model.encode(recording.slice(0, 4 * int(limits[row, 1])))
        assert torch.allclose(latent[:, row, 1:], live[:, row, 1:], atol=1e-5)


# -- no leak -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("causal", "block"),
    some_slow(itertools.product([False, True], [1, 2, 3, 8]), (False, 1), (False, 2), (True, 1), (True, 2), (True, 3)),
)
def test_what_the_given_do_after_a_block_changes_nothing_in_it(recording, block, causal):
    """P(A_t | A_0:t-1, B_0:t): tokens and places of A, tokens of B, bit for bit."""
    model, task = denoiser(causal), MotionControl((0,), block)
    for end in (PAST + block, PAST + 2 * block):
        other = replaced(recording, end, 1)
        (a, out_a, start_a), (b, out_b, start_b) = (sampled(model, scene, task) for scene in (recording, other))
        assert torch.equal(start_a[:, :end, 1:], start_b[:, :end, 1:])
        assert torch.equal(out_a[:, :end], out_b[:, :end])
        assert torch.equal(a.T_world_can[:, : 4 * end], b.T_world_can[:, : 4 * end])
        assert not torch.equal(out_a[:, end:, 0], out_b[:, end:, 0])


def test_without_sight_the_encoder_would_leak(model, recording):
    """The law above can fail: this encoder looks ahead."""
    known = MotionControl((0,)).schedule(grid()).known
    a, b = (known_tokens(model, mask_unknown(s, known), known) for s in (recording, replaced(recording, 10, 1)))
    assert not torch.equal(a[:, :10, 1, : model.layout.latent], b[:, :10, 1, : model.layout.latent])


@pytest.mark.parametrize(("chunk", "block"), some_quick(itertools.product([5, 64], [1, 2, 4]), (64, 4)))
def test_streams_do_not_leak_either(model, recording, block, chunk):
    end = PAST + 2 * block
    other = replaced(recording, end, 1)
    a, b = (
        cat_time(
            list(
                stream(
                    model,
                    scene,
                    MotionControl((0,), block),
                    4 * PAST,
                    4 * (TOKENS - PAST),
                    1,
                    FAST,
                    torch.Generator().manual_seed(0),
                    chunk=chunk,
                )
            )
        )
        for scene in (recording, other)
    )
    assert torch.equal(a.T_world_root[:, : 4 * end], b.T_world_root[:, : 4 * end])
    assert torch.equal(a.body_rot[:, : 4 * end], b.body_rot[:, : 4 * end])
    assert not torch.equal(a.body_rot[:, 4 * end :, 0], b.body_rot[:, 4 * end :, 0])
