"""Training from a store: by memory map, ahead in threads, and the same windows as from memory."""

from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest
import roma
import torch

from magnet.datamodules.fakes.motion import made_up_body
from magnet.datamodules.options import Augmentation
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.store.mapped import MappedStore, RawBatch
from magnet.datamodules.store.memory import MemoryStore
from magnet.datamodules.store.reader import StoreError
from magnet.datamodules.store.rows import CACHED, ROW, SCALE, matrices, nine_at_once
from tests.datamodules import made
from tests.datamodules.fakes import FakeTrainer, Recorder, quiet
from tests.datamodules.made import data

BODY = made_up_body()


def test_mapped_training_windows_are_those_from_memory(store):
    options = {"augment": Augmentation(compose=0.5, drop=0.3), "max_agents": 4, "weights": {made.NAME: 1.0}}
    mapped, resident = data(store, **options), data(store, device_resident=True, **options)
    assert isinstance(mapped.store("train"), MappedStore) and type(resident.store("train")) is MemoryStore
    for ours, theirs in zip(mapped.train_dataloader(), resident.train_dataloader(), strict=True):
        assert ours.names == theirs.names and ours.body == theirs.body == BODY.id
        for name, value in theirs.tensors().items():
            assert torch.equal(ours.tensors()[name], value), name
    for split in ("val", "test"):
        loader = getattr(mapped, f"{split}_dataloader" if split == "val" else "val_dataloader")()
        assert next(iter(loader)).scenes


def test_memory_holds_only_the_index(store):
    mapped = data(store).store("train")
    held = mapped.part.slot_order.nbytes + mapped.part.betas.nbytes
    assert not hasattr(mapped, "tensors") and held < 200 * len(mapped.names)
    assert all(isinstance(shard, np.memmap) for shard in mapped.part.maps.values())
    for batch in data(store, read_ahead=0).train_dataloader():
        assert batch.scenes == 8
    assert all(np.shares_memory(shard, mapped.shard(number)) for number, shard in mapped.part.maps.items())


def test_a_rotation_comes_out_the_same_whatever_it_is_decoded_with(generator):
    quat = torch.randn(2 * CACHED + 37, 4, generator=generator)
    stored = (SCALE * quat / quat.norm(dim=-1, keepdim=True)).round().to(torch.int16)
    whole = matrices(stored)
    assert torch.equal(whole[5:900], matrices(stored[5:900])) and torch.equal(whole[-1], matrices(stored[-1]))
    assert torch.equal(whole.view(-1, 9), nine_at_once(stored))  # what a GPU computes
    unit = stored.double() / stored.double().norm(dim=-1, keepdim=True)
    torch.testing.assert_close(whole, roma.unitquat_to_rotmat(unit).float(), atol=6e-7, rtol=0)
    assert matrices(stored[:0]).shape == (0, 3, 3)


def test_what_goes_to_another_device_is_rows_as_they_lie_on_disk(store):
    mapped, draws = data(store).store("train"), data(store).train_dataloader().draw
    draw = draws(0, 0, 8)
    elsewhere = mapped.to("meta")  # any device but the CPU
    rows = elsewhere.fetch(draw, 64)
    assert isinstance(rows, RawBatch) and rows.raw.shape == (8, 64, 2, ROW.itemsize) and rows.raw.dtype == torch.uint8
    there, here = mapped.finish(rows), mapped.gather(draw, 64)
    assert there.names == here.names
    assert all(torch.equal(value, there.tensors()[name]) for name, value in here.tensors().items())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_decodes_what_a_cpu_decodes(store):
    mapped = data(store, augment=Augmentation(compose=0.5), max_agents=4).store("train")
    draw = data(store, augment=Augmentation(compose=0.5), max_agents=4).train_dataloader().draw(0, 0, 32)
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


def readers_ahead() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.startswith("read-ahead")}


def test_threads_that_read_ahead_end_with_the_fit_and_begin_again_when_asked(store, tmp_path):
    before, one = readers_ahead(), data(store, read_ahead=3)
    loader = one.train_dataloader()
    assert readers_ahead() <= before
    first, second = (batch.names for batch in itertools.islice(loader, 2))
    assert 0 < len(readers_ahead() - before) <= 3
    one.teardown("fit")
    assert readers_ahead() <= before
    assert [first, second, *(batch.names for batch in loader)] == names_of_epoch(store, 0)
    one.train_dataloader()  # a new stream ends the old one's
    assert readers_ahead() <= before
    quiet(tmp_path, max_steps=3, enable_checkpointing=False, limit_val_batches=0).fit(model := Recorder(), one)
    assert model.seen == [first, second, names_of_epoch(store, 0)[2]] and readers_ahead() <= before


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
    draw, fetch, third = loader.draw, loader.fetch, []

    def drawn(epoch, first, count):
        windows = draw(epoch, first, count)
        if (epoch, first) == (0, 16) and not third:  # the third batch, whichever thread reads it and when
            third.append(windows)
        return windows

    def failing(windows):
        if third and windows is third[0]:
            raise StoreError("the disk is gone")
        return fetch(windows)

    loader.draw, loader.fetch = drawn, failing
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
