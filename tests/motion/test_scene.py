import numpy as np
import pytest
import torch

from magnet.motion.scene import Scene, cat_time, concatenate
from magnet.testing import random_scene


def test_saved_and_loaded_scenes_are_equal(scene: Scene, tmp_path):
    scene = scene.replace(names=("a", "b"), valid=torch.ones(2, 64, dtype=torch.bool))
    loaded = Scene.load(scene.save(tmp_path / "two"))
    with pytest.raises(ValueError, match=r"two\.glb: got suffix \.glb, expected \.npz or none; Motion\.of"):
        scene.save(tmp_path / "two.glb")
    assert [path.name for path in tmp_path.iterdir()] == ["two.npz"]
    for name, value in scene.tensors().items():
        assert torch.equal(value, getattr(loaded, name))
    assert (loaded.fps, loaded.body, loaded.names) == (scene.fps, scene.body, scene.names)


def test_a_file_that_is_no_scene_is_named(tmp_path):
    path = tmp_path / "no.npz"
    path.write_bytes(b"PK nothing")
    with pytest.raises(ValueError, match=r"no\.npz: not a scene file"):
        Scene.load(path)


def test_a_missing_file_is_not_called_broken(tmp_path):
    with pytest.raises(FileNotFoundError):
        Scene.load(tmp_path / "absent.npz")


def test_wrong_shapes_are_named(scene: Scene):
    with pytest.raises(ValueError, match=r"betas: got \(2, 2, 10\), expected \(2, 3, 10\)"):
        scene.replace(betas=scene.betas[:, :2])


def test_padding_adds_nobody(scene: Scene):
    padded = scene.pad_agents(5)
    assert padded.present.sum() == scene.present.sum()
    assert torch.equal(padded.T_world_root[:, :, :3], scene.T_world_root)
    with pytest.raises(ValueError, match="room was asked for 2: a model's max_agents"):
        scene.pad_agents(2)


def test_concatenated_scenes_come_back_by_picking(scene: Scene, generator):
    other = random_scene(1, 64, 4, generator)
    both = concatenate([scene, other])
    assert (both.scenes, both.agents) == (3, 4)
    assert torch.equal(both.select([2]).T_world_root, other.T_world_root)
    assert torch.equal(both.select(slice(0, 2)).pad_agents(4).betas[:, :3], scene.betas)


def test_repeat_keeps_samples_of_a_scene_together(scene: Scene):
    repeated = scene.replace(names=("a", "b")).repeat(3)
    assert repeated.names == ("a", "a", "a", "b", "b", "b")
    assert torch.equal(repeated.T_world_root[4], scene.T_world_root[1])


@pytest.fixture
def told(scene: Scene, generator) -> Scene:
    """A scene that says what a model was given."""
    shape = (scene.scenes, scene.frames, scene.agents)
    return scene.replace(given=torch.rand(shape, generator=generator) > 0.5)


def test_what_was_given_follows_its_frames_people_and_scenes(told: Scene):
    given = told.given
    assert torch.equal(told.slice(3, 9).given, given[:, 3:9])
    assert torch.equal(told.frames_at(torch.tensor([5, 5, 0])).given, given[:, [5, 5, 0]])
    assert torch.equal(told.permute_agents(torch.tensor([2, 0])).given, given[:, :, [2, 0]])
    assert torch.equal(told.select([1]).given, given[1:]) and torch.equal(told.repeat(2).given[1], given[0])
    assert torch.equal(told.pad_frames(2).given[:, :3], given[:, [0, 0, 0]])
    padded = told.pad_agents(4)
    assert torch.equal(padded.given[:, :, :3], given) and not padded.given[:, :, 3].any()
    assert torch.equal(told.people().given[0, :, 0], given[0, :, 0])
    assert torch.equal(cat_time([told.slice(0, 20), told.slice(20)]).given, given)
    assert torch.equal(concatenate([told, told]).given[2:], given)


