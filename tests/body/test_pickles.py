"""SMPL's pickled bodies: read as the same body, with nothing in them run."""

from __future__ import annotations

import io
import os
import pickle
import pickletools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch

from magnet.body import Body, load_body
from magnet.body.family import family_of
from magnet.datamodules.fakes.body import arrays, write_body

from .pickled import Ch, MatVecMult, Reshape, Select, Transpose, sparse, write_smpl_pkl

TENSORS = ("J_template", "J_shapedirs", "v_template", "shapedirs", "weights", "faces", "posedirs")


def assert_same(one: Body, other: Body) -> None:
    assert one.family == other.family
    for name in TENSORS:
        torch.testing.assert_close(getattr(one, name), getattr(other, name), msg=name, rtol=0, atol=1e-6)


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
@pytest.mark.parametrize("kind", ["smpl", "smplx"])
def test_a_pickled_body_is_that_of_the_npz(tmp_path: Path, kind: Any, protocol: int) -> None:
    pickled = write_smpl_pkl(tmp_path / "SMPL_NEUTRAL.pkl", kind, protocol)
    named = {argument for op, argument, _ in pickletools.genops(pickled.read_bytes()) if op.name == "GLOBAL"}
    assert protocol == 4 or {"chumpy.ch Ch", "scipy.sparse.csc csc_matrix"} <= named  # as in the real files
    body = load_body(pickled)
    assert_same(body, load_body(write_body(tmp_path / "body.npz", kind)))
    assert (body.id, body.family) == ("smpl-neutral", kind)


def test_regressors_of_scipy_and_plain_arrays_will_do(tmp_path: Path) -> None:
    plain = {key: value for key, value in arrays("smplx").items() if key != "body_id"}
    expected = load_body(write_body(tmp_path / "body.npz"))
    dense = plain["J_regressor"].astype(np.float64)
    for kind in (np.asarray, scipy.sparse.csc_matrix, scipy.sparse.csr_matrix, scipy.sparse.csc_array):
        path = tmp_path / "SMPLX_NEUTRAL.pkl"
        path.write_bytes(pickle.dumps({**plain, "J_regressor": kind(dense)}, protocol=2))
        assert_same(load_body(path), expected)


def test_arrays_that_chumpy_makes_of_others_are_made(tmp_path: Path) -> None:
    shapedirs, regressor = arrays("smpl")["shapedirs"].astype(np.float64), arrays("smpl")["J_regressor"]
    wide = np.concatenate([shapedirs, np.full_like(shapedirs, 7.0)], axis=-1)
    first = np.arange(wide.size).reshape(wide.shape)[..., :10]
    select = Select(a=Ch(wide), idxs=first.ravel(), preferred_shape=first.shape)
    moved = Transpose(a=Reshape(a=Ch(regressor.T.ravel().astype(np.float64)), newshape=regressor.T.shape), axes=(1, 0))
    path = write_smpl_pkl(tmp_path / "a.pkl", shapedirs=select, J_regressor=moved)
    assert_same(load_body(path), load_body(write_body(tmp_path / "body.npz", "smpl")))


class Runs:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("where", ["J", "J_regressor", "bs_style"])
def test_nothing_in_a_pickle_is_run(tmp_path: Path, where: str) -> None:
    path = write_smpl_pkl(tmp_path / "a.pkl", **{where: Runs(tmp_path / "ran")})
    with pytest.raises(ValueError, match=r"a\.pkl: the pickle names posix\.mkdir, which is not loaded"):
        load_body(path)
    assert not (tmp_path / "ran").exists()


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no numbers": ({"v_template": Ch(other=1)}, "a NoneType where numbers were expected"),
    "unknown maths": ({"v_template": MatVecMult(mtx=1)}, "v_template holds object, expected numbers"),
    "far places": (
        {"shapedirs": Select(a=Ch(np.zeros(9)), idxs=np.array([99]), preferred_shape=(1,))},
        "takes number 99 of 9",
    ),
    "odd shape": ({"shapedirs": Reshape(a=Ch(np.zeros(9)), newshape=(2, 2))}, r"9 numbers .* of shape \(2, 2\)"),
    "odd axes": ({"shapedirs": Transpose(a=Ch(np.zeros((3, 3))), axes=(0, 0))}, r"puts axes \(0, 0\) of 2 in order"),
    "odd matrix": ({"J_regressor": sparse(np.zeros((0, 3)))}, "a sparse matrix of 0 rows and 3 columns"),
    "text": ({"J_regressor": "none"}, "J_regressor"),
    "another shape": ({"J_regressor": sparse(np.ones((24, 7)))}, r"J_regressor is \(24, 7\), expected \(24, 144\)"),
}


