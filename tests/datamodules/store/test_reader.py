"""The store on disk: what goes in comes out, and what is damaged or somebody else's is named."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from magnet.datamodules.fakes.motion import made_up_body
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import PrepareJob, convert, encode
from magnet.datamodules.preparing.prepare import prepare
from magnet.datamodules.reading.recording import Recording
from magnet.datamodules.store.reader import StoreError, StoreReader, holds_store
from magnet.datamodules.store.rows import ROW, decode
from magnet.testing import random_scene
from tests.datamodules import made
from tests.datamodules.made import data

BODY = made_up_body()
pytestmark = pytest.mark.usefixtures("known")


@given(frames=st.integers(31, 50), people=st.integers(1, 3), seed=st.integers(0, 2**30))
@settings(max_examples=15, deadline=None)
def test_rows_give_the_same_joints_within_a_fifth_of_a_millimetre(frames, people, seed):
    scene = random_scene(1, frames, people, torch.Generator().manual_seed(seed)).replace(body=BODY.id)
    rows = encode(scene)
    assert rows.dtype == ROW and rows.shape == (frames * people,)
    rows = rows.reshape(people, frames)
    body_rot, T_world_root = decode(*(torch.from_numpy(rows[key].copy()) for key in ("rotations", "pelvis")))
    joints = BODY.forward_kinematics(body_rot, T_world_root, scene.betas[0][:, None])
    assert (joints.transpose(0, 1) - BODY.joints(scene)[0]).norm(dim=-1).max() < 2e-4


@given(fps=st.floats(18.0, 130.0), people=st.integers(1, 3), seed=st.integers(0, 1000))
@settings(max_examples=12, deadline=None)
def test_prepare_then_read_gives_the_joints_of_the_recording_within_a_millimetre(tmp_path_factory, fps, people, seed):
    folder = tmp_path_factory.mktemp("property")
    frames = int(2.2 * fps)
    body = made.write(folder / "dl", takes=1, frames=frames, persons=people, fps=fps)
    (folder / "dl/take0.txt").write_text(f"{frames} {people} {fps!r} {seed}")
    order = PrepareJob(made.NAME, str(folder / "dl"), {}, str(body), CanonicalizeOptions())
    (clip,) = prepare(order, folder / "st").folder.clips("train")
    reader = order.reader()
    recording = reader.read(reader.takes()[0])
    found = BODY.joints(clip.scene)[0].double()
    # frames that fall together with the recording's, moved as one: independent of `canonicalize` but for the shift
    true = body_joints(recording)
    time = np.arange(len(found)) / 30 * fps
    exact = np.flatnonzero(np.abs(time - time.round()) < 1e-6)
    off = found[exact] - true[time[exact].round().astype(int)]
    assert (off - off[0, 0, 0]).norm(dim=-1).max() < 1e-3
    # and all others lie between their neighbours
    before = np.minimum(time.astype(int), len(true) - 2)
    near = torch.minimum((found - off[0, 0, 0] - true[before]).norm(dim=-1),
                         (found - off[0, 0, 0] - true[before + 1]).norm(dim=-1))  # fmt: skip
    step = (true[before + 1] - true[before]).norm(dim=-1)
    assert (near <= 0.6 * step + 2e-3).all()


def body_joints(recording: Recording) -> torch.Tensor:
    """World joints of SMPL parameters, by the body's own kinematics. -> (T, P, 22, 3)"""

    assert recording.poses is not None and recording.transl is not None and recording.betas is not None
    rotations = roma.rotvec_to_rotmat(torch.from_numpy(recording.poses))
    betas = torch.from_numpy(recording.betas)
    T_world_root = torch.eye(4, dtype=torch.float64).repeat(*rotations.shape[:2], 1, 1)
    T_world_root[..., :3, :3] = rotations[:, :, 0]
    T_world_root[..., :3, 3] = torch.from_numpy(recording.transl) + BODY.rest_joints(betas)[:, 0]
    return BODY.forward_kinematics(rotations[:, :, 1:], T_world_root, betas)