def test_what_is_said_of_only_a_part_is_not_said_of_the_whole(scene: Scene, told: Scene):
    assert concatenate([told, scene]).given is None
    assert cat_time([told, scene]).given is None


def test_other_frames_forget_what_was_given_and_wrong_shapes_are_named(told: Scene):
    longer = told.pad_frames(4)
    assert told.replace(body_rot=longer.body_rot, T_world_root=longer.T_world_root).given is None
    assert told.replace(T_world_root=told.T_world_root + 1).given is not None
    with pytest.raises(ValueError, match=r"given: got \(2, 64\), expected \(2, 64, 3\)"):
        told.replace(given=told.given[..., 0])


def test_what_was_given_is_saved_and_files_that_do_not_say_are_read(told: Scene, scene: Scene, tmp_path):
    assert torch.equal(Scene.load(told.save(tmp_path / "told.npz")).given, told.given)
    assert Scene.load(scene.save(tmp_path / "scene.npz")).given is None


def test_arrays_that_a_later_version_adds_are_passed_over(scene: Scene, tmp_path):
    with np.load(scene.save(tmp_path / "scene.npz")) as file:
        np.savez(tmp_path / "later.npz", later=np.zeros(3), **dict(file))
    assert torch.equal(Scene.load(tmp_path / "later.npz").betas, scene.betas)


def test_pieces_joined_are_the_whole(scene: Scene):
    whole = cat_time([scene.slice(0, 10), scene.slice(10, 11), scene.slice(11)])
    assert torch.equal(whole.T_world_root, scene.T_world_root) and torch.equal(whole.body_rot, scene.body_rot)
    half = scene.replace(valid=torch.rand(2, 64) > 0.5).slice(0, 10)
    assert cat_time([half, scene.slice(10)]).valid[:, 10:].all()


def test_absent_agents_are_not_moved(generator):
    present = torch.tensor([[True, True, False]])
    scene = random_scene(1, 8, 3, generator, present=present)
    T = torch.eye(4)
    T[0, 3] = 5.0
    assert torch.equal(scene.transformed(T).T_world_root[:, :, 2], scene.T_world_root[:, :, 2])


def test_people_are_everybody_present_alone(generator):
    present = torch.tensor([[True, False, True], [False, True, False]])
    scene = random_scene(2, 8, 3, generator, present=present).replace(valid=torch.rand(2, 8, generator=generator) > 0.3)
    people = scene.people()
    assert (people.scenes, people.agents) == (3, 1)
    for m, (b, p) in enumerate([(0, 0), (0, 2), (1, 1)]):
        assert torch.equal(people.body_rot[m, :, 0], scene.body_rot[b, :, p])
        assert torch.equal(people.betas[m, 0], scene.betas[b, p])
        assert torch.equal(people.valid[m], scene.valid[b])


@pytest.mark.parametrize(
    "content",
    [{"meta": np.array("{}")}, {"meta": np.array("[1]")}, {"meta": np.array("not json")}, {"other": np.zeros(3)}],
)
def test_a_strangers_npz_is_refused_by_name(content, tmp_path):
    path = tmp_path / "stranger.npz"
    np.savez(path, **content)
    with pytest.raises(ValueError, match=r"stranger\.npz: not a scene file"):
        Scene.load(path)


def test_a_damaged_file_is_refused_by_name(scene, tmp_path):
    path = scene.save(tmp_path / "scene.npz")
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:200] + b"x" * 400 + whole[600:]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="not a scene file"):
            Scene.load(path)


def test_no_scenes_can_be_picked(scene: Scene):
    for nothing in ([], torch.zeros(2, dtype=torch.bool), slice(0, 0)):
        assert scene.select(nothing).scenes == 0


