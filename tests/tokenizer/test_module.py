"""Laws of the tokenizer as a whole."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from magnet.body import load_body
from magnet.motion.frames import pose_features
from magnet.motion.scene import Scene, concatenate
from magnet.motion.tokens import scene_deltas
from magnet.testing import random_scene, tiny_denoiser, without_absent
from magnet.tokenizer import RawPose
from magnet.tokenizer.features import features
from tests.datamodules.fakes import FakeData, couples_and_singles

from .small import Scenes, conditions, tiny, trainer

CLOSE = {"rtol": 0.0, "atol": 2e-5}
"""Products of other sizes add in another order: not the same bits."""


# -- encoding and decoding ---------------------------------------------------------------------


def test_encode_and_decode_keep_the_shapes(scene: Scene) -> None:
    tokenizer = tiny(scene).eval()
    latent = tokenizer.encode_scene(scene)
    assert latent.shape == (2, 16, 3, 16)
    assert torch.equal(latent, tokenizer.encode(pose_features(scene), scene.betas, scene_deltas(scene)))
    pose = tokenizer.decode(latent, *conditions(scene))
    assert pose.shape == (2, 64, 3, 135)
    assert torch.equal(tokenizer.requantize(latent), latent)
    assert tokenizer.reconstruct(scene.slice(0, 63)).frames == 60


def test_every_latent_is_a_code(scene: Scene) -> None:
    tokenizer = tiny(scene).eval()
    latent = tokenizer.encode_scene(scene).flatten(0, -2)
    assert (latent[:, None] == tokenizer.quantizer.codes[0]).all(-1).any(-1).all()


def test_a_part_of_a_token_is_refused(scene: Scene) -> None:
    with pytest.raises(ValueError, match="63 frames"):
        tiny().encode(pose_features(scene)[:, :63], scene.betas, scene_deltas(scene)[:, :63])


def test_agents_do_not_see_each_other(scene: Scene) -> None:
    tokenizer = tiny(scene).eval()
    order = torch.tensor([2, 0, 1])
    torch.testing.assert_close(
        tokenizer.encode_scene(scene.permute_agents(order)), tokenizer.encode_scene(scene)[:, :, order], **CLOSE
    )


def test_where_a_scene_lies_in_the_world_does_not_matter(scene: Scene) -> None:
    tokenizer = tiny(scene).eval()
    T_new_world = torch.eye(4)
    T_new_world[[0, 0, 2, 2], [0, 2, 0, 2]] = torch.tensor([0.6, 0.8, -0.8, 0.6])
    T_new_world[:3, 3] = torch.tensor([2.0, 0.0, -1.0])
    seen, moved = features(scene), features(scene.transformed(T_new_world))
    vectors = [tokenizer.embed(s.pose, s.betas, s.deltas, None) for s in (seen, moved)]
    torch.testing.assert_close(vectors[0], vectors[1], rtol=0, atol=1e-3)


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("window", [1, 3, 16])
def test_decoding_by_windows_gives_the_same_poses(window: int, causal: bool, generator: torch.Generator) -> None:
    scene = random_scene(1, 200, 2, generator)
    tokenizer = tiny(scene, network={"causal": causal, "depth": 1}).eval()
    latent = tokenizer.encode_scene(scene)
    whole = tokenizer.decode(latent, *conditions(scene))
    torch.testing.assert_close(tokenizer.decode(latent, *conditions(scene), window=window), whole, **CLOSE)


def test_causal_tokens_of_a_growing_clip_do_not_change(generator: torch.Generator) -> None:
    scene = random_scene(2, 96, 2, generator)
    tokenizer = tiny(scene, network={"causal": True, "depth": 3}).eval()
    whole = tokenizer.encode_scene(scene)
    frames = tokenizer.decode(whole, *conditions(scene))
    betas, steps = conditions(scene)
    for tokens in (1, 7, 16):
        assert torch.equal(tokenizer.encode_scene(scene.slice(0, 4 * tokens)), whole[:, :tokens])
        prefix = tokenizer.decode(whole[:, :tokens], betas, steps[:, :tokens])
        torch.testing.assert_close(prefix, frames[:, : 4 * tokens], **CLOSE)


def test_symmetric_tokens_do_look_ahead(generator: torch.Generator) -> None:
    """Why a context must be cut out before it is encoded."""
    scene = random_scene(1, 64, 1, generator)
    tokenizer = tiny(scene).eval()
    seen, cut = features(scene), features(scene.slice(0, 32))
    whole = tokenizer.embed(seen.pose, seen.betas, seen.deltas, None)[:, :8]
    assert (whole - tokenizer.embed(cut.pose, cut.betas, cut.deltas, None)).abs().max() > 1e-3


# -- what must not count -----------------------------------------------------------------------


def test_absent_agents_and_bad_frames_change_nothing(scene: Scene, generator: torch.Generator) -> None:
    valid = torch.ones(2, 64, dtype=torch.bool)
    valid[0, 10:14] = valid[1, 50:] = False
    present = torch.tensor([[True, True, False], [True, False, True]])
    junk = random_scene(2, 64, 3, generator)
    keep = present[:, None] & valid[..., None]
    results = []
    for other in (without_absent(scene), junk):
        mixed = scene.replace(
            body_rot=torch.where(keep[..., None, None, None], scene.body_rot, other.body_rot),
            T_world_root=torch.where(keep[..., None, None], scene.T_world_root, other.T_world_root),
            betas=torch.where(present[..., None], scene.betas, other.betas),
            present=present,
            valid=valid,
        )
        tokenizer = tiny(mixed)
        loss = tokenizer.training_step(mixed, 0)
        loss.backward()
        gradients = [p.grad for p in tokenizer.vqvae.parameters()]
        results.append((loss.detach(), tokenizer.state_dict(), gradients))
    (loss, state, gradients), (other_loss, other_state, other_gradients) = results
    assert torch.equal(loss, other_loss)
    assert all(torch.equal(state[name], other_state[name]) for name in state)
    for gradient, other_gradient in zip(gradients, other_gradients, strict=True):
        torch.testing.assert_close(gradient, other_gradient, rtol=1e-4, atol=1e-6)


def test_statistics_are_those_of_the_people_present(scene: Scene) -> None:
    tokenizer = tiny()
    tokenizer.fit_normalizers([scene.select([0]), scene.select([1])])
    pose = pose_features(scene).flatten(0, -2).double()
    torch.testing.assert_close(tokenizer.vqvae.pose.mean, pose.mean(0).float(), rtol=1e-4, atol=1e-5)
    std = pose.std(0, unbiased=False).clamp(min=1e-2).float()
    torch.testing.assert_close(tokenizer.vqvae.pose.std, std, rtol=1e-3, atol=1e-5)
    nobody = without_absent(scene.replace(present=torch.zeros(2, 3, dtype=torch.bool)))
    with pytest.raises(ValueError, match="nobody is present"):
        tokenizer.fit_normalizers([nobody])
    tokenizer.fit_normalizers([concatenate([scene, nobody])])
    torch.testing.assert_close(tokenizer.vqvae.pose.mean, pose.mean(0).float(), rtol=1e-4, atol=1e-5)


# -- learning ----------------------------------------------------------------------------------


def test_a_handful_of_windows_is_learnt(generator: torch.Generator) -> None:
    scene = random_scene(2, 32, 2, generator)
    tokenizer = tiny(scene, network={"width": 48}, quantizer={"codebook_dim": 32, "codebook_size": 64})
    optimizer = torch.optim.AdamW(tokenizer.vqvae.parameters(), 3e-3)

    def angle() -> float:
        with torch.no_grad():
            _, body = (tokenizer.losses(features(scene))[0][name] for name in ("loss", "joint_rotation"))
        return float((2 * body).sqrt().rad2deg())

    tokenizer.eval()
    before = angle()
    tokenizer.train()
    for _ in range(120):
        optimizer.zero_grad()
        tokenizer.training_step(scene, 0).backward()
        optimizer.step()
    tokenizer.eval()
    assert before > 15 and angle() < 4  # degrees, root mean square


def test_all_weights_get_gradients_through_the_codebook(scene: Scene) -> None:
    tokenizer = tiny(scene, loss={"velocity": 0.1, "joint": 0.1})
    tokenizer.body = load_body()
    tokenizer.training_step(scene, 0).backward()
    for name, parameter in tokenizer.vqvae.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
    assert tokenizer.vqvae.encoder.layers[0].conv.weight.grad.abs().max() > 0


def test_mixed_precision_trains_and_its_rotations_stay_exact(scene: Scene) -> None:
    tokenizer = tiny(scene)
    with torch.autocast("cpu", torch.bfloat16):
        loss = tokenizer.training_step(scene, 0)
        loss.backward()
        pose = tokenizer.eval().decode(tokenizer.encode_scene(scene), *conditions(scene))
    assert loss.isfinite() and pose.dtype == torch.float32
    x = pose[..., :126].unflatten(-1, (21, 6))
    torch.testing.assert_close(x[..., :3].norm(dim=-1), torch.ones(x.shape[:-1]), rtol=0, atol=1e-5)
    torch.testing.assert_close(x[..., 3:].norm(dim=-1), torch.ones(x.shape[:-1]), rtol=0, atol=1e-5)


def test_freezing_the_model_freezes_the_codes(scene: Scene) -> None:
    tokenizer = tiny(scene).requires_grad_(False)
    before = tokenizer.quantizer.codes.clone()
    tokenizer.train()
    tokenizer.training_step(scene, 0)
    assert torch.equal(tokenizer.quantizer.codes, before)


def test_training_reports_what_it_should(tmp_path: Path) -> None:
    tokenizer = tiny(quantizer={"num_quantizers": 2}, loss={"joint": 1.0})
    run = trainer(tmp_path, max_epochs=2, log_every_n_steps=1, enable_checkpointing=False)
    run.fit(tokenizer, datamodule=Scenes())
    logged = {name: float(value) for name, value in run.callback_metrics.items()}
    for name in ("val/mpjpe_cm", "val/mpjpe_local_cm", "val/loss", "val/joint", "train/mpjpe_cm", "loss"):
        assert logged[name] > 0, name
    for name in ("val/perplexity_0", "val/perplexity_1", "train/perplexity_1"):
        assert 1 <= logged[name] <= 32, name
    assert 0 < logged["val/usage_0"] <= 1
    # An independent look: 20 joints and the head, the pelvis left out, in the world.
    assert tokenizer.body is not None
    errors = []
    for batch in Scenes().batches:
        decoded = tokenizer.eval().reconstruct(batch)
        joints, truth = tokenizer.body.joints(decoded), tokenizer.body.joints(batch)
        errors.append(float((joints - truth)[..., 1:, :].norm(dim=-1).mean()))
    assert logged["val/mpjpe_cm"] == pytest.approx(100 * sum(errors) / len(errors), rel=1e-4)


def test_what_is_validated_does_not_depend_on_who_shares_a_batch(tmp_path: Path) -> None:
    """Windows at the end of a clip are filled up, and scenes are of one person or two: means weigh by what counts."""
    tokenizer = tiny(random_scene(2, 32, 2, torch.Generator().manual_seed(0)))
    found = []
    for size in (1, 4, 100):
        data = FakeData(couples_and_singles("val"), window_frames=32, max_agents=2, val_batch_size=size)
        (logged,) = trainer(tmp_path, enable_checkpointing=False).validate(tokenizer, data, verbose=False)
        found.append(logged)
    for logged in found[1:]:
        for name in ("val/joint_rotation", "val/root_rotation", "val/commitment", "val/loss", "val/mpjpe_cm"):
            assert logged[name] == pytest.approx(found[0][name], rel=1e-4), name


# -- without a codebook ------------------------------------------------------------------------


def test_raw_poses_return_exactly(scene: Scene) -> None:
    raw = RawPose()
    for _ in range(2):
        latent = raw.encode_scene(scene)
        assert latent.shape == (2, 16, 3, 540) and raw.codebook_dim == 540
        assert torch.equal(raw.requantize(latent), latent)
        torch.testing.assert_close(raw.decode(latent, *conditions(scene)), pose_features(scene), rtol=0, atol=1e-5)
        raw.fit_normalizers([scene])
    torch.testing.assert_close(latent.mean(), torch.tensor(0.0), atol=0.2, rtol=0)
    assert not list(raw.parameters())


def test_nothing_in_nothing_out():
    """No scenes, no people or less than a token of frames: no tokens, and no motion."""
    tokenizer = tiny_denoiser(2).tokenizer
    scene = random_scene(2, 16, 2, torch.Generator().manual_seed(0))
    nobody = torch.tensor([], dtype=torch.long)
    for empty, shape in [
        (scene.select([]), (0, 4, 2)),
        (scene.permute_agents(nobody), (2, 4, 0)),
        (scene.slice(0, 0), (2, 0, 2)),
        (scene.slice(0, 3), (2, 0, 2)),
    ]:
        assert tokenizer.encode_scene(empty).shape == (*shape, tokenizer.codebook_dim)
        again = tokenizer.reconstruct(empty)
        assert (again.scenes, again.frames, again.agents) == (shape[0], 4 * shape[1], shape[2])


def test_a_tokenizer_takes_the_frame_rate_it_was_trained_on():
    tokenizer = tiny_denoiser(2).tokenizer
    scene = random_scene(1, 16, 1, torch.Generator().manual_seed(0)).replace(fps=60.0)
    for use in (tokenizer.encode_scene, tokenizer.reconstruct):
        with pytest.raises(ValueError, match="runs at 60 fps, the model at 30"):
            use(scene)
