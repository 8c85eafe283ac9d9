import pytest
import torch

from magnet.generation.blending import seam_weights
from magnet.generation.conditioning import known_tokens, mask_unknown, segments
from magnet.generation.rollout import generate
from magnet.generation.stats import SamplingStats
from magnet.motion.frames import canonical_frame, from_planar, pairwise, to_9d
from magnet.motion.scene import Scene
from magnet.motion.tokens import scene_transforms
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid
from magnet.tasks import registry
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.joint import Generation, JointFuture
from magnet.testing import random_scene, tiny_denoiser, without_absent
from magnet.tokenizer.features import features
from tests.cases import few

FAST = SamplerOptions(steps=3, stride=2)


def run(
    model, scene: Scene, context: int = 16, frames: int = 34, samples: int = 1, seed: int = 0, options=FAST, task=None
):
    generator = torch.Generator().manual_seed(seed)
    return generate(model, scene, task or JointFuture(), context, frames, samples, options, generator)


def same(a: Scene, b: Scene) -> bool:
    return all(torch.equal(value, getattr(b, name)) for name, value in a.tensors().items())


def test_given_frames_come_back_and_the_future_has_the_length_asked_for(model, scene):
    whole = run(model, scene)
    assert whole.frames == 50
    assert torch.equal(whole.slice(0, 16).body_rot, scene.slice(0, 16).body_rot)
    assert torch.equal(whole.slice(0, 16).T_world_root, scene.slice(0, 16).T_world_root)


def test_nothing_but_the_context_reaches_the_sample(model, scene, generator):
    """method.md C.0: other motion after the context, or none at all, gives bit-identical samples."""
    noise = random_scene(2, 64, 3, generator)
    future_is_noise = scene.replace(
        body_rot=torch.cat([scene.body_rot[:, :16], noise.body_rot[:, 16:]], dim=1),
        T_world_root=torch.cat([scene.T_world_root[:, :16], 50 * noise.T_world_root[:, 16:]], dim=1),
    )
    plain = run(model, scene)
    assert same(plain, run(model, future_is_noise))
    assert same(plain, run(model, scene.slice(0, 16)))


def unknown_replaced(scene: Scene, known: torch.Tensor, generator: torch.Generator) -> Scene:
    """Noise wherever the schedule knows nothing. known (N, P) bool"""
    keep = known.repeat_interleave(4, dim=0)[:, :, None, None]
    scene = scene.slice(0, len(keep))
    noise = random_scene(scene.scenes, scene.frames, scene.agents, generator)
    return scene.replace(
        body_rot=torch.where(keep[..., None], scene.body_rot, noise.body_rot),
        T_world_root=torch.where(keep, scene.T_world_root, 30 * noise.T_world_root),
    )


