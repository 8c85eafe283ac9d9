"""Keys and shapes of SMPL's family: what is read as axis-angle, and what is refused as something else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magnet.body import load_body
from magnet.datamodules.fakes.motion import people
from magnet.datamodules.reading.recording import DataError
from magnet.datamodules.scenes import ScenesReader
from magnet.export.npz import read_smplx
from magnet.export.smpl_keys import Unreadable, rotations
from magnet.export.smpl_people import PERSON, people_in

TRUE = people(40, 1, 30.0, 3)
WIDTHS = {"body": 66, "smpl": 72, "smplh": 156, "smplx": 165}


def vectors(width: int) -> NDArray[np.float64]:
    """Axis-angle numbers a frame; hands and face, or SMPL's hand joints, at rest. -> (40, width)"""
    return np.pad(TRUE.poses[:, 0].reshape(TRUE.frames, -1), [(0, 0), (0, width - 66)])


def turned(width: int, form: str) -> NDArray[np.float64]:
    """The same motion in other numbers, flat. -> (40, 4, 6 or 9 numbers a joint)"""
    turns = Rotation.from_rotvec(vectors(width).reshape(-1, 3))
    matrices = turns.as_matrix()
    each = {
        "w first": lambda: turns.as_quat()[:, [3, 0, 1, 2]],
        "w last": lambda: turns.as_quat(),
        "6D by rows": lambda: matrices[:, :2],
        "6D by columns": lambda: matrices[:, :, :2].swapaxes(1, 2),
        "6D interleaved": lambda: matrices[:, :, :2],
        "matrices": lambda: matrices,
    }[form]()
    return each.reshape(TRUE.frames, -1)


