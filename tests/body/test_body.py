"""Laws of body models, against a slow loop of our own and against the `smplx` package."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from magnet.body import JOINT_NAMES, MIRROR, PARENTS, load_body
from magnet.motion.scene import Scene, empty_scene
from tests.cases import some_slow

PARENTS_55 = (*PARENTS, 15, 15, 15, 20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38,
              21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53)  # fmt: skip


def random_rotations(*shape: int, seed: int = 0, degrees: float = 180.0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(*shape, 3))
    axis *= np.radians(degrees) * rng.random((*shape, 1)) / np.linalg.norm(axis, axis=-1, keepdims=True)
    return torch.from_numpy(Rotation.from_rotvec(axis.reshape(-1, 3)).as_matrix().reshape(*shape, 3, 3))


def random_scene(B: int = 2, T: int = 3, P: int = 2, body: str = "open-1", seed: int = 0) -> Scene:
    rng = torch.Generator().manual_seed(seed)
    T_world_root = torch.eye(4).repeat(B, T, P, 1, 1)
    T_world_root[..., :3, :3] = random_rotations(B, T, P, seed=seed + 1)
    T_world_root[..., :3, 3] = torch.randn(B, T, P, 3, generator=rng)
    return Scene(
        body_rot=random_rotations(B, T, P, 21, seed=seed).float(),
        T_world_root=T_world_root,
        betas=torch.randn(B, P, 10, generator=rng),
        present=torch.ones(B, P, dtype=torch.bool),
        body=body,
    )


def synthetic_file(path, V=600, columns=10, posedirs=True, seed=0):
    """A file with SMPL-X's keys and a random body, in the dtypes of the real one."""
    rng = np.random.default_rng(seed)
    regressor = rng.random((55, V)) ** 20
    weights = rng.random((V, 55)) ** 10
    arrays = {
        "v_template": rng.normal(size=(V, 3)),
        "shapedirs": 0.05 * rng.normal(size=(V, 3, columns)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, *PARENTS_55[1:]], range(55)], dtype=np.uint32),
        "f": rng.integers(0, V, (50, 3)).astype(np.uint32),
    }
    if posedirs:
        arrays["posedirs"] = 0.01 * rng.normal(size=(V, 3, 486))
    np.savez(path, **arrays)
    return arrays


def slow_joints(rest, body_rot, T_world_root):
    """One joint after another, in float64. (22, 3), (21, 3, 3), (4, 4) -> (22, 3)"""
    world = [Rotation.from_matrix(T_world_root[:3, :3])]
    at = [T_world_root[:3, 3]]
    for j in range(1, 22):
        p = PARENTS[j]
        at.append(at[p] + world[p].apply(rest[j] - rest[p]))
        world.append(world[p] * Rotation.from_matrix(body_rot[j - 1]))
    return np.stack(at)


def test_joints_equal_a_slow_recursion():
    body, scene = load_body(), random_scene()
    joints = body.joints(scene)
    assert joints.shape == (2, 3, 2, 22, 3)
    rest = body.J_template.double() + torch.einsum("jck,bpk->bpjc", body.J_shapedirs.double(), scene.betas.double())
    for b, t, p in np.ndindex(2, 3, 2):
        want = slow_joints(
            rest[b, p].numpy(), scene.body_rot[b, t, p].double().numpy(), scene.T_world_root[b, t, p].numpy()
        )
        assert np.abs(joints[b, t, p].numpy() - want).max() < 2e-6


def test_pelvis_joint_is_where_the_pelvis_pose_says():
    scene = random_scene()
    assert torch.equal(load_body().joints(scene)[..., 0, :], scene.T_world_root[..., :3, 3])


def test_forward_kinematics_takes_any_leading_shape_and_keeps_float64():
    body, scene = load_body(), random_scene(1, 4, 2)
    args = (scene.body_rot.double(), scene.T_world_root.double(), scene.betas[:, None].double())
    whole = body.forward_kinematics(*args)
    assert whole.dtype == torch.float64
    single = body.forward_kinematics(args[0][0, 1, 1], args[1][0, 1, 1], args[2][0, 0, 1])
    torch.testing.assert_close(single, whole[0, 1, 1], atol=1e-12, rtol=0)
    many_shapes = body.forward_kinematics(args[0][0, 0, 0], args[1][0, 0, 0], torch.zeros(5, 10).double())
    assert many_shapes.shape == (5, 22, 3)
    many_roots = body.forward_kinematics(args[0][0, 0, 0], args[1], torch.zeros(10).double())
    assert many_roots.shape == (1, 4, 2, 22, 3)