@pytest.mark.parametrize("name", few(registry.names(), 4))
def test_no_task_leaks(model, scene, generator, name):
    """For every task: what it does not give may be anything, and the samples are bit-identical."""
    task = registry.get(name)()
    context = 0 if name == "generation" else 16
    known = task.schedule(Grid(12, 3, context // 4, 3, 8, 2)).known
    assert not known.all()
    other = unknown_replaced(scene, known, generator)
    a, b = (run(model, s, context=context, frames=48 - context, task=task) for s in (scene, other))
    assert same(a, b)
    assert a.T_world_root.isfinite().all()


def test_the_literal_reading_leaks_where_the_unknown_partner_is(scene, generator):
    """pairwise_noise="token": the same replacement changes the sample, which is why it is not the default."""
    leaking = tiny_denoiser(max_agents=3, window=8, noise={"pairwise": "token"})
    task = registry.get("partner_inpainting")()
    known = task.schedule(Grid(12, 3, 4, 3, 8, 2)).known
    other = unknown_replaced(scene, known, generator)
    a, b = (run(leaking, s, frames=32, task=task) for s in (scene, other))
    assert not same(a, b)


@pytest.mark.parametrize("placement", ["integrate", "fuse"])
@pytest.mark.parametrize("name", ["partner_inpainting", "motion_control"])
def test_given_agents_are_not_moved(model, scene, name, placement):
    options = SamplerOptions(steps=3, stride=2, placement=placement)
    whole = run(model, scene, frames=32, task=registry.get(name)((1,)), options=options)
    assert torch.equal(whole.T_world_root[:, :, [0, 2]], scene.T_world_root[:, :48, [0, 2]])
    assert torch.equal(whole.body_rot[:, :, [0, 2]], scene.body_rot[:, :48, [0, 2]])
    assert not torch.equal(whole.body_rot[:, 16:, 1], scene.body_rot[:, 16:48, 1])


def test_whoever_is_neither_given_nor_generated_stands_still(model, scene):
    whole = run(model, scene, frames=32, task=registry.get("partner_prediction")((0,)))
    still = whole.T_world_root[:, 16:, 1:]
    assert torch.equal(still, still[:, :1].expand_as(still))
    assert not torch.equal(whole.T_world_root[:, 20, 0], whole.T_world_root[:, 16, 0])


def test_holding_the_last_pose_keeps_the_last_known_token_nearer_to_what_it_would_be(generator):
    """The most important token must not get a code of its own for standing at the edge of what is known."""
    model = tiny_denoiser(max_agents=2)
    scene = random_scene(8, 64, 2, generator)

    def embedded(scene: Scene, hold: int) -> torch.Tensor:
        """Before quantisation, which would hide how near two vectors are."""
        part = features(scene.people().pad_frames(4 * hold))
        vectors = model.tokenizer.embed(part.pose, part.betas, part.deltas, part.valid)[:, :, 0]
        return vectors[:, hold : vectors.shape[1] - hold]

    away = [(embedded(scene, hold)[:, 7] - embedded(scene.slice(0, 32), hold)[:, 7]).norm() for hold in (0, 1)]
    assert away[1] < 0.8 * away[0]
    held = embedded(scene.slice(0, 32), 1).unflatten(0, (8, 2)).transpose(1, 2)
    assert torch.equal(model.encode(scene.slice(0, 32)), model.tokenizer.requantize(held))


def test_generation_reads_nothing_at_all(model, scene, generator):
    other = random_scene(2, 64, 3, generator).replace(betas=scene.betas)
    a, b = (run(model, s, context=0, task=Generation()) for s in (scene, other))
    assert same(a, b)


def test_same_seed_same_motion_and_samples_differ(model, scene):
    a, b = run(model, scene, samples=2, seed=5), run(model, scene, samples=2, seed=5)
    assert same(a, b)
    assert not torch.equal(a.body_rot[0, 20:], a.body_rot[1, 20:])


def test_samples_of_a_scene_stand_together(model, scene):
    named = scene.replace(names=("a", "b"))
    assert run(model, named, samples=2).names == ("a", "a", "b", "b")


def test_absent_agents_change_nothing(model, scene):
    """Fewer people in the same slots: what the free slot holds does not matter."""
    two = without_absent(scene.replace(present=torch.tensor([[True, True, False]]).expand(2, 3)))
    other = two.replace(betas=two.betas.clone())
    other.betas[:, 2] = 9.0
    other.T_world_root[:, :, 2] = 3.0
    a, b = run(model, two), run(model, other)
    assert torch.equal(a.body_rot[:, :, :2], b.body_rot[:, :, :2])
    assert torch.equal(a.T_world_root[:, :, :2], b.T_world_root[:, :, :2])


@pytest.mark.parametrize("people", [1, 2, 3])
def test_any_number_of_people_up_to_the_models(model, people, generator):
    scene = random_scene(1, 16, people, generator)
    whole = run(model, scene, frames=10)
    assert whole.present.sum() == people
    assert whole.T_world_root.isfinite().all()


@pytest.mark.parametrize("placement", ["integrate", "anchor", "fuse"])
def test_motion_goes_on_from_the_last_context_frame(model, scene, placement):
    options = SamplerOptions(steps=3, stride=2, placement=placement)
    whole = run(model, scene, options=options)
    jump = whole.T_world_root[:, 16, :, :3, 3] - whole.T_world_root[:, 15, :, :3, 3]
    # An untrained model's steps are about as large as its training motion's; anchored agents may jump.
    assert jump.norm(dim=-1).max() < (5.0 if placement == "anchor" else 0.5)


def test_moving_the_world_moves_the_sample(model, scene):
    T = torch.eye(4)
    T[0, 0], T[0, 2], T[2, 0], T[2, 2] = 0.6, 0.8, -0.8, 0.6
    T[0, 3] = 4.0
    moved = run(model, scene.transformed(T))
    assert torch.allclose(run(model, scene).transformed(T).T_world_root, moved.T_world_root, atol=2e-3)


def test_moving_the_world_moves_the_sample_before_a_keyframe_of_somebody_lying_on_the_side(model, scene):
    """Where such a keyframe faces is told by itself: what lies before it is not known, and faces nowhere."""
    key = slice(32, 36)
    lying = from_planar(torch.tensor(1.0), torch.zeros(2))[:3, :3] @ torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    T_world_root = scene.T_world_root.clone()
    T_world_root[:, key, 0, :3, :3] = lying
    scene = scene.replace(T_world_root=T_world_root)
    move = from_planar(torch.tensor(1.2), torch.tensor([2.0, -3.0]))

    def between(scene: Scene) -> Scene:
        return run(model, scene, frames=32, task=Inbetweening(keys=(8,)))

    here, there = between(scene).transformed(move), between(scene.transformed(move))
    assert (here.T_world_root - there.T_world_root).abs().max() < 1e-4


def test_tokens_fed_back_agree_with_the_world(model, scene):
    """After a stage, pairs are what the placed agents imply."""
    from magnet.generation.world import WorldState
    from magnet.motion.frames import from_9d
    from magnet.motion.tokens import by_frame, pairwise_by_frame
    from magnet.sampling.sampler import sample

    grid = Grid(12, 3, 4, 3, 8, 2)
    schedule = JointFuture().schedule(grid)
    given = mask_unknown(scene, schedule.known)
    world = WorldState(model, given, schedule, FAST, 1)
    tokens = sample(
        model.denoise,
        schedule,
        known_tokens(model, given, schedule.known),
        given.present,
        model.layout,
        torch.Generator().manual_seed(0),
        world.make_consistent,
    )
    _, _, pairs = model.layout.unpack(model.normalizer.denormalize(tokens))
    T_self_partner = from_9d(pairwise_by_frame(pairs))
    assert torch.allclose(T_self_partner, pairwise(world.T_world_can), atol=1e-3)
    assert torch.allclose(world.T_world_can[:, :16], canonical_frame(scene.T_world_root)[:, :16])
    steps = from_9d(by_frame(model.layout.unpack(model.normalizer.denormalize(tokens))[1]))
    placed = world.T_world_can[:, :-1] @ steps[:, 1:]
    assert torch.allclose(placed, world.T_world_can[:, 1:], atol=1e-3)


def test_health_tells_how_far_latents_are_from_codes_and_relations_from_the_world(model, scene):
    stats = SamplingStats()
    generate(model, scene, JointFuture(), 16, 34, 1, FAST, torch.Generator().manual_seed(0), stats=stats)
    assert (stats.quantization_errors, stats.pairwise_drifts) == (2 * 9 * 3, 2 * 9 * 3 * 2)
    assert stats.means()["quantization_error"] > 0 and stats.means()["pairwise_drift"] > 0
    anchored = SamplingStats()
    two = scene.slice(0, 64).permute_agents(torch.tensor([0, 1]))
    options = SamplerOptions(steps=3, stride=2, placement="anchor")
    generate(model, two, JointFuture(), 16, 34, 1, options, torch.Generator().manual_seed(0), stats=anchored)
    assert anchored.pairwise_drifts == 2 * 9 * 2


def test_pasted_frames_meet_the_generated_ones_without_a_pop(model, scene):
    """The step across the seam is not larger than steps elsewhere in the decode."""
    whole = run(model, scene)
    bare = run(model, scene, options=SamplerOptions(steps=3, stride=2, keep_given=False))
    across = (whole.body_rot[:, 16] - whole.body_rot[:, 15]).norm(dim=(-1, -2)).mean()
    inside = (bare.body_rot[:, 1:] - bare.body_rot[:, :-1]).norm(dim=(-1, -2)).mean()
    assert across < 3 * inside


def test_seams_fade_out_behind_known_frames():
    keep = torch.tensor([[False], [True], [True], [False], [False], [False], [False]])
    weights = seam_weights(keep, 3)[0][:, 0]
    assert weights[0] == 0 and weights[2] == 1 and weights[5] == 0
    assert (weights[2:].diff() <= 0).all()


def test_the_step_into_a_keyframe_is_shown_as_the_keyframes_own_next_step(model, scene):
    """Nobody knows where from it leads; at the very beginning it is standing still."""
    known = torch.zeros(16, 3, dtype=torch.bool)
    known[:2], known[6:8, 1], known[9, 2] = True, True, True
    tokens = known_tokens(model, mask_unknown(scene, known), known)
    steps = model.layout.unpack(model.normalizer.denormalize(tokens))[1]
    true = scene_transforms(scene)[0]
    for token, agent in ((6, 1), (9, 2)):
        assert torch.allclose(steps[:, token, agent, 0], true[:, token, agent, 1], atol=1e-5)
        assert torch.allclose(steps[:, token, agent, 1:], true[:, token, agent, 1:], atol=1e-5)
    assert torch.allclose(steps[:, 7, 1], true[:, 7, 1], atol=1e-5)
    assert torch.allclose(steps[:, 0, :, 0], to_9d(torch.eye(4)), atol=1e-5)


def test_each_agents_unbroken_stretches_are_found():
    known = torch.tensor([[1, 1, 0], [1, 1, 0], [0, 1, 1], [1, 1, 1]], dtype=torch.bool)
    assert segments(known) == [(0, 2, [0]), (0, 4, [1]), (2, 4, [2]), (3, 4, [0])]


def test_scrubbed_scenes_hold_nothing_unknown(scene):
    known = torch.zeros(16, 3, dtype=torch.bool)
    known[:4, 1] = True
    given = mask_unknown(scene, known)
    assert torch.equal(given.T_world_root[:, :16, 1], scene.T_world_root[:, :16, 1])
    for agent, start in ((0, 0), (1, 16), (2, 0)):
        assert torch.equal(
            given.T_world_root[:, start:, agent], torch.eye(4).expand_as(given.T_world_root[:, start:, agent])
        )


def test_bad_requests_are_named(model, scene):
    with pytest.raises(ValueError, match="context of 15 frames is not a multiple of 4"):
        run(model, scene, context=15)
    with pytest.raises(ValueError, match="the task needs 16 frames, the scene has 12"):
        run(model, scene.slice(0, 12))
    with pytest.raises(ValueError, match="the scene has 4 agents, the model was built for 3"):
        run(model, scene.pad_agents(4))


@pytest.mark.parametrize(
    ("options", "message"),
    [({"placement": "fuze"}, "placement: got 'fuze', expected .* or fuse"), ({"blend": -1}, "blend: got -1")],
)
def test_options_that_mean_nothing_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        SamplerOptions(**options)
