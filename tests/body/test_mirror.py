import torch

from magnet.body import JOINT_NAMES, MIRROR, PARENTS, load_body, mirror_scene


def test_the_mirror_table_swaps_sides_and_keeps_the_tree():
    for j, other in enumerate(MIRROR):
        assert MIRROR[other] == j
        assert JOINT_NAMES[other] == JOINT_NAMES[j].replace("left", "*").replace("right", "left").replace("*", "right")
        assert PARENTS[j] == -1 or PARENTS[other] == MIRROR[PARENTS[j]]


def test_joints_of_the_mirrored_scene_are_the_mirrored_joints_swapped(scene):
    body = load_body()
    want = (body.joints(scene) * torch.tensor([-1.0, 1.0, 1.0]))[..., list(MIRROR), :]
    torch.testing.assert_close(body.joints(mirror_scene(scene)), want, atol=2e-6, rtol=0)


def test_skin_of_the_mirrored_scene_is_the_mirrored_skin(scene):
    body, scene = load_body(), scene.slice(0, 2)
    flip = torch.tensor([-1.0, 1.0, 1.0])
    key = [tuple(v) for v in (body.v_template * 1e5).round().int().tolist()]
    index = {v: i for i, v in enumerate(key)}
    other = torch.tensor([index[(-x, y, z)] for x, y, z in key])
    want = (body.vertices(scene) * flip)[..., other, :]
    torch.testing.assert_close(body.vertices(mirror_scene(scene)), want, atol=1e-4, rtol=0)


def test_mirroring_twice_gives_every_bit_back(scene):
    twice = mirror_scene(mirror_scene(scene))
    for name, tensor in scene.tensors().items():
        assert torch.equal(twice.tensors()[name], tensor), name


def test_mirrored_rotations_stay_rotations(scene):
    mirrored = mirror_scene(scene)
    for R in (mirrored.body_rot, mirrored.T_world_root[..., :3, :3]):
        torch.testing.assert_close(torch.linalg.det(R), torch.ones(R.shape[:-2]), atol=1e-5, rtol=0)


def test_everything_else_of_a_scene_is_kept(scene):
    scene = scene.replace(names=("a", "b"), fps=25.0).pad_agents(4)
    mirrored = mirror_scene(scene)
    assert (mirrored.names, mirrored.fps, mirrored.body) == (scene.names, scene.fps, scene.body)
    assert torch.equal(mirrored.present, scene.present)
    assert torch.equal(mirrored.betas, scene.betas)
    assert torch.equal(mirrored.T_world_root[:, :, 3], torch.eye(4).expand(2, 64, 4, 4)), "absent agents stay absent"