def test_forward_kinematics_has_the_right_gradients():
    body = load_body()
    args = (random_rotations(21), torch.eye(4).double(), torch.zeros(10).double())
    assert torch.autograd.gradcheck(body.forward_kinematics, tuple(a.clone().requires_grad_() for a in args))


def test_mixed_precision_does_not_blur_joints():
    body, scene = load_body(), random_scene()
    with torch.autocast("cpu", torch.bfloat16):
        mixed = body.joints(scene)
    assert torch.equal(mixed, body.joints(scene))


def test_a_change_of_shape_moves_rest_joints_linearly():
    body = load_body()
    a, b = torch.randn(2, 10, generator=torch.Generator().manual_seed(0))
    mean = body.rest_joints(torch.zeros(10))
    torch.testing.assert_close(body.rest_joints(a + b), body.rest_joints(a) + body.rest_joints(b) - mean)


def test_vertices_follow_a_rigid_move_of_the_world():
    body, scene = load_body(), random_scene(1, 1, 2)
    move = torch.eye(4)
    move[:3, :3], move[:3, 3] = random_rotations(1)[0], torch.tensor([1.0, 2.0, 3.0])
    want = body.vertices(scene) @ move[:3, :3].T + move[:3, 3]
    torch.testing.assert_close(body.vertices(scene.transformed(move)), want, atol=2e-5, rtol=0)


def test_an_absent_agent_does_not_disturb_the_others():
    body, scene = load_body(), random_scene(1, 2, 2)
    padded = scene.pad_agents(4)
    torch.testing.assert_close(body.joints(padded)[:, :, :2], body.joints(scene))
    assert body.joints(empty_scene(1, 2, 1, scene.betas)).isfinite().all()


# -- the open body -----------------------------------------------------------------------------


def test_the_open_body_is_an_adult_in_a_t_pose():
    body = load_body("open")
    assert body.id == "open-1"
    at = dict(zip(JOINT_NAMES, body.rest_joints(torch.zeros(10)), strict=True))
    height = body.v_template[:, 1].max() - body.v_template[:, 1].min()
    assert 1.6 < height < 1.8
    assert at["pelvis"].abs().max() == 0
    for left in (n for n in JOINT_NAMES if n.startswith("left")):
        assert at[left][0] > 0.05, "left is +x"
    assert at["left_foot"][2] - at["left_ankle"][2] > 0.1, "the face looks to +z"
    for a, b in (("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist")):
        torch.testing.assert_close(at[b] - at[a], torch.tensor([1.0, 0, 0]) * (at[b] - at[a]).norm(), atol=1e-5, rtol=0)
    for a, b, low, high in (
        ("left_hip", "left_knee", 0.34, 0.46),
        ("left_knee", "left_ankle", 0.36, 0.46),
        ("left_shoulder", "left_elbow", 0.22, 0.30),
        ("left_elbow", "left_wrist", 0.20, 0.28),
    ):
        assert low < (at[a] - at[b]).norm() < high, (a, b)


@pytest.mark.parametrize("shape", range(10))
@pytest.mark.parametrize("size", [-3.0, 3.0])
def test_plausible_shape_numbers_give_plausible_open_bodies(shape, size):
    body = load_body()
    betas = torch.zeros(10)
    betas[shape] = size
    skin = body.v_template + torch.einsum("vck,k->vc", body.shapedirs, betas)
    assert 1.35 < skin[:, 1].max() - skin[:, 1].min() < 2.05
    rest = body.rest_joints(betas)
    bones = (rest[1:] - rest[list(PARENTS[1:])]).norm(dim=-1)
    assert bones.min() > 0.03


def test_the_first_shape_number_makes_taller():
    body = load_body()
    tall, short = (body.rest_joints(torch.eye(10)[0] * s) for s in (1.0, -1.0))
    span = [joints[15, 1] - joints[10, 1] for joints in (tall, short)]
    assert 0.1 < span[0] - span[1] < 0.2


