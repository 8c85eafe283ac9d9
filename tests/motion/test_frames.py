import pytest
import roma
import torch

from magnet.datamodules.reading.asf_amc import read_amc, read_asf
from magnet.motion.frames import (
    align_planar,
    canonical_deltas,
    canonical_frame,
    from_9d,
    from_planar,
    inverse,
    pairwise,
    partners,
    pose_features,
    posed,
    rigid,
    to_9d,
    to_planar,
)
from magnet.motion.placement import place
from magnet.motion.scene import Scene
from magnet.motion.tokens import by_frame, pairwise_by_frame, scene_transforms
from magnet.testing import random_scene
from tests.equations import propagate_pairwise

PLACEMENTS = ["integrate", "anchor", "fuse"]


def world_move(yaw: float, x: float, z: float) -> torch.Tensor:
    return from_planar(torch.tensor(yaw), torch.tensor([x, z]))


def test_inverse_is_the_matrix_inverse(scene: Scene):
    T = scene.T_world_root.double()
    assert torch.allclose(inverse(T), torch.linalg.inv(T), atol=1e-6)


def test_canonical_frame_stands_on_the_ground_and_turns_about_the_vertical(scene: Scene):
    T_world_can = canonical_frame(scene.T_world_root)
    assert torch.equal(T_world_can[..., 1, 3], torch.zeros_like(T_world_can[..., 1, 3]))
    assert torch.allclose(T_world_can[..., :3, 1], torch.tensor([0.0, 1, 0]).expand_as(T_world_can[..., :3, 1]))
    assert torch.equal(T_world_can[..., [0, 2], 3], scene.T_world_root[..., [0, 2], 3])


def test_an_unturned_pelvis_faces_z():
    T_world_root = torch.eye(4).expand(1, 3, 1, 4, 4)
    assert torch.allclose(canonical_frame(T_world_root), torch.eye(4).expand(1, 3, 1, 4, 4))


@pytest.mark.parametrize("yaw", [0.4, 3.0, -2.2])
def test_what_tokens_hold_does_not_change_when_the_world_turns_and_shifts(scene: Scene, yaw: float):
    moved = scene.transformed(world_move(yaw, 3.0, -7.0))
    for before, after in zip(scene_transforms(scene), scene_transforms(moved), strict=True):
        assert torch.allclose(before, after, atol=1e-5)
    assert torch.allclose(pose_features(scene), pose_features(moved), atol=1e-5)


def test_eq_11_holds_exactly_on_motion(scene: Scene):
    T_world_can = canonical_frame(scene.T_world_root.double())
    T_self_partner = pairwise(T_world_can)
    expected = propagate_pairwise(T_self_partner, canonical_deltas(T_world_can))
    assert torch.allclose(T_self_partner[:, 1:], expected, atol=1e-12)


def test_eq_11_holds_on_a_recorded_duet(cmu_root):
    poses = []
    for subject in (60, 61):
        skeleton = read_asf(cmu_root / "salsa" / f"{subject}.asf")
        recording = read_amc(cmu_root / "salsa" / f"{subject}_10.amc", skeleton, fps=60.0)
        poses.append(rigid(torch.from_numpy(recording.local[:, 0]), torch.from_numpy(recording.root)))
    T_world_can = canonical_frame(torch.stack(poses, dim=1)[None])
    T_self_partner = pairwise(T_world_can)
    expected = propagate_pairwise(T_self_partner, canonical_deltas(T_world_can))
    assert torch.allclose(T_self_partner[:, 1:], expected, atol=1e-12)


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_thousand_frames_come_back_within_a_tenth_of_a_millimetre(placement, generator):
    scene = random_scene(2, 1000, 3, generator)
    T_world_can = canonical_frame(scene.T_world_root)
    deltas, pairs = scene_transforms(scene)
    T_prev_can, T_self_partner = from_9d(by_frame(deltas)), from_9d(pairwise_by_frame(pairs))
    placed = place(T_prev_can[:, 1:], T_self_partner[:, 1:], T_world_can[:, 0], placement)
    assert (placed - T_world_can[:, 1:])[..., :3, 3].norm(dim=-1).max() < 1e-4


def test_pose_features_and_canonical_frames_give_the_scene_back(scene: Scene):
    back = posed(pose_features(scene), canonical_frame(scene.T_world_root), scene)
    assert torch.allclose(back.body_rot, scene.body_rot, atol=1e-5)
    assert torch.allclose(back.T_world_root, scene.T_world_root, atol=1e-5)