FORMS = {
    "w first": "groups of 4 numbers are of unit length, as quaternions are",
    "w last": "groups of 4 numbers are of unit length, as quaternions are",
    "6D by rows": r"groups of 6 numbers are orthonormal, as two columns of matrices \(6D\) are",
    "6D by columns": r"groups of 6 numbers are orthonormal, as two columns of matrices \(6D\) are",
    "6D interleaved": r"groups of 6 numbers are orthonormal, as two columns of matrices \(6D\) are",
    "matrices": "groups of 9 numbers are orthonormal, as matrices are",
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("width", WIDTHS.values())
def test_flat_rotations_of_another_kind_are_refused_with_the_reason(width: int, form: str) -> None:
    """22 quaternions are 88 numbers, 24 are 96, as 6D 144, as matrices 216: more than axis-angle needs."""
    flat = turned(width, form)
    with pytest.raises(Unreadable, match=f"file: rotations: .*{FORMS[form]}, expected axis-angle"):
        rotations("file", {"poses": flat})
    with pytest.raises(Unreadable, match=FORMS[form]):
        rotations("file", {"poses": np.stack([flat, flat])})  # people first
    root = vectors(66)[:, :3]
    size = flat.shape[1] // (width // 3)
    with pytest.raises(Unreadable, match=FORMS[form]):
        rotations("file", {"global_orient": root, "body_pose": flat[:, size:]})
    with pytest.raises(Unreadable, match=FORMS[form]):
        rotations("file", {"global_orient": flat[:, :size], "body_pose": vectors(66)[:, 3:]})


def test_what_networks_give_without_making_it_orthonormal_is_refused_too() -> None:
    rough = turned(72, "6D by rows") + 0.02 * np.random.default_rng(0).normal(size=(TRUE.frames, 144))
    with pytest.raises(Unreadable, match="groups of 6 numbers"):
        rotations("file", {"poses": rough})
    rough[::7] = np.nan
    with pytest.raises(Unreadable, match="groups of 6 numbers"):
        rotations("file", {"poses": rough})


@pytest.mark.parametrize("width", WIDTHS.values())
@pytest.mark.parametrize("kind", ["moving", "at rest", "a half turn", "random"])
def test_axis_angle_stays_as_it_is(width: int, kind: str) -> None:
    held = {
        "moving": lambda: vectors(width),
        "at rest": lambda: np.zeros((40, width)),
        "a half turn": lambda: np.tile([0.0, np.pi, 0.0], (40, width // 3)),
        "random": lambda: np.random.default_rng(0).normal(size=(40, width)),
    }[kind]()
    np.testing.assert_array_equal(rotations("file", {"poses": held}), held)
    parts = {"root_orient": held[:, :3], "pose_body": held[:, 3:]}
    np.testing.assert_array_equal(rotations("file", parts), held)


def test_a_root_of_other_than_three_numbers_is_refused() -> None:
    parts: dict[str, Any] = {"root_orient": np.zeros((40, 6)), "pose_body": vectors(66)[:, 3:]}
    with pytest.raises(ValueError, match=r"the root's rotations: got shape \(40, 6\), expected 3 numbers a frame"):
        rotations("file", parts)


def test_both_ways_in_refuse_with_the_way_out(tmp_path: Path) -> None:
    """`magnet export` and `magnet data prepare scenes`."""
    path = tmp_path / "walk.npz"
    np.savez(path, poses=turned(72, "w first"), trans=TRUE.transl[:, 0], fps=30)
    wanted = r"walk\.npz: .*as quaternions are.*convert them by scipy's Rotation\.from_quat.* where it comes last$"
    with pytest.raises(ValueError, match=wanted):
        read_smplx(path, load_body())
    reader = ScenesReader(tmp_path)
    with pytest.raises(DataError, match=wanted):
        reader.read(reader.found()[0])


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("count", [1, 2, 8])
def test_frames_before_people_are_refused_with_what_to_do(count: int, apart: bool, tmp_path: Path) -> None:
    """(T, P, D) looks like T people of P frames."""
    long = np.concatenate([vectors(72)] * 3)
    poses = np.stack([long] * count, axis=1)
    place = np.zeros((*poses.shape[:2], 3))
    parts = {"root_orient": poses[..., :3], "pose_body": poses[..., 3:]} if apart else {"poses": poses}
    wanted = f"which is 120 people of {count} frames; people come first: transpose the first two axes"
    with pytest.raises(Unreadable, match=wanted):
        rotations("file", parts)
    path = tmp_path / "walk.npz"
    np.savez(path, trans=place, fps=30, **parts)
    with pytest.raises(ValueError, match=wanted):
        read_smplx(path, load_body())
    reader = ScenesReader(tmp_path)
    with pytest.raises(DataError, match=wanted):
        reader.read(reader.found()[0])


@pytest.mark.parametrize(("count", "frames"), [(1, 40), (2, 1), (8, 2), (20, 4), (50, 40), (200, 60)])
def test_people_first_are_read_also_if_there_are_many_or_they_are_short(count: int, frames: int) -> None:
    poses = np.stack([np.concatenate([vectors(72)] * 2)[:frames]] * count)
    assert rotations("file", {"poses": poses}).shape == (count, frames, 72)
    ours = {"poses": poses[:, :1], "body": np.array("open-1"), "surface_model_type": np.array("smplx")}
    assert rotations("file", ours).shape == (count, 1, 72)


@pytest.mark.parametrize(
    "told", [{"betas": np.zeros((30, 10))}, {"shape": np.zeros((30, 16))}, {"gender": ["male"] * 30}]
)
def test_many_people_of_few_frames_are_read_where_shapes_or_genders_say_how_many(
    told: dict[str, Any], tmp_path: Path
) -> None:
    poses, place = np.stack([vectors(72)[:5]] * 30), np.zeros((30, 5, 3))
    assert rotations("file", {"poses": poses} | told).shape == (30, 5, 72)
    with pytest.raises(Unreadable, match=r"if they are 30 people, say so by shapes: betas \(30, 10\)"):
        rotations("file", {"poses": poses, "betas": np.zeros((30, 5, 10))})
    path = tmp_path / "crowd.npz"
    np.savez(path, poses=poses, trans=place, fps=30, **told)
    assert read_smplx(path, load_body())[0].agents == 30
    reader = ScenesReader(tmp_path)
    prepared = reader.read(reader.found()[0]).poses
    assert prepared is not None and prepared.shape[:2] == (5, 30)


@pytest.mark.parametrize("told", [{"betas": np.zeros((2, 10))}, {"gender": np.array(["male", "female"])}])
def test_few_frames_before_people_are_refused_where_shapes_or_genders_say_how_many(told: dict[str, Any]) -> None:
    """They were taken for so many people."""
    poses = np.stack([vectors(72)[:12]] * 2, axis=1)
    with pytest.raises(Unreadable, match="which is 12 people of 2 frames; people come first: transpose"):
        rotations("file", {"poses": poses} | told)
    square = np.stack([vectors(72)[:2]] * 2)
    assert rotations("file", {"poses": square} | told).shape == (2, 2, 72)


def test_people_by_number_and_by_the_same_number_as_text_are_refused() -> None:
    one = {"poses": vectors(66), "trans": np.zeros((40, 3)), "mocap_framerate": 30.0}
    assert [who[PERSON] for _, who in people_in(Path("a.pkl"), {0: one, "1": one})] == ["0", "1"]
    for number in (0, np.int64(0)):
        with pytest.raises(DataError, match=r"a\.pkl: has two people 0, one by number and one by text; rename one"):
            list(people_in(Path("a.pkl"), {number: one, "0": one}))


def test_shape_numbers_of_each_frame_of_one_person_are_not_taken_for_people() -> None:
    poses = np.stack([vectors(72)[:12]])
    assert rotations("file", {"poses": poses, "betas": np.zeros((12, 10))}).shape == (1, 12, 72)
