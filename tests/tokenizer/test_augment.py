import pytest
import torch

from magnet.motion.frames import canonical_frame, pose_features
from magnet.motion.rotations import geodesic
from magnet.testing import random_scene
from magnet.tokenizer.augment import LIMBS, joint_noise, root_noise, swap_limbs
from magnet.tokenizer.module import Tokenizer


@pytest.fixture
def people(generator):
    there = torch.tensor([[True, True], [True, False], [True, True]])
    return random_scene(3, 16, 2, generator, there)


def test_every_joint_but_the_pelvis_belongs_to_one_limb():
    assert sorted(joint for limb in LIMBS.values() for joint in limb) == list(range(1, 22))


def test_limbs_come_whole_from_somebody_who_is_there(people, generator):
    mixed = swap_limbs(people, 1.0, generator)
    own = people.people().body_rot[:, :, 0]  # (M, T, 21, 3, 3)
    for b, p in people.present.nonzero().tolist():
        for limb in LIMBS.values():
            joints = torch.tensor(limb) - 1
            given = mixed.body_rot[b, :, p][:, joints]
            assert any(torch.equal(given, donor[:, joints]) for donor in own)
    assert not torch.equal(mixed.body_rot, people.body_rot)


def test_absent_agents_and_the_pelvis_stay_as_they_are(people, generator):
    for changed in (swap_limbs(people, 1.0, generator), joint_noise(people, 0.3, generator)):
        assert torch.equal(changed.body_rot[1, :, 1], people.body_rot[1, :, 1])
        assert torch.equal(changed.T_world_root[1, :, 1], people.T_world_root[1, :, 1])
    assert torch.equal(swap_limbs(people, 1.0, generator).T_world_root, people.T_world_root)


def test_limbs_come_only_from_frames_that_are_valid(people, generator):
    """Of a clip that is shorter than the window the last pose is repeated; nobody else's arm hangs still for that."""
    valid = torch.ones(3, 16, dtype=torch.bool)
    valid[0, 8:] = False
    mixed = swap_limbs(people.replace(valid=valid), 1.0, generator)
    short = people.body_rot[0].transpose(0, 1)  # (P, T, 21, 3, 3)
    for own in mixed.body_rot[2].unbind(1):
        given = [torch.equal(own[:, joints], each[:, joints]) for joints in limbs() for each in short]
        assert not any(given)
    assert not torch.equal(mixed.body_rot[2], people.body_rot[2]), "from others they do"
    assert not torch.equal(mixed.body_rot[0], people.body_rot[0]), "who is short takes from anybody"


def donors(mixed, people) -> set[int]:
    """Whose limbs other people have, by their number among `people` (M, T, 21, 3, 3)."""
    return {
        who
        for taker, own in enumerate(mixed)
        for joints in limbs()
        for who, other in enumerate(people)
        if who != taker and torch.equal(own[:, joints], other[:, joints])
    }


@pytest.mark.parametrize("frames", [16, 8])
def test_everybody_gives_limbs_to_others_two_people_alone_and_whose_frames_end_as_early(frames, generator):
    valid = torch.arange(16).expand(2, 16) < frames
    for there in ([[True, False], [False, True]], [[True, True], [True, True]]):
        batch = random_scene(2, 16, 2, generator, torch.tensor(there)).replace(valid=valid)
        own = batch.people().body_rot[:, :, 0]
        found = [donors(swap_limbs(batch, 1.0, generator).people().body_rot[:, :, 0], own) for _ in range(10)]
        assert set().union(*found) == set(range(len(own)))


def limbs() -> list[torch.Tensor]:
    return [torch.tensor(limb) - 1 for limb in LIMBS.values()]


def test_nobody_to_exchange_with_leaves_a_person_alone(people, generator):
    alone = people.select([1])
    assert torch.equal(swap_limbs(alone, 1.0, generator).body_rot, alone.body_rot)


def test_joints_turn_by_the_same_in_all_frames_and_by_as_much_as_asked(people, generator):
    many = people.repeat(40)
    turned = joint_noise(many, 0.1, generator)
    angle = geodesic(many.body_rot, turned.body_rot)[many.present[:, None].expand(-1, 16, -1)]
    assert angle.square().mean().sqrt() == pytest.approx(0.1 * 3**0.5, rel=0.1)
    relative = many.body_rot.transpose(-1, -2) @ turned.body_rot
    assert torch.allclose(relative[:, 0], relative[:, -1], atol=1e-5)


