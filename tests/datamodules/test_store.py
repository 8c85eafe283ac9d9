"""The store on disk and its mapped reading: what goes in comes out, and training sees the same windows."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from magnet.datamodules import Clip, Mixed, catalogue
from magnet.datamodules.common import Steps
from magnet.datamodules.draws import Augmentation, RandomDraws
from magnet.datamodules.fakes.motion import made_up_body
from magnet.datamodules.prepare import prepare
from magnet.datamodules.prepare_takes import Order, convert, encode
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.recording import Recording
from magnet.datamodules.store import ROW, Folder, StoreError, decode
from magnet.datamodules.store_mapped import MappedStore, Piece, Rows
from magnet.datamodules.store_rows import CACHED, SCALE, _nine_at_once, matrices
from magnet.datamodules.windows import Store
from magnet.testing import random_scene
from tests.datamodules import made
from tests.datamodules.fakes import PLAIN, FakeData, FakeTrainer, random_clip

BODY = made_up_body()


@pytest.fixture(scope="module", autouse=True)
def known():
    catalogue.NAMES[made.NAME] = made.ENTRY
    yield
    del catalogue.NAMES[made.NAME]


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    """Twenty takes of two people in shards of two takes each, twelve of them to train on."""
    folder = tmp_path_factory.mktemp("store")
    body = made.write(folder / "dl", takes=20, frames=80, more=0)
    order = Order(made.NAME, str(folder / "dl"), {}, str(body), Steps())
    prepare(order, folder / "store", shard_rows=350)
    return folder / "store"


def data(store: Path, **kwargs) -> Prepared:
    body = str(store.parent / "dl" / "body.npz")
    return made.Made(str(store), body_model=body, **{"batch_size": 8, "epoch_size": 32, **kwargs})


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
    order = Order(made.NAME, str(folder / "dl"), {}, str(body), Steps())
    (clip,) = prepare(order, folder / "st").folder.clips("train")
    reader = order.reader()
    recording = reader.read(reader.takes()[0])
    found = BODY.joints(clip.scene)[0].double()
    # frames that fall together with the recording's, moved as one: independent of the common steps but for the shift
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
    import roma

    assert recording.poses is not None and recording.transl is not None and recording.betas is not None
    rotations = roma.rotvec_to_rotmat(torch.from_numpy(recording.poses))
    betas = torch.from_numpy(recording.betas)
    T_world_root = torch.eye(4, dtype=torch.float64).repeat(*rotations.shape[:2], 1, 1)
    T_world_root[..., :3, :3] = rotations[:, :, 0]
    T_world_root[..., :3, 3] = torch.from_numpy(recording.transl) + BODY.rest_joints(betas)[:, 0]
    return BODY.forward_kinematics(rotations[:, :, 1:], T_world_root, betas)


def test_mapped_training_windows_are_those_from_memory(store):
    options = {"compose": 0.5, "drop_agent": 0.3, "max_agents": 4, "weights": {made.NAME: 1.0}}
    mapped, resident = data(store, **options), data(store, device_resident=True, **options)
    assert isinstance(mapped.store("train"), MappedStore) and type(resident.store("train")) is Store
    for ours, theirs in zip(mapped.train_dataloader(), resident.train_dataloader(), strict=True):
        assert ours.names == theirs.names and ours.body == theirs.body == BODY.id
        for name, value in theirs.tensors().items():
            assert torch.equal(ours.tensors()[name], value), name
    for split in ("val", "test"):
        loader = getattr(mapped, f"{split}_dataloader" if split == "val" else "val_dataloader")()
        assert next(iter(loader)).scenes


def test_memory_holds_only_the_index(store):
    mapped = data(store).store("train")
    assert not hasattr(mapped, "tensors") and mapped.seats.nbytes + mapped.part.betas.nbytes < 200 * len(mapped.names)
    assert all(isinstance(shard, np.memmap) for shard in mapped.part.maps.values())
    for batch in data(store, read_ahead=0).train_dataloader():
        assert batch.scenes == 8
    assert all(np.shares_memory(shard, mapped._shard(number)) for number, shard in mapped.part.maps.items())


def test_a_rotation_comes_out_the_same_whatever_it_is_decoded_with(generator):
    quat = torch.randn(2 * CACHED + 37, 4, generator=generator)
    stored = (SCALE * quat / quat.norm(dim=-1, keepdim=True)).round().to(torch.int16)
    whole = matrices(stored)
    assert torch.equal(whole[5:900], matrices(stored[5:900])) and torch.equal(whole[-1], matrices(stored[-1]))
    assert torch.equal(whole.view(-1, 9), _nine_at_once(stored))  # what a GPU computes
    unit = stored.double() / stored.double().norm(dim=-1, keepdim=True)
    torch.testing.assert_close(whole, roma.unitquat_to_rotmat(unit).float(), atol=6e-7, rtol=0)
    assert matrices(stored[:0]).shape == (0, 3, 3)


def test_what_goes_to_another_device_is_rows_as_they_lie_on_disk(store):
    mapped, draws = data(store).store("train"), data(store).train_dataloader().draw
    draw = draws(0, 0, 8)
    elsewhere = mapped.to("meta")  # any device but the CPU
    rows = elsewhere.fetch(draw, 64)
    assert isinstance(rows, Rows) and rows.raw.shape == (8, 64, 2, ROW.itemsize) and rows.raw.dtype == torch.uint8
    there, here = mapped.finish(rows), mapped.gather(draw, 64)
    assert there.names == here.names
    assert all(torch.equal(value, there.tensors()[name]) for name, value in here.tensors().items())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_decodes_what_a_cpu_decodes(store):
    mapped = data(store, compose=0.5, max_agents=4).store("train")
    draw = data(store, compose=0.5, max_agents=4).train_dataloader().draw(0, 0, 32)
    on_gpu = mapped.to("cuda")
    fetched = on_gpu.fetch(draw, 64, 0.9)
    assert fetched.raw.is_pinned()
    theirs, ours = on_gpu.finish(fetched, 0.9), mapped.gather(draw, 64, 0.9)
    for name, value in ours.tensors().items():
        torch.testing.assert_close(theirs.tensors()[name].cpu(), value, atol=1e-5, rtol=0)


# -- reading ahead -----------------------------------------------------------------------------


def names_of(data: Prepared, batches: int) -> list[tuple[str, ...]]:
    """Of the next batches, over epochs."""
    loader, found = data.train_dataloader(), []
    while len(found) < batches:
        for batch in loader:
            found.append(batch.names)
            if len(found) == batches:
                break
    return found


@pytest.mark.parametrize("ahead", [1, 2, 5])
def test_reading_ahead_changes_nothing_that_is_seen(store, ahead):
    plain, early = data(store, read_ahead=0), data(store, read_ahead=ahead)
    assert names_of(plain, 10) == names_of(early, 10)
    for ours, theirs in zip(plain.train_dataloader(), early.train_dataloader(), strict=True):
        assert all(torch.equal(value, theirs.tensors()[name]) for name, value in ours.tensors().items())
    assert plain.state_dict() == early.state_dict()


@pytest.mark.parametrize("seen", [0, 1, 3, 4, 7])
def test_batches_read_ahead_but_not_seen_are_no_part_of_the_state(store, seen):
    whole = names_of(data(store, read_ahead=0), seen + 6)
    first, resumed = data(store, read_ahead=3), data(store, read_ahead=3)
    first.train_dataloader()
    assert names_of(first, seen) == whole[:seen]
    state = first.state_dict()
    assert state == {"epoch": seen // 4, "sample": seen % 4 * 8}
    resumed.load_state_dict(state)
    assert names_of(resumed, 6) == whole[seen:]


def test_a_state_that_is_loaded_while_batches_are_read_ahead_is_where_it_goes_on(store):
    one = data(store, read_ahead=2)
    loader = one.train_dataloader()
    batches = iter(loader)  # Lightning makes the iterator, then restores
    first = next(batches).names
    next(batches)
    loader.load_state_dict({"epoch": 0, "sample": 0})
    assert next(batches).names == first
    loader.load_state_dict({"epoch": 3, "sample": 16})
    assert next(iter(loader)).names == names_of_epoch(store, 3)[2]


def names_of_epoch(store, epoch: int) -> list[tuple[str, ...]]:
    loader = data(store, read_ahead=0).train_dataloader()
    loader.load_state_dict({"epoch": epoch, "sample": 0})
    return [batch.names for batch in loader]


def test_what_goes_wrong_while_reading_ahead_is_raised_where_its_batch_is_asked_for(store, monkeypatch):
    loader = data(store, read_ahead=2).train_dataloader()
    fetch, calls = loader.fetch, []

    def failing(draw):
        calls.append(1)
        if len(calls) == 3:
            raise StoreError("the disk is gone")
        return fetch(draw)

    loader.fetch = failing
    batches = iter(loader)
    seen = [next(batches).names, next(batches).names]
    with pytest.raises(StoreError, match="the disk is gone"):
        next(batches)
    assert loader.state_dict() == {"epoch": 0, "sample": 16}  # the batch that failed comes next
    assert [*seen, *(batch.names for batch in loader)] == names_of_epoch(store, 0)


def test_processes_read_ahead_what_they_would_have_read(store):
    for rank in range(2):
        ours, theirs = data(store, read_ahead=2), data(store, read_ahead=0)
        for one in (ours, theirs):
            one.trainer = FakeTrainer(global_rank=rank, world_size=2)
        assert names_of(ours, 6) == names_of(theirs, 6)


# -- roles, and several stores as one ----------------------------------------------------------


@pytest.fixture(scope="module")
def with_roles(tmp_path_factory) -> Path:
    """Six takes whose first person leads in every other one."""
    folder = tmp_path_factory.mktemp("roles")
    body, read = made.write(folder / "dl", takes=6, frames=80, more=0), made.MadeReader.read

    def named(self, take):
        first = int(take.name[-1]) % 2
        return replace(read(self, take), persons=("P1, leader", "P2, follower")[:: 1 - 2 * first])

    made.MadeReader.read = named  # type: ignore[method-assign]
    try:
        order = Order(made.NAME, str(folder / "dl"), {}, str(body), Steps())
        prepare(order, folder / "store")
    finally:
        made.MadeReader.read = read  # type: ignore[method-assign]
    return folder / "store"


@pytest.mark.parametrize("resident", [False, True])
def test_people_stand_in_the_order_of_roles(with_roles, resident):
    folder = Folder(with_roles)
    assert {tuple(entry["persons"]): entry["takes"] for entry in folder.manifest["persons"]} == {
        ("P1, leader", "P2, follower"): ["take0", "take2", "take4"],
        ("P2, follower", "P1, leader"): ["take1", "take3", "take5"],
    }
    shown = {}
    for roles in ((), ("leader", "follower"), ("follower", "leader")):
        one = data(with_roles, roles=roles, device_resident=resident, **PLAIN)
        shown[roles] = one.train_scenes(64, stride=64)
    recorded, leads, follows = shown.values()
    leader = [int(name.split()[0][-1]) % 2 for name in recorded.names]
    assert 0 < sum(leader) < len(leader)
    for b, slot in enumerate(leader):
        for found, first in ((leads, slot), (follows, 1 - slot)):
            wanted = recorded.pick([b]).order(torch.tensor([first, 1 - first]))
            assert torch.equal(found.pick([b]).T_world_root, wanted.T_world_root)
            assert torch.equal(found.pick([b]).betas, wanted.betas)


def test_mixed_reads_stores_by_memory_map_and_no_clip_whole(store, with_roles, monkeypatch):
    path = data(store).body_model  # the same file as the other store's
    kinds = ({"path": store}, {"path": with_roles, "roles": ("leader",)})
    parts = [made.Made(body_model=path, **kind) for kind in kinds]
    loaded = [made.Made(body_model=path, device_resident=True, **kind) for kind in kinds]
    options = {"batch_size": 16, "epoch_size": 64, "body_model": path, "compose": 0.5, "max_agents": 4}
    monkeypatch.setattr(Folder, "clips", None)  # would load them all
    copied = []
    read = MappedStore.read
    monkeypatch.setattr(MappedStore, "read", lambda self, *a: copied.append(rows := read(self, *a)) or rows)
    mixed = Mixed(parts, **options)
    mapped = mixed.store("train")
    assert isinstance(mapped, MappedStore) and all(isinstance(m, np.memmap) for m in mapped.part.maps.values())
    names = {name.split(" [")[0] for batch in mixed.train_dataloader() for name in batch.names}
    assert len(names) > 10
    assert sum(rows.raw.nbytes for rows in copied) <= (4 + mixed.read_ahead) * 16 * 64 * 4 * ROW.itemsize
    monkeypatch.undo()
    resident = Mixed(loaded, **options)
    for ours, theirs in zip(Mixed(parts, **options).train_dataloader(), resident.train_dataloader(), strict=True):
        assert ours.names == theirs.names
        for name, value in theirs.tensors().items():
            assert torch.equal(ours.tensors()[name], value), name


def test_clips_in_memory_beside_a_store_keep_their_invalid_frames(store):
    kept = random_clip("spoilt", 90, source="memory", bad=(40, 45))
    short = random_clip("short", 40, source="memory")
    clips = [Clip(clip.scene.replace(body=BODY.id), clip.name, clip.source, clip.split) for clip in (kept, short)]
    path = data(store).body_model
    memory = FakeData(clips, body_model=path)
    options = {"body_model": path, "weights": {"memory": 1.0}, "epoch_size": 64, "batch_size": 16, **PLAIN}
    mixed = Mixed([memory, data(store)], **options)
    alone = FakeData(clips, **options)
    assert mixed.store("train").sources.tolist()[:3] == ["memory", "memory", made.NAME]
    seen = 0
    for ours, theirs in zip(mixed.train_dataloader(), alone.train_dataloader(), strict=True):
        assert ours.names == theirs.names and torch.equal(ours.valid, theirs.valid)
        torch.testing.assert_close(ours.body_rot, theirs.body_rot, atol=2e-4, rtol=0)
        torch.testing.assert_close(ours.T_world_root, theirs.T_world_root, atol=2e-4, rtol=0)
        seen += int((~theirs.valid).sum())
    assert seen


def test_each_process_reads_shards_of_its_own_and_together_they_read_all(store):
    whole = data(store).store("train")
    touched = []
    for rank in range(4):
        one = data(store)
        one.trainer = FakeTrainer(global_rank=rank, world_size=4)
        one.store("train").part.maps.clear()
        loader = one.train_dataloader()
        names = {name.split(" [")[0] for _ in range(4) for batch in loader for name in batch.names}
        touched.append(set(one.store("train").part.maps))
        assert names
    shards = range(len(whole.part.files))
    assert len(shards) == 6 and set.union(*touched) == set(shards)
    assert all(len(mine) == 2 and max(mine) - min(mine) == 1 for mine in touched)  # its own, and half of a next one


def test_shares_are_a_function_of_seed_epoch_sample_rank_and_world(store):
    mapped = data(store).store("train")
    make = lambda rank, world, seed=1: RandomDraws(mapped, 64, None, Augmentation(), seed, rank, world)  # noqa: E731
    first, again = make(1, 4), make(1, 4)
    assert first.shared and not make(0, 1).shared
    whole, parts = first(2, 0, 12), [again(2, 0, 5), again(2, 5, 7)]
    assert np.array_equal(whole.clips, np.concatenate([part.clips for part in parts]))
    assert np.array_equal(whole.starts, np.concatenate([part.starts for part in parts]))
    assert not np.array_equal(whole.starts, make(2, 4)(2, 0, 12).starts)
    assert not np.array_equal(whole.starts, make(1, 4, seed=2)(2, 0, 12).starts)


def test_too_few_clips_are_drawn_from_by_everybody(store):
    mapped = data(store).store("train")
    assert mapped.owners(np.ones(len(mapped.names)), 100) is None
    alone = MappedStore(Piece.stored(Folder(store), "train"), 2, spread=False)
    assert alone.owners(np.ones(len(mapped.names)), 2) is None
    owners = mapped.owners(mapped.length / mapped.length.sum(), 2)
    assert owners is not None and owners.tolist() == [0] * 6 + [1] * 6


@pytest.mark.parametrize("spoil", ["missing", "cut", "other"])
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
    if spoil != "missing":
        shard.write_bytes(content[: len(content) // 2] if spoil == "cut" else b"no array at all")
    with pytest.raises(StoreError, match=f"{shard.name}.*prepare the store again"):
        data(copy).store("train")


def test_what_is_no_store_is_refused_with_the_command(store, tmp_path):
    with pytest.raises(ValueError, match=r"no store was given; magnet data prepare made --root"):
        made.Made().prepare_data()
    with pytest.raises(StoreError, match=r"not a prepared store.*magnet data prepare made --root"):
        made.Made(str(tmp_path)).prepare_data()
    with pytest.raises(ValueError, match=r"prepared with body 'made-up-smplx'.*--data\.body_model"):
        made.Made(str(store)).prepare_data()
    later = tmp_path / "manifest.json"
    later.write_text(json.dumps({**json.loads((store / "manifest.json").read_text()), "format": 99}))
    with pytest.raises(StoreError, match="store format 99, this version reads 1"):
        Folder(tmp_path)


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
    order = Order(made.NAME, str(store.parent / "dl"), {}, str(store.parent / "dl/body.npz"), Steps())
    reader = order.reader()
    take = reader.takes()[0]

    def broken(self, take):
        raise IndexError(f"list index out of range in {self.root}/take0.txt")

    monkeypatch.setattr(made.MadeReader, "read", broken)
    part = convert(reader, take, BODY, Steps())
    assert part.error == "IndexError: list index out of range in take0.txt"
