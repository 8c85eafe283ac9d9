import pytest
import torch

from magnet.body import load_body
from magnet.denoiser.body_losses import BODY_LOSSES, WITHIN_REACH, body_losses, least_noisy
from magnet.denoiser.statistics import pairwise_ground
from magnet.motion.frames import canonical_frame, inverse, pose_features
from magnet.motion.scene import Scene
from magnet.motion.tokens import TokenLayout, scene_transforms
from magnet.testing import random_scene, tiny_denoiser
from magnet.tokenizer.losses import matrices

LAYOUT = TokenLayout(latent=8, agents=3)


@pytest.fixture(scope="module")
def body():
    return load_body()


def tokens_of(scene: Scene) -> torch.Tensor:
    deltas, pairs = scene_transforms(scene)
    return LAYOUT.pack(torch.zeros(*deltas.shape[:3], 8), deltas, pairs)


def run(body, seen: Scene, real: Scene, signal: float = 1.0, there: torch.Tensor | None = None):
    """Losses where the tokens say and the decoder decodes what `seen` is, and `real` was recorded."""
    tokens, truth = tokens_of(seen), tokens_of(real)
    counts = torch.ones(*tokens.shape[:3], 3, dtype=torch.bool) if there is None else there
    joints = [body.forward_kinematics(*matrices(pose_features(each)), real.betas[:, None]) for each in (seen, real)]
    return body_losses(tokens, truth, *joints, torch.full(tokens.shape[:3], signal), counts, LAYOUT)


def test_the_truth_costs_nothing(body, generator):
    scene = random_scene(2, 32, 3, generator)
    assert all(loss < 1e-3 for loss in run(body, scene, scene).values())


def test_the_terms_are_distances_and_speeds_of_joints(body, generator):
    """Against joints in the world, brought into each one's own frame."""
    seen, real = (random_scene(1, 16, 3, torch.Generator().manual_seed(seed)) for seed in (1, 2))
    seen = seen.replace(betas=real.betas)
    got = run(body, seen, real)
    T_can_world = [inverse(canonical_frame(scene.T_world_root)) for scene in (seen, real)]
    world = [body.joints(scene) for scene in (seen, real)]

    def local(which: int, of: int, by: int, shift: int = 0) -> torch.Tensor:
        """Joints of agent `of` in agent `by`'s canonical frame, that of `shift` frames before. (T, 22, 3)"""
        T = T_can_world[which][0, : 16 - shift, by]
        points = world[which][0, shift:, of]
        return points @ T[:, :3, :3].transpose(-1, -2) + T[:, None, :3, 3]

    own = torch.stack([(local(0, p, p) - local(1, p, p)).norm(dim=-1) for p in range(3)])
    assert got["joint"] == pytest.approx(float(own.mean()), rel=1e-4)
    way = [torch.stack([local(w, p, p, 1) - local(w, p, p)[:-1] for p in range(3)]) for w in (0, 1)]
    assert got["velocity"] == pytest.approx(float(30 * (way[0] - way[1]).norm(dim=-1).mean()), rel=1e-4)
    pairs = [(of, by) for of in range(3) for by in range(3) if of != by]
    seen_away = torch.stack([(local(0, of, by) - local(1, of, by)).norm(dim=-1) for of, by in pairs])
    assert got["partner"] == pytest.approx(float(seen_away.mean()), rel=1e-4)
    assert got["hands"] == 0, "nobody was recorded within reach"


def test_hands_are_vectors_between_wrists_that_were_recorded_within_reach(body, generator):
    real = random_scene(1, 16, 2, generator)
    seen = random_scene(1, 16, 2, generator).replace(betas=real.betas)
    seen, real = (scene.pad_agents(3) for scene in (seen, real))

    def between(scene: Scene) -> torch.Tensor:
        """World vectors from each wrist of 0 to each of 1. (T, 2, 2, 3)"""
        joints = body.joints(scene)[0]
        return joints[:, 1, None, 20:22] - joints[:, 0, 20:22, None]

    def brought_near(scene: Scene) -> Scene:
        """The second one's left wrist at the first one's right in the first frame."""
        shift = torch.eye(4).repeat(3, 1, 1)
        shift[1, :3, 3] = -between(scene)[0, 1, 0] * torch.tensor([1.0, 0.0, 1.0])
        return scene.replace(T_world_root=shift @ scene.T_world_root)

    real = brought_near(real)
    near = between(real).norm(dim=-1) < WITHIN_REACH
    assert near.any() and not near.all()
    got = run(body, seen, real, there=LAYOUT.group_present(seen.present)[:, None].expand(1, 4, 3, 3))["hands"]
    expected = []
    for by, sign in ((0, 1.0), (1, -1.0)):
        turned = [inverse(canonical_frame(s.T_world_root))[0, :, by, None, None, :3, :3] for s in (seen, real)]
        away = sum(
            k * (R @ (sign * between(s))[..., None])[..., 0]
            for k, R, s in zip((1.0, -1.0), turned, (seen, real), strict=True)
        )
        expected.append(away.norm(dim=-1)[near])
    assert got == pytest.approx(float(torch.cat(expected).mean()), rel=1e-3)