def test_permuting_agents_permutes_everything(scene: Scene):
    order = torch.tensor([2, 0, 1])
    deltas, pairs = scene_transforms(scene)
    deltas_ordered, pairs_ordered = scene_transforms(scene.permute_agents(order))
    assert torch.equal(deltas[:, :, order], deltas_ordered)
    table = partners(3)
    for agent in range(3):
        for slot, partner in enumerate(table[agent].tolist()):
            old, old_partner = order[agent], order[partner]
            old_slot = table[old].tolist().index(int(old_partner))
            assert torch.equal(pairs_ordered[:, :, agent, slot], pairs[:, :, old, old_slot])


@pytest.mark.parametrize("placement", ["integrate", "fuse"])
def test_placement_is_the_same_for_all_agents(scene: Scene, placement, generator):
    """Noisy predictions, agents permuted: the placed agents are permuted, nothing else."""
    order = torch.tensor([2, 0, 1])
    T_world_can = canonical_frame(scene.T_world_root)
    noise = 0.02 * torch.randn(scene.scenes, scene.frames, 3, generator=generator)

    def placed(agents: torch.Tensor) -> torch.Tensor:
        T = T_world_can[:, :, agents]
        deltas = canonical_deltas(T)
        deltas = from_planar(to_planar(deltas)[0] + noise[:, :, agents], to_planar(deltas)[1])
        return place(deltas[:, 1:], pairwise(T)[:, 1:], T[:, 0], placement, pairwise_weight=0.3)

    assert torch.allclose(placed(torch.arange(3))[:, :, order], placed(order), atol=1e-5)


def test_fuse_equals_a_general_least_squares_solver(generator):
    """One frame, noisy deltas and pairs, yaws known: the ground positions minimise the stated sum of squares."""
    P, pairwise_weight = 3, 0.4
    start = random_scene(1, 1, P, generator).T_world_root
    T_start = canonical_frame(start)[:, 0].double()
    delta = from_planar(torch.zeros(1, 1, P), 0.1 * torch.randn(1, 1, P, 2, generator=generator)).double()
    stepped = T_start[:, None] @ delta
    exact = pairwise(stepped)
    yaw, ground = to_planar(exact)
    pairs = from_planar(yaw, ground + 0.1 * torch.randn(ground.shape, generator=generator).double())
    placed = to_planar(place(delta, pairs, T_start, "fuse", pairwise_weight))[1][0, 0]  # (P, 2)

    rows, right = [], []
    for p in range(P):
        row = torch.zeros(P).double()
        row[p] = 1
        rows.append(row)
        right.append(to_planar(stepped)[1][0, 0, p])
        for slot, q in enumerate(partners(P)[p].tolist()):
            row = torch.zeros(P).double()
            row[q], row[p] = pairwise_weight**0.5, -(pairwise_weight**0.5)
            rows.append(row)
            R_world_self = stepped[0, 0, p, :3, :3]
            right.append(pairwise_weight**0.5 * (R_world_self @ pairs[0, 0, p, slot, :3, 3])[[0, 2]])
    solution = torch.linalg.lstsq(torch.stack(rows), torch.stack(right)).solution
    assert torch.allclose(placed, solution, atol=1e-9)


def test_fuse_does_not_listen_to_absent_agents(scene: Scene):
    T_world_can = canonical_frame(scene.T_world_root)
    deltas, pairs = canonical_deltas(T_world_can), pairwise(T_world_can)
    present = torch.tensor([[True, True, False]]).expand(scene.scenes, 3)
    noise = pairs.clone()
    table = partners(3)
    noise[:, :, table == 2] = torch.eye(4)
    noise[:, :, 2] = torch.eye(4)
    start = T_world_can[:, 0]
    placed = place(deltas[:, 1:], noise[:, 1:], start, "fuse", present=present)
    assert torch.allclose(placed[:, :, :2], T_world_can[:, 1:, :2], atol=1e-5)


def test_fuse_bounds_the_drift_between_agents(generator):
    """With noisy deltas, integrating drifts apart without bound; fused agents stay together."""
    scene = random_scene(1, 600, 2, generator)
    T_world_can = canonical_frame(scene.T_world_root)
    yaw, ground = to_planar(canonical_deltas(T_world_can))
    noisy = from_planar(yaw, ground + 0.01 * torch.randn(ground.shape, generator=generator))
    apart = {}
    for placement in PLACEMENTS:
        placed = place(noisy[:, 1:], pairwise(T_world_can)[:, 1:], T_world_can[:, 0], placement, pairwise_weight=0.1)
        off = pairwise(placed)[..., :3, 3] - pairwise(T_world_can[:, 1:])[..., :3, 3]
        apart[placement] = off.norm(dim=-1).mean().item()
    assert apart["anchor"] < 1e-4
    assert apart["fuse"] < 0.3 * apart["integrate"]