@pytest.mark.parametrize("spoil", ["missing", "cut", "other", "of an open head"])
def test_a_damaged_shard_is_named(store, spoil, tmp_path):
    copy = tmp_path / "store"
    copy.mkdir()
    for path in store.iterdir():
        if path.is_file():
            os.link(path, copy / path.name)
    (copy.parent / "dl").symlink_to(store.parent / "dl")
    shard = sorted(copy.glob("train-*.npy"))[0]
    content = shard.read_bytes()
    shard.unlink()
    spoilt = {
        "cut": content[: len(content) // 2],
        "other": b"no array at all",
        "of an open head": content.replace(b"}", b" ", 1),
    }
    if spoil != "missing":
        shard.write_bytes(spoilt[spoil])
    with pytest.raises(StoreError, match=f"{shard.name}.*prepare the store again"):
        data(copy).store("train")


def test_what_is_no_store_is_refused_with_the_command(store, tmp_path):
    with pytest.raises(ValueError, match=r"no store was given; magnet data prepare made --root"):
        made.Made().prepare_data()
    with pytest.raises(
        StoreError, match=r"gone: no such folder in .*, where paths .*give it with --data\.path, else make"
    ):
        StoreReader("gone")
    with pytest.raises(StoreError, match=r"not a prepared store.*magnet data prepare made --root"):
        made.Made(str(tmp_path)).prepare_data()
    with pytest.raises(ValueError, match=r"prepared with body 'made-up-smplx'.*--data\.body_model"):
        made.Made(str(store)).prepare_data()
    later = tmp_path / "manifest.json"
    later.write_text(json.dumps({**json.loads((store / "manifest.json").read_text()), "format": 99}))
    with pytest.raises(StoreError, match="store format 99, this version reads 1"):
        StoreReader(tmp_path)


def test_a_list_of_another_program_makes_no_store_of_a_folder(store, tmp_path):
    assert holds_store(store) and not holds_store(tmp_path) and not holds_store(tmp_path / "gone")
    shutil.copy(store / "manifest.json", tmp_path)
    assert holds_store(tmp_path)
    for list_of_files in ('[{"file": "leader.bvh"}]', '{"files": ["leader.bvh"]}'):
        (tmp_path / "manifest.json").write_text(list_of_files)
        assert not holds_store(tmp_path)
        with pytest.raises(StoreError, match=r"its manifest\.json is of another program; make one with"):
            StoreReader(tmp_path)
    (tmp_path / "manifest.json").write_text('{"format": 1, "cli')
    assert holds_store(tmp_path)  # a store's, cut short: it is prepared again


def test_any_store_can_be_read_without_its_own_class_but_not_by_anothers(store):
    body = str(store.parent / "dl/body.npz")
    assert Prepared(str(store), body_model=body).store("test").names

    class OtherReader(made.MadeReader):
        name, title = "other", "Other"

    class Other(Prepared):
        reader = OtherReader

    with pytest.raises(ValueError, match="a store of Made, not of Other"):
        Other(str(store), body_model=body).prepare_data()


def test_a_group_larger_than_the_slots_is_refused(store):
    with pytest.raises(ValueError, match="has 2 people, but max_agents is 1"):
        data(store, max_agents=1).store("train")


def test_a_reader_that_breaks_gives_its_own_take_up_alone(store, monkeypatch):
    order = PrepareJob(
        made.NAME, str(store.parent / "dl"), {}, str(store.parent / "dl/body.npz"), CanonicalizeOptions()
    )
    reader = order.reader()
    take = reader.takes()[0]

    def broken(self, take):
        raise IndexError(f"list index out of range in {self.root}/take0.txt")

    monkeypatch.setattr(made.MadeReader, "read", broken)
    part = convert(reader, take, BODY, CanonicalizeOptions())
    assert part.error == "IndexError: list index out of range in take0.txt"
