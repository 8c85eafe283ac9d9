"""Bodies of causal plans are made from what is known by then, and stay."""

import dataclasses

import pytest
import torch

from magnet.generation.causal_bodies import EXPECTED, decode_bodies, finalize_bodies, others_expected
from magnet.generation.conditioning import known_tokens, mask_unknown, receptive_field
from magnet.generation.expected import Ahead
from magnet.generation.world import WorldState
from magnet.motion.frames import canonical_frame, posed
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid
from magnet.tasks.partner import MotionControl
from magnet.testing import random_scene

TOKENS, PAST = 14, 4
BARE = SamplerOptions(steps=2, keep_given=False, blend=0)
SMOOTH = SamplerOptions(steps=2, smooth_path=True)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(2, 4 * TOKENS, 3, torch.Generator().manual_seed(3))


def finished(model, scene: Scene, options: SamplerOptions) -> tuple[WorldState, torch.Tensor]:
    """A world in which everybody is placed where they were, and their true tokens."""
    schedule = MotionControl((0,)).schedule(Grid(TOKENS, 3, PAST, 2, 8, 2))
    world = WorldState(model, mask_unknown(scene, schedule.known), schedule, options, 1)
    world.placed[:] = True
    world.T_world_can = canonical_frame(scene.T_world_root)
    return world, known_tokens(model, scene, torch.ones_like(schedule.known))


def expecting(tokens: torch.Tensor, first: bool = True, block: int = 0) -> Ahead:
    """Everybody, the first perhaps not, expects the same tokens (B, n, P, D), of which so many are of the block."""
    each = tokens[:, None].expand(-1, tokens.shape[2], -1, -1, -1).clone()
    return Ahead(each[:, :, block:], torch.tensor([first, True, True]), each[:, :, :block])


def same(a: Scene, b: Scene) -> bool:
    return torch.equal(a.body_rot, b.body_rot) and torch.equal(a.T_world_root, b.T_world_root)