def test_each_joint_of_each_person_turns_by_a_rotation_of_its_own(generator):
    scene = random_scene(3, 4, 2, generator)
    turned = joint_noise(scene, 0.1, generator)
    turns = (scene.body_rot.mT @ turned.body_rot)[:, 0]  # (B, P, 21, 3, 3)
    flat = turns.flatten(0, 2).flatten(1)
    apart = torch.cdist(flat, flat) + torch.eye(len(flat))
    assert float(apart.min()) > 1e-4


def test_the_pelvis_stays_where_it_is_and_turns_by_a_third(generator):
    many = random_scene(40, 4, 3, generator)
    turned = joint_noise(many, 0.3, generator)
    assert torch.equal(turned.T_world_root[..., :3, 3], many.T_world_root[..., :3, 3])
    angle = geodesic(many.T_world_root[..., :3, :3], turned.T_world_root[..., :3, :3])
    assert angle.square().mean().sqrt() == pytest.approx(0.1 * 3**0.5, rel=0.1)


def test_people_drift_each_for_themselves_some_more_than_others(generator):
    deltas = torch.zeros(600, 64, 2, 9)
    way = root_noise(deltas, 0.3, generator)[..., [6, 8]]  # (B, T, P, 2)
    for one, other in ((way[:, 32, 0], way[:, 32, 1]), (way[..., 0].std(dim=1)[:, 0], way[..., 0].std(dim=1)[:, 1])):
        assert abs(float(torch.corrcoef(torch.stack([one.flatten(), other.flatten()]))[0, 1])) < 0.15
    assert not deltas.any(), "what is given stays as it is"


def test_drift_is_slow_and_smooth_and_over_the_ground_alone(generator):
    deltas = torch.randn(400, 64, 1, 9, generator=generator)
    assert torch.equal(root_noise(deltas, 0.0, generator), deltas)
    away = 30 * (root_noise(deltas, 0.3, generator) - deltas)
    assert not away[..., [0, 1, 2, 3, 4, 5, 7]].any()
    speed = away[:, :, 0, [6, 8]]
    assert speed.std(dim=1).mean() < 0.3 and speed.std() == pytest.approx(0.3 / 3**0.5, rel=0.15)
    assert speed.diff(dim=1).abs().mean() < 0.2 * speed.abs().mean(), "from frame to frame it hardly changes"


def test_augmented_people_are_still_lawful(people, generator):
    """Their features are finite and their canonical frames upright, whatever has been turned."""
    changed = joint_noise(swap_limbs(people, 0.5, generator), 0.2, generator)
    assert pose_features(changed).isfinite().all()
    assert torch.allclose(canonical_frame(changed.T_world_root)[..., 1, 1], torch.ones(()), atol=1e-6)


def tiny(**options) -> Tokenizer:
    sizes = {"codebook_dim": 16, "codebook_size": 32, **options.pop("quantizer", {})}
    return Tokenizer(**{"network": {"width": 16, "depth": 1}, "quantizer": sizes, **options})


def test_training_augments_and_evaluation_does_not(people):
    tokenizer = tiny(augment={"limb_swap_prob": 1.0, "joint_noise": 0.2})
    tokenizer.init_codebook([people])
    assert torch.equal(tokenizer.augmented(people, 0).body_rot, tokenizer.augmented(people, 0).body_rot)
    assert not torch.equal(tokenizer.augmented(people, 0).body_rot, tokenizer.augmented(people, 1).body_rot)
    assert torch.equal(tiny().augmented(people, 0).body_rot, people.body_rot)


def test_a_tokenizer_starts_from_anothers_networks(people, tmp_path):
    first = tiny()
    first.init_codebook([people])
    path = tmp_path / "first.ckpt"
    torch.save({"hyper_parameters": dict(first.hparams), "state_dict": first.state_dict()}, path)
    second = tiny(quantizer={"num_quantizers": 2})
    second.take_weights(path)
    for name, value in second.vqvae.state_dict().items():
        assert torch.equal(value, first.vqvae.state_dict()[name])
    assert not second.quantizer.initialized, "another number of codebooks starts anew"
    with pytest.raises(ValueError, match=r"start_from: .* does not fit"):
        Tokenizer(network={"width": 24, "depth": 1}, quantizer={"codebook_dim": 16, "codebook_size": 32}).take_weights(
            path
        )