def test_noisy_tokens_count_less_and_absent_agents_not_at_all(body, generator):
    seen, real = (random_scene(1, 16, 3, torch.Generator().manual_seed(seed)) for seed in (1, 2))
    full, half = run(body, seen, real), run(body, seen, real, signal=0.5)
    for name in full:
        assert half[name] == pytest.approx(0.5 * float(full[name]), rel=1e-4)
    nobody = torch.zeros(1, 4, 3, 3, dtype=torch.bool)
    assert all(loss == 0 for loss in run(body, seen, real, there=nobody).values())


def test_the_surest_scenes_are_those_with_the_least_noise():
    signal = torch.tensor([0.1, 0.9, 0.5])[:, None, None].expand(3, 4, 2)
    there = torch.ones(3, 4, 2, 2, dtype=torch.bool)
    assert least_noisy(signal, there, 2).tolist() == [1, 2]
    there[1] = False
    assert least_noisy(signal, there, 2).tolist() == [2, 0], "a scene without anybody tells nothing"


def test_the_loss_reaches_the_transformer_and_not_the_tokenizer(generator):
    model = tiny_denoiser(max_agents=3, window=8, loss={"joint": 1.0, "velocity": 0.1, "partner": 0.5})
    model.train()
    losses = model.losses(random_scene(4, 32, 3, generator), generator)
    losses["loss"].backward()
    assert set(BODY_LOSSES) <= losses.keys()
    assert all(weight.grad is not None for weight in model.transformer.blocks.parameters())
    assert all(weight.grad is None for weight in model.tokenizer.parameters())
    assert not [name for name in model.state_dict() if name.startswith("body")], "a body is no part of a checkpoint"


def test_another_scale_of_pairwise_transforms_starts_as_the_same_model(tmp_path):
    """What it makes of clean tokens is the same in metres, and noise hides fewer of them."""
    first, second = tiny_denoiser(seed=1), tiny_denoiser(seed=2, noise={"pairwise_metres": 0.25})
    first.normalizer.std.copy_(torch.rand(first.layout.width) + 0.5)
    first.normalizer.ready.fill_(True)
    checkpoint = {"state_dict": first.state_dict(), "hyper_parameters": dict(first.hparams)}
    first.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, tmp_path / "first.ckpt")
    second.tokenizer.load_state_dict(first.tokenizer.state_dict())
    second.take_over(tmp_path / "first.ckpt")
    ground = pairwise_ground(second.layout)
    assert int(ground.sum()) == 2 * 4 * second.layout.slots
    assert torch.all(second.normalizer.std[ground] == 0.25)
    assert torch.equal(second.normalizer.std[~ground], first.normalizer.std[~ground])
    scene = random_scene(2, 32, first.layout.agents, torch.Generator().manual_seed(0))
    made = []
    for model in (first.eval(), second.eval()):
        tokens, _ = model.tokenize(scene)
        levels = torch.zeros(tokens.shape[:3], dtype=torch.long)
        with torch.no_grad():
            clean = model.denoise(model.normalizer.normalize(tokens), levels, scene.present)
        made.append(model.normalizer.denormalize(clean))
    assert torch.allclose(made[0], made[1], atol=1e-4)


def test_a_denoiser_starts_from_anothers_weights(tmp_path):
    first, second = tiny_denoiser(seed=1), tiny_denoiser(seed=2)
    checkpoint = {"state_dict": first.state_dict(), "hyper_parameters": dict(first.hparams)}
    first.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, tmp_path / "first.ckpt")
    second.take_over(tmp_path / "first.ckpt")
    for name, value in second.transformer.state_dict().items():
        assert torch.equal(value, first.transformer.state_dict()[name])
    with pytest.raises(ValueError, match=r"start_from: .* does not fit this model: size mismatch"):
        tiny_denoiser(network={"width": 64}).take_over(tmp_path / "first.ckpt")


def test_only_people_who_are_there_are_decoded_and_as_if_all_were(generator, monkeypatch):
    model = tiny_denoiser(max_agents=3, window=8, loss={"joint": 1.0, "decoded_share": 1.0}).eval()
    scene = random_scene(4, 32, 3, generator)
    scene.present[1:, 2] = False
    decoded = []
    plain = model.tokenizer.decode
    monkeypatch.setattr(
        model.tokenizer, "decode", lambda *given: decoded.append((given, plain(*given))) or decoded[-1][1]
    )
    assert model.losses(scene, generator)["joint"].isfinite()
    (latent, betas, deltas), poses = decoded[0]
    assert latent.shape == (9, 8, 1, model.layout.latent), "nine people of four scenes"
    together = [x.transpose(0, 2) for x in (latent, deltas)]  # the same people as one scene of nine
    whole = plain(together[0], betas.transpose(0, 1), together[1])
    assert torch.allclose(whole.transpose(0, 2), poses, atol=1e-5)