@torch.no_grad()
def test_a_block_is_decoded_from_its_own_and_earlier_tokens(model, scene):
    """As if the clip ended there."""
    world, tokens = finished(model, scene, BARE)
    made = decode_bodies(world, tokens, 6, 8, 8)
    latent, deltas, _ = model.layout.unpack(model.normalizer.denormalize(tokens[:, :8]))
    clip = posed(model.tokenizer.decode(latent, scene.betas, deltas), world.T_world_can[:, :32], scene.slice(0, 32))
    assert torch.allclose(made.body_rot, clip.body_rot[:, 24:], atol=1e-5)
    assert torch.allclose(made.T_world_root, clip.T_world_root[:, 24:], atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("options", [BARE, SamplerOptions(steps=2), SamplerOptions(steps=2, blend=3), SMOOTH], ids=str)
def test_nothing_behind_a_block_reaches_its_bodies(model, scene, options):
    world, tokens = finished(model, scene, options)
    other, changed = finished(model, scene, options)
    changed[:, 8:] = 7.0
    other.given.T_world_root[:, 32:] += 3.0
    other.T_world_can[:, 32:] = torch.eye(4)
    assert same(decode_bodies(world, tokens, 6, 8, 8), decode_bodies(other, changed, 6, 8, 8))


@torch.no_grad()
def test_what_comes_as_expected_is_decoded_as_if_it_had_been_known(model, scene):
    world, tokens = finished(model, scene, BARE)
    ahead = receptive_field(model)[1]
    behind = expecting(tokens[:, 8 : 8 + ahead])
    expected = decode_bodies(world, tokens, 6, 8, 8, behind)
    known = decode_bodies(world, tokens, 6, 8, 8 + ahead)
    assert torch.allclose(expected.body_rot, known.body_rot, atol=1e-4)
    assert not torch.allclose(decode_bodies(world, tokens, 6, 8, 8).body_rot, known.body_rot, atol=1e-3)


@torch.no_grad()
@pytest.mark.parametrize("smooth", [False, True])
def test_what_is_expected_behind_a_block_is_decoded_where_its_steps_lead(model, scene, smooth):
    world, tokens = finished(model, scene, dataclasses.replace(BARE, smooth_path=smooth))
    ahead = receptive_field(model)[1]
    behind = expecting(tokens[:, 8 : 9 + ahead])
    expected = decode_bodies(world, tokens, 6, 8, 8, behind, more=1)
    known = decode_bodies(world, tokens, 6, 9, 9 + ahead)
    assert expected.frames == known.frames == 12
    assert torch.allclose(expected.body_rot, known.body_rot, atol=1e-4)
    before_last = slice(0, 11)  # the last one is averaged with what follows it
    assert torch.allclose(expected.T_world_root[:, before_last], known.T_world_root[:, before_last], atol=1e-4)


@torch.no_grad()
def test_corrections_go_on_to_what_is_expected_of_those_who_told(model, scene):
    def shown(lift: float, told: bool) -> Scene:
        world, tokens = finished(model, scene, SamplerOptions(steps=2, settle="firm"))
        finalize_bodies(world, tokens, 6, 6, None)
        generator = torch.Generator().manual_seed(1)
        behind = tokens[:, 7:8] + lift * torch.randn(tokens[:, 7:8].shape, generator=generator)
        finalize_bodies(world, tokens, 7, 7, expecting(behind, told))
        assert world.correction is not None and world.correction.offset.shape[1] == 2
        return world.given.slice(24, 28)

    made = shown(0.0, True)
    assert made.frames == 4 and not same(made, shown(1.0, True))
    assert same(shown(0.0, False), shown(1.0, False))


@torch.no_grad()
def test_what_has_been_shown_is_given_and_the_next_block_goes_on_from_there(model, scene):
    world, tokens = finished(model, scene, SamplerOptions(steps=2))
    finalize_bodies(world, tokens, 6, 6, None)
    first = world.given.slice(0, 24)
    first = first.replace(body_rot=first.body_rot.clone(), T_world_root=first.T_world_root.clone())
    tokens = tokens + 0.5 * torch.randn(tokens.shape, generator=torch.Generator().manual_seed(1))
    finalize_bodies(world, tokens, 7, 7, None)
    assert same(world.given.slice(0, 24), first)
    assert torch.equal(world.given.body_rot[:, :28, 1:], scene.body_rot[:, :28, 1:])  # given, as it was
    step = world.given.T_world_root[:, :28, 0, :3, 3].diff(dim=1).norm(dim=-1)
    assert step[:, 23].max() < 2 * step[:, 16:23].max()


@torch.no_grad()
def test_others_are_expected_as_if_what_they_will_do_had_been_known(model, scene):
    """From where they are by then: who is shown a metre further on goes on there."""
    world, tokens = finished(model, scene, SamplerOptions(steps=2, blend=9, smooth_path=True))
    ahead = receptive_field(model)[1]
    behind, others = tokens[:, 8 : 8 + EXPECTED + ahead], torch.tensor([1, 2])
    plain = decode_bodies(finished(model, scene, BARE)[0], tokens, 6, 8 + EXPECTED, 8 + EXPECTED + ahead)
    later = others_expected(world, tokens, 8, EXPECTED, behind, (0, False), others, plain.slice(6, 8))
    assert later.frames == 4 * EXPECTED
    assert torch.allclose(later.body_rot[:, :, 1:], plain.body_rot[:, 8:, 1:], atol=1e-4)
    assert torch.allclose(later.T_world_root[:, :, 1:], plain.T_world_root[:, 8:, 1:], atol=1e-4)
    shifted = plain.slice(6, 8)
    shifted.T_world_root[..., 0, 3] += 1.0
    moved = others_expected(world, tokens, 8, EXPECTED, behind, (0, False), others, shifted).T_world_root[
        :, :, 1:, 0, 3
    ]
    assert (moved[:, 0] - later.T_world_root[:, 0, 1:, 0, 3] > 0.7).all()


@torch.no_grad()
def test_corrections_see_others_as_they_are_expected_where_they_are_not_seen(model, scene):
    """Two stand in each other; one is corrected, and expects the other to be here or there in the block or after it."""
    near = scene.replace(T_world_root=scene.T_world_root.clone())
    near.T_world_root[:, :, 0] = near.T_world_root[:, :, 1]

    def shown(seen: bool, within: float = 0.0, after: float = 0.0, lost: bool = False) -> Scene:
        world, tokens = finished(model, near, SamplerOptions(steps=2, settle="firm"))
        finalize_bodies(world, tokens, 6, 6, None)
        world.placed[4, 1:] = not lost
        if not seen:
            world.saw.fill_(False)
        expected, generator = expecting(tokens[:, 6 : 7 + EXPECTED], block=1), torch.Generator().manual_seed(1)
        for change, part in ((within, expected.within), (after, expected.tokens)):
            part[:, 0, :, 1:] += change * torch.randn(part[:, 0, :, 1:].shape, generator=generator)
        finalize_bodies(world, tokens, 7, 7, expected)
        return world.given.slice(24, 28)

    assert same(shown(False, lost=True), shown(False, within=1.0, after=1.0, lost=True))  # who has not told glides on
    for seen in (True, False):
        made = shown(seen)
        assert not same(made, shown(seen, after=1.0))
        assert same(made, shown(seen, within=1.0)) == seen
        assert torch.equal(made.body_rot[:, :, 1:], near.body_rot[:, 24:28, 1:])  # given