def test_frames_whose_stop_lies_before_their_start_are_refused(scene: Scene):
    for start, stop in ((5, 2), (-4, 0)):
        with pytest.raises(ValueError, match=rf"slice\({start}, {stop}\) of 64 frames: the stop lies before the start"):
            scene.slice(start, stop)
    assert scene.slice(5, 5).frames == scene.slice(scene.frames).frames == 0


def test_tensors_of_other_types_are_named(scene: Scene):
    with pytest.raises(ValueError, match=r"present: got torch\.float32, expected bool"):
        scene.replace(present=scene.present.float())
    with pytest.raises(ValueError, match=r"betas: got torch\.int64, expected a float type"):
        scene.replace(betas=scene.betas.long())
    with pytest.raises(ValueError, match=r"given: got torch\.uint8, expected bool"):
        scene.replace(given=torch.ones(scene.T_world_root.shape[:3], dtype=torch.uint8))


def test_a_scene_in_single_precision_is_itself(scene: Scene):
    assert scene.to_float32() is scene
    again = scene.replace(body_rot=scene.body_rot.double()).to_float32()
    assert again.body_rot.dtype == torch.float32 and torch.equal(again.body_rot, scene.body_rot)


@pytest.mark.parametrize("field", ["T_world_root", "body_rot"])
@pytest.mark.parametrize("factors", [(2.0, 1.0, 1.0), (-1.0, 1.0, 1.0)], ids=["scaled", "mirrored"])
def test_a_file_whose_matrices_do_not_rotate_is_refused(scene: Scene, tmp_path, field, factors) -> None:
    wrong = getattr(scene, field).clone()
    spoiled = wrong[0, 3, 1] if field == "T_world_root" else wrong[0, 3, 1, 4]
    spoiled[:3, :3] *= torch.tensor(factors)
    path = scene.replace(**{field: wrong}).save(tmp_path / "spoiled.npz")
    with pytest.raises(ValueError, match=rf"spoiled.npz: {field}.* is no rotation \(scene 0, frame 3, person 1\)"):
        Scene.load(path)
    for nobody in (scene.present & (torch.arange(scene.agents) != 1), scene.present):
        valid = torch.ones(scene.scenes, scene.frames, dtype=torch.bool)
        valid[0, 3] = nobody is not scene.present  # who is absent, and frames that do not count, hold anything
        told = scene.replace(**{field: wrong, "present": nobody, "valid": valid})
        assert Scene.load(told.save(tmp_path / "told.npz")).frames == scene.frames


def test_other_matrices_that_no_program_meant_are_refused(scene: Scene, tmp_path) -> None:
    huge, turned = scene.body_rot.clone(), scene.T_world_root.clone()
    huge[0, 3, 1, 4] = 1e30  # whose square is not finite
    turned[0, 3, 1] = turned[0, 3, 1].T.clone()
    for field, wrong in (("body_rot", huge), ("T_world_root", turned)):
        path = scene.replace(**{field: wrong}).save(tmp_path / "spoiled.npz")
        with pytest.raises(ValueError, match=rf"{field}.* is no rotation \(scene 0, frame 3, person 1\)"):
            Scene.load(path)
    huge[0, 3, 1, 4] = torch.nan
    assert Scene.load(scene.replace(body_rot=huge).save(tmp_path / "unknown.npz")).frames == scene.frames


def test_a_file_that_lacks_a_field_or_has_another_shape_is_named(scene: Scene, tmp_path) -> None:
    held = dict(np.load(scene.save(tmp_path / "whole.npz")))
    np.savez(tmp_path / "part.npz", **{name: value for name, value in held.items() if name != "betas"})
    with pytest.raises(ValueError, match=r"part\.npz: not a scene file \(it lacks betas\)"):
        Scene.load(tmp_path / "part.npz")
    np.savez(tmp_path / "cut.npz", **{**held, "betas": held["betas"][:, :1]})
    with pytest.raises(ValueError, match=r"cut\.npz: betas: got"):
        Scene.load(tmp_path / "cut.npz")