def test_others_hang_off_the_anchor_alone(generator):
    """What all but each scene's anchor say of others, and the others' deltas, may be anything."""
    scene = random_scene(2, 40, 3, generator)
    T_world_can, anchor = canonical_frame(scene.T_world_root), torch.tensor([2, 1])
    deltas, pairs = canonical_deltas(T_world_can), pairwise(T_world_can)
    heard = torch.arange(3) == anchor[:, None]
    noise = pairwise(canonical_frame(random_scene(2, 40, 3, generator).T_world_root))
    pairs = torch.where(heard[:, None, :, None, None, None], pairs, noise)
    deltas = torch.where(heard[:, None, :, None, None], deltas, deltas.flip(1))
    placed = place(deltas[:, 1:], pairs[:, 1:], T_world_can[:, 0], "anchor", anchor=anchor)
    assert torch.allclose(placed, T_world_can[:, 1:], atol=1e-4)
    first = place(deltas[:, 1:], pairs[:, 1:], T_world_can[:, 0], "anchor")
    assert torch.equal(
        first, place(deltas[:, 1:], pairs[:, 1:], T_world_can[:, 0], "anchor", anchor=torch.zeros(2).long())
    )
    assert not torch.allclose(first, T_world_can[:, 1:], atol=0.1)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("facing", [0.7, -2.5, 3.1])
def test_falling_onto_the_side_does_not_turn_a_person_round(side, facing):
    angle = side * torch.tensor([0.0, 0.5, 1.0, torch.pi / 2, torch.pi / 2, 0.2])
    falling = roma.rotvec_to_rotmat(angle[:, None] * torch.tensor([0.0, 0.0, 1.0]))
    turned = roma.rotvec_to_rotmat(torch.tensor([0.0, facing, 0.0]))
    T = rigid((turned @ falling)[None, :, None], torch.zeros(1, 6, 1, 3))
    yaw, _ = to_planar(canonical_frame(T))
    assert torch.allclose(yaw[0, :, 0], torch.tensor(facing).expand(6), atol=1e-5)


def test_a_frames_canonical_frame_is_its_own_whatever_the_others_are(scene: Scene):
    rolled, lying, turned = roma.rotvec_to_rotmat(torch.tensor([[0.3, 0, 0], [0, 0, torch.pi / 2], [0, 1.0, 0]]))
    T = scene.T_world_root.clone()
    T[:, 3:6, 0, :3, :3] = turned @ lying @ rolled  # the left axis points straight up
    whole = canonical_frame(T)
    other = torch.eye(4).expand_as(T).clone()
    other[:, 4:8] = T[:, 4:8]
    for alone in (canonical_frame(other)[:, 4:8], canonical_frame(T[:, 4:8])):
        assert torch.allclose(alone, whole[:, 4:8], atol=1e-6)
    yaw, _ = to_planar(whole)
    assert torch.allclose(yaw[:, 3:6, 0], torch.tensor(1.3), atol=1e-5)  # turned by 1, and rolled on by 0.3


def test_bowing_past_the_horizontal_does_not_turn_a_person_round():
    for angle in (0.5, 1.5, 2.0):
        R = roma.rotvec_to_rotmat(torch.tensor([angle, 0.0, 0.0]))
        yaw, _ = to_planar(canonical_frame(rigid(R.expand(1, 1, 1, 3, 3), torch.zeros(1, 1, 1, 3))))
        assert yaw.abs().max() < 1e-6


def test_9d_round_trip(scene: Scene):
    assert torch.allclose(from_9d(to_9d(scene.T_world_root)), scene.T_world_root, atol=1e-6)


def test_a_path_is_laid_onto_where_it_was_moved_from(generator):
    """Exactly where it differs by one turn and move; else heading and middle are those of the target."""
    scene = random_scene(3, 20, 2, generator)
    path = canonical_frame(scene.T_world_root)[:, :, 0]
    moved = from_planar(torch.tensor([0.3, -2.0, 3.0]), torch.randn(3, 2, generator=generator))
    torch.testing.assert_close(align_planar(path, moved[:, None] @ path), moved, atol=1e-5, rtol=0)
    other = canonical_frame(scene.T_world_root)[:, :, 1]
    laid = align_planar(path, other)[:, None] @ path
    torch.testing.assert_close(to_planar(laid)[1].mean(dim=1), to_planar(other)[1].mean(dim=1), atol=1e-5, rtol=0)
    off = to_planar(inverse(laid) @ other)[0]
    torch.testing.assert_close(off.sin().sum(dim=1), torch.zeros(3), atol=1e-4, rtol=0)