@pytest.mark.parametrize("how", WRONG)
def test_what_makes_no_sense_is_refused_by_file(tmp_path: Path, how: str) -> None:
    changes, match = WRONG[how]
    with pytest.raises(ValueError, match=match) as caught:
        load_body(write_smpl_pkl(tmp_path / "a.pkl", **changes))
    assert str(caught.value).startswith(str(tmp_path / "a.pkl"))


def test_lacking_keys_and_other_things_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps({"v_template": np.zeros((3, 3)), "betas": 1}))
    with pytest.raises(ValueError, match=r"a\.pkl: lacks shapedirs, weights, .*; it has betas, v_template"):
        load_body(path)
    path.write_bytes(pickle.dumps([1]))
    with pytest.raises(ValueError, match=r"a\.pkl: holds a list, expected a dict of SMPL's arrays"):
        load_body(path)


@pytest.mark.parametrize("protocol", [0, 2])
def test_damage_is_a_plain_error(tmp_path: Path, protocol: int) -> None:
    good = write_smpl_pkl(tmp_path / "a.pkl", protocol=protocol).read_bytes()
    rng = np.random.default_rng(protocol)
    refused = 0
    for number in range(60):
        spoilt = bytearray(good[: rng.integers(1, len(good))] if number % 2 else good)
        for at in rng.integers(0, min(len(spoilt), 4000), 3):
            spoilt[at] = rng.integers(0, 256)
        (tmp_path / "a.pkl").write_bytes(bytes(spoilt))
        try:
            load_body(tmp_path / "a.pkl")
        except ValueError as error:
            refused += 1
            assert str(error).startswith(str(tmp_path / "a.pkl"))
    assert refused > 30


def test_a_folder_is_told_what_it_holds_and_which_file_to_give(tmp_path: Path) -> None:
    write_body(tmp_path / "smplx/SMPLX_NEUTRAL.npz")
    (tmp_path / "smplx/SMPLX_NEUTRAL.pkl").write_bytes(b"the same again")
    write_smpl_pkl(tmp_path / "smpl/basicmodel_m_lbs_10_207_0_v1.1.0.pkl")
    (tmp_path / "notes.npz").write_bytes(b"no body")
    with pytest.raises(ValueError) as caught:
        load_body(tmp_path)
    said = str(caught.value)
    assert said.startswith(f"{tmp_path} is a folder; it holds ")
    assert "basicmodel_m_lbs_10_207_0_v1.1.0.pkl (SMPL), " in said and "SMPLX_NEUTRAL.npz (SMPL-X); give one" in said
    assert re.search(r"such as \S*smplx/SMPLX_NEUTRAL\.npz, and the folder itself as --bodies$", said)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty is a folder; it holds no body files"):
        load_body(tmp_path / "empty")


def test_families_are_told_by_the_whole_tree() -> None:
    """Against the trees that the files of smplx's package hold, written out by hand."""
    body = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]
    left, right = (
        [wrist, k, k + 1, wrist, k + 3, k + 4, wrist, k + 6, k + 7, wrist, k + 9, k + 10, wrist, k + 12, k + 13]
        for wrist, k in ((20, 22), (21, 37))
    )
    assert family_of([*body, 20, 21]) == "smpl"
    assert family_of([2**32 - 1, *body[1:], *left, *right]) == "smplh"
    moved = [parent + 3 if parent > 21 else parent for parent in (*left, *right)]
    assert family_of([*body, 15, 15, 15, *moved]) == "smplx"
    assert family_of(body) == family_of([*body, 20, 20]) == family_of([]) == ""


def test_an_npz_under_the_name_of_a_pickle_is_read(tmp_path: Path) -> None:
    file = io.BytesIO()
    np.savez(file, **arrays("smpl"))  # type: ignore[arg-type]
    (tmp_path / "a.pkl").write_bytes(file.getvalue())
    assert load_body(tmp_path / "a.pkl").family == "smpl"