def test_the_open_body_is_symmetric():
    body = load_body()
    flip = torch.tensor([-1.0, 1.0, 1.0])
    for joints in (body.J_template, *body.J_shapedirs.unbind(-1)):
        torch.testing.assert_close(joints * flip, joints[list(MIRROR)], atol=1e-6, rtol=0)


def test_open_weights_sum_to_one_over_at_most_four_joints():
    weights = load_body().weights
    assert torch.equal(weights.sum(1), torch.ones(len(weights)))
    assert (weights >= 0).all()
    assert (weights > 0).sum(1).max() <= 4


def test_each_call_gives_a_module_of_its_own_that_checkpoints_do_not_store():
    one, other = load_body(), load_body()
    one.double()
    assert other.v_template.dtype == torch.float32
    assert not one.state_dict()
    assert not list(one.parameters())


# -- other bodies ------------------------------------------------------------------------------


def test_shapes_of_another_body_are_refused():
    scene = random_scene(body="smplx-neutral")
    for use in (load_body().joints, load_body().vertices):
        with pytest.raises(ValueError, match=r"'smplx-neutral'.*'open-1'.*load_body"):
            use(scene)


@pytest.mark.parametrize("columns", [10, 20, 400])
def test_files_with_any_number_of_shapes_and_vertices_are_read(tmp_path, columns):
    arrays = synthetic_file(tmp_path / "SMPLX_NEUTRAL.npz", V=60, columns=columns)
    body = load_body(tmp_path / "SMPLX_NEUTRAL.npz")
    assert body.id == "smplx-neutral"
    assert body.faces.shape == (50, 3)
    betas = torch.randn(10, generator=torch.Generator().manual_seed(0))
    skin = arrays["v_template"] + arrays["shapedirs"][..., :10] @ betas.numpy()
    np.testing.assert_allclose(body.rest_joints(betas).numpy(), (arrays["J_regressor"] @ skin)[:22], atol=1e-6)


def test_a_file_read_while_testing_gives_a_body_that_can_be_fitted_afterwards(tmp_path):
    synthetic_file(tmp_path / "SMPLX_NEUTRAL.npz", V=60)
    with torch.inference_mode():
        body = load_body(tmp_path / "SMPLX_NEUTRAL.npz")
    assert not any(tensor.is_inference() for tensor in body.buffers())


@pytest.mark.parametrize("key", ["v_template", "shapedirs", "weights", "kintree_table", "f", "J_regressor"])
def test_a_missing_key_is_named(tmp_path, key):
    arrays = synthetic_file(tmp_path / "whole.npz")
    np.savez(tmp_path / "body.npz", **{k: v for k, v in arrays.items() if k != key})
    with pytest.raises(ValueError, match=rf"body\.npz: lacks {key}"):
        load_body(tmp_path / "body.npz")


@pytest.mark.parametrize(
    ("key", "bad", "message"),
    [
        ("v_template", lambda a: a[:, :2], "v_template"),
        ("shapedirs", lambda a: a[..., :6], "shapedirs"),
        ("weights", lambda a: a[:, :24], r"weights is \(600, 24\), expected \(600, 55\)"),
        ("posedirs", lambda a: a[..., :9], "posedirs"),
        ("J_regressor", lambda a: a.T, "J_regressor"),
        ("f", lambda a: a + 10_000, "f names vertices"),
        ("kintree_table", lambda a: a[:, ::-1], "parents"),
        ("v_template", lambda a: a * np.nan, "v_template hold NaN"),
        ("v_template", lambda a: a.astype(str), "expected numbers"),
        ("v_template", lambda a: np.float64(3), "v_template"),
        ("f", lambda a: a.astype(object), "at key 'f'.*pickles are refused"),
    ],
)
def test_a_bad_array_is_named(tmp_path, key, bad, message):
    arrays = synthetic_file(tmp_path / "whole.npz")
    np.savez(tmp_path / "body.npz", **{**arrays, key: bad(arrays[key])})
    with pytest.raises(ValueError, match=message):
        load_body(tmp_path / "body.npz")


@pytest.mark.parametrize("keep", [0, 100, 0.5, 0.99])
def test_a_truncated_file_says_so(tmp_path, keep):
    synthetic_file(tmp_path / "whole.npz")
    data = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: int(len(data) * keep) if isinstance(keep, float) else keep])
    with pytest.raises(ValueError, match=r"cut\.npz: not a readable body file"):
        load_body(tmp_path / "cut.npz")


