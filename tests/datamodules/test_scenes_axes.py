"""Files of one scene of different programs, in which different axes point up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from magnet.body import Body, load_body
from magnet.datamodules.fakes.motion import FakeMotion, made_up_body, people
from magnet.datamodules.preparing.canonicalize import Canonicalized, CanonicalizeOptions, canonicalize
from magnet.datamodules.reading.recording import Axis, DataError, Recording
from magnet.datamodules.scenes import ScenesReader
from magnet.export.npz_files import read_people
from magnet.export.read_options import Reading
from magnet.export.rig import UP
from magnet.export.smpl_keys import SMPLX_PELVIS

TRUE = people(60, 2, 30.0, 3)
BODY = load_body()


def write(root: Path, ups: tuple[Axis, ...], shown: FakeMotion = TRUE, rest: Any = (SMPLX_PELVIS,) * 2) -> list[Path]:
    """Each person in a world of an own axis; a body turns about its pelvis at rest."""
    root.mkdir(exist_ok=True)
    files = []
    for p, up in enumerate(ups):
        R_file_y = UP[up.lstrip("+")].T
        poses = shown.poses[:, p].copy()
        poses[:, 0] = (Rotation.from_matrix(R_file_y) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        trans = (shown.transl[:, p] + rest[p]) @ R_file_y.T - rest[p]
        held: dict[str, Any] = {"poses": poses.reshape(-1, 66), "trans": trans, "fps": 30, "betas": shown.betas[p]}
        files.append(root / f"walk_{'AB'[p]}.npz")
        np.savez(files[-1], **held)
    return files


def read(root: Path) -> Recording:
    reader = ScenesReader(root, split="scenes")
    return reader.read(reader.takes()[0])


def clips(found: Recording, up: Axis | None = None, body: Body = BODY) -> Canonicalized:
    return canonicalize(found, body, "walk", "scenes", "train", "any", CanonicalizeOptions(up=up))


@pytest.mark.parametrize("ups", [("+y", "+z"), ("+z", "+y"), ("+x", "+z"), ("-z", "+y"), ("+z", "+z")])
@pytest.mark.parametrize("own_body", [False, True])
def test_people_of_files_with_different_axes_stand_as_in_files_with_one(
    ups: tuple[Axis, Axis], own_body: bool, tmp_path: Path
) -> None:
    body, rest = (made_up_body("smplx"), TRUE.pelvis) if own_body else (BODY, np.tile(SMPLX_PELVIS, (2, 1)))
    write(tmp_path / "own", ups, rest=rest)
    write(tmp_path / "one", ("+y", "+y"), rest=rest)
    found = read(tmp_path / "own")
    assert (found.up, found.ups) == (ups[0], ups if ups[0] != ups[1] else ())
    (clip,), notes = clips(found, body=body)
    said = [note for note in notes if "files have different axes that point up, this one" in note]
    assert len(said) == len(found.ups)
    shown, wanted = (body.joints(one.scene)[0] for one in (clip, clips(read(tmp_path / "one"), body=body).clips[0]))
    assert (shown - wanted).abs().max() < 1e-4, "also where people stand to each other"


def test_who_lies_beside_somebody_of_the_same_axis_has_that_axis(tmp_path: Path) -> None:
    tilt = Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0])
    poses, transl = TRUE.poses.copy(), TRUE.transl.copy()
    poses[:, 1, 0] = (tilt * Rotation.from_rotvec(poses[:, 1, 0])).as_rotvec()
    transl[:, 1] = [0.5, 0.45, 0.0]
    files = write(tmp_path, ("+z", "+z"), replace(TRUE, poses=poses, transl=transl))
    found = read(tmp_path)
    assert (found.up, found.ups) == ("+z", ())
    assert any("walk_B.npz: torsos point along" in note and "this person lies" in note for note in found.notes)
    assert [one.up for one in read_people(files, BODY, Reading())] == ["z", "z"]


def test_the_whole_files_tell_the_axes_of_a_part(tmp_path: Path) -> None:
    """Split in time, in a part of which the follower lies."""
    long = people(400, 2, 30.0, 3)
    tilt = Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0])
    poses = long.poses.copy()
    poses[300:, 1, 0] = (tilt * Rotation.from_rotvec(poses[300:, 1, 0])).as_rotvec()
    write(tmp_path, ("+y", "+z"), replace(long, poses=poses))
    reader = ScenesReader(tmp_path, split="time")
    assert {reader.read(take).ups for take in reader.takes()} == {("+y", "+z")}


def test_an_axis_that_the_user_says_is_everybodys(tmp_path: Path) -> None:
    write(tmp_path, ("+y", "+z"))
    found = read(tmp_path)
    stand, told = (BODY.joints(clips(found, up).clips[0].scene)[0] for up in (None, "+y"))
    assert [bool(high > 1.0) for high in heads(stand)] == [True, True]
    assert [bool(high > 1.0) for high in heads(told)] == [True, False]


def heads(joints: torch.Tensor) -> torch.Tensor:
    """Mean heights of heads over ankles, metres. (T, P, 22, 3) -> (P,)"""
    return (joints[:, :, 15, 1] - joints[:, :, [7, 8], 1].mean(dim=-1)).mean(dim=0)


def test_as_many_axes_as_people(tmp_path: Path) -> None:
    write(tmp_path, ("+y", "+z"))
    with pytest.raises(DataError, match=r"ups: got 1 \(\+y\), expected one for each of 2"):
        replace(read(tmp_path), ups=("+y",))