def test_a_plain_array_file_is_not_a_body(tmp_path):
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(ValueError, match="not a readable body file"):
        load_body(tmp_path / "array.npy")


def test_no_file_says_what_to_give(tmp_path):
    with pytest.raises(FileNotFoundError, match="give the path of SMPL's or SMPL-X's npz or pkl, or 'open'"):
        load_body(tmp_path / "none.npz")


# -- against the smplx package -----------------------------------------------------------------


def for_smplx(path, arrays):
    """Writes what the smplx package reads: its reader also wants hands, landmarks and pose correctives."""
    extra = {
        **{f"hands_components{side}": np.eye(45) for side in "lr"},
        **{f"hands_mean{side}": np.zeros(45) for side in "lr"},
        "lmk_faces_idx": np.zeros(51, dtype=np.int64),
        "lmk_bary_coords": np.full((51, 3), 1 / 3),
    }
    V = len(arrays["v_template"])
    if arrays["shapedirs"].shape[-1] < 20:  # room for the expressions
        pad = np.zeros((V, 3, 20 - arrays["shapedirs"].shape[-1]))
        arrays = {**arrays, "shapedirs": np.concatenate([arrays["shapedirs"], pad], axis=-1)}
    np.savez(path, **{"posedirs": np.zeros((V, 3, 486)), **extra, **arrays})


def smplx_output(path, scene):
    """Joints and vertices by the smplx package; its transl is the pelvis less the rest pelvis."""
    smplx = pytest.importorskip("smplx")
    model = smplx.SMPLXLayer(str(path), num_betas=10, num_expression_coeffs=10, ext="npz", dtype=torch.float64)
    B, T, P = scene.scenes, scene.frames, scene.agents
    n = B * T * P
    betas = scene.betas[:, None].expand(B, T, P, 10).reshape(n, 10)
    arguments = {
        "body_pose": scene.body_rot.reshape(n, 21, 3, 3),
        "betas": betas,
        "expression": torch.zeros(n, 10, dtype=torch.float64),
    }
    arguments["global_orient"] = scene.T_world_root[..., :3, :3].reshape(n, 1, 3, 3)
    eye = torch.eye(3, dtype=torch.float64).expand(n, 1, 3, 3)
    for part in ("jaw_pose", "leye_pose", "reye_pose"):
        arguments[part] = eye
    for hand in ("left_hand_pose", "right_hand_pose"):
        arguments[hand] = eye.expand(n, 15, 3, 3)
    with torch.no_grad():
        out = model(**arguments, transl=torch.zeros(n, 3, dtype=torch.float64))
    shift = scene.T_world_root[..., :3, 3].reshape(n, 1, 3) - out.joints[:, :1]
    return (out.joints[:, :22] + shift).view(B, T, P, 22, 3), (out.vertices + shift).view(B, T, P, -1, 3)


@pytest.mark.parametrize("source", some_slow(["open", "synthetic"], "synthetic"))
def test_joints_and_vertices_equal_the_smplx_package(tmp_path, source):
    pytest.importorskip("smplx")
    path = tmp_path / "SMPLX_NEUTRAL.npz"
    if source == "open":
        from importlib.resources import files

        with np.load(str(files("magnet.body") / "open_body.npz")) as file:
            arrays = {key: file[key] for key in file.files if file[key].dtype.kind in "iuf"}
        body, wanted_id = load_body(), "open-1"
    else:
        arrays = synthetic_file(tmp_path / "plain.npz", V=9930, columns=20)
        body, wanted_id = load_body(tmp_path / "plain.npz"), "plain"
    for_smplx(path, {k: v.astype(np.float64) if v.dtype.kind == "f" else v.astype(np.int64) for k, v in arrays.items()})
    scene = random_scene(1, 2, 2, body=wanted_id)
    scene = scene.replace(**{name: value.double() for name, value in scene.tensors().items() if name != "present"})
    joints, vertices = smplx_output(path, scene)
    torch.testing.assert_close(body.joints(scene), joints, atol=1e-6, rtol=0)
    torch.testing.assert_close(body.vertices(scene), vertices, atol=1e-6, rtol=0)
    assert torch.equal(load_body(path).faces, body.faces)
