"""Who reads what of a store: people by role, several stores as one, lengths of it for each process."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet.datamodules import Clip, Mixed
from magnet.datamodules.base import MotionDataModule
from magnet.datamodules.fakes.motion import made_up_body
from magnet.datamodules.options import Augmentation
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import PrepareJob
from magnet.datamodules.preparing.prepare import prepare
from magnet.datamodules.store.mapped import MappedStore
from magnet.datamodules.store.reader import StoreReader
from magnet.datamodules.store.rows import ROW
from magnet.datamodules.store.windows import RandomWindows
from tests.datamodules import made
from tests.datamodules.fakes import PLAIN, FakeData, FakeTrainer, random_clip
from tests.datamodules.made import data

BODY = made_up_body()


@pytest.fixture(scope="module")
def with_roles(known, tmp_path_factory) -> Path:
    """Six takes whose first person leads in every other one."""
    folder = tmp_path_factory.mktemp("roles")
    body, read = made.write(folder / "dl", takes=6, frames=80, more=0), made.MadeReader.read

    def named(self, take):
        first = int(take.name[-1]) % 2
        return replace(read(self, take), persons=("P1, leader", "P2, follower")[:: 1 - 2 * first])

    made.MadeReader.read = named  # type: ignore[method-assign]
    try:
        order = PrepareJob(made.NAME, str(folder / "dl"), {}, str(body), CanonicalizeOptions())
        prepare(order, folder / "store")
    finally:
        made.MadeReader.read = read  # type: ignore[method-assign]
    return folder / "store"


@pytest.mark.parametrize("resident", [False, True])
def test_people_stand_in_the_order_of_roles(with_roles, resident):
    folder = StoreReader(with_roles)
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
            wanted = recorded.select([b]).permute_agents(torch.tensor([first, 1 - first]))
            assert torch.equal(found.select([b]).T_world_root, wanted.T_world_root)
            assert torch.equal(found.select([b]).betas, wanted.betas)


def test_roles_are_read_in_any_case_and_one_that_nobody_has_is_refused(with_roles):
    order = [data(with_roles, roles=roles, **PLAIN).train_scenes(8, stride=64) for roles in (("leader",), ("Leader",))]
    assert torch.equal(order[0].T_world_root, order[1].T_world_root)
    with pytest.raises(ValueError, match=r"roles: got leeder, which nobody in .* has; its people are P1, leader"):
        data(with_roles, roles=("leeder",), **PLAIN).train_scenes(8, stride=64)


def test_mixed_reads_stores_by_memory_map_and_no_clip_whole(store, with_roles, monkeypatch):
    path = data(store).body_model  # the same file as the other store's
    kinds = ({"path": store}, {"path": with_roles, "roles": ("leader",)})
    parts = [made.Made(body_model=path, **kind) for kind in kinds]
    loaded = [made.Made(body_model=path, device_resident=True, **kind) for kind in kinds]
    options = {
        "batch_size": 16,
        "epoch_size": 64,
        "body_model": path,
        "augment": Augmentation(compose=0.5),
        "max_agents": 4,
    }
    monkeypatch.setattr(StoreReader, "clips", None)  # would load them all
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


def of_body(*clips: Clip) -> list[Clip]:
    """As if they were of the store's body."""
    return [Clip(clip.scene.replace(body=BODY.id), clip.name, clip.source, clip.split) for clip in clips]


def test_clips_in_memory_beside_a_store_keep_their_invalid_frames(store):
    kept = random_clip("spoilt", 90, source="memory", bad=(40, 45))
    short = random_clip("short", 40, source="memory")
    clips = of_body(kept, short)
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
        loader = one.train_dataloader()
        names = {name.split(" [")[0] for _ in range(4) for batch in loader for name in batch.names}
        touched.append(set(one.store("train").shards))
        assert names
    shards = range(len(whole.part.files))
    assert len(shards) == 6 and set.union(*touched) == set(shards)
    assert all(len(mine) == 2 and max(mine) - min(mine) == 1 for mine in touched)  # its own, and half of a next one


@pytest.mark.parametrize("spread", [True, False])
def test_mixed_gives_each_process_a_length_of_every_source(store, spread):
    memory = of_body(*(random_clip(f"clip{k}", 80, source="memory") for k in range(8)))
    drawn, read = [], []
    for rank in range(2):
        parts = [FakeData(memory, body_model=data(store).body_model), data(store)]
        options = {"epoch_size": 1024, "batch_size": 64, "body_model": data(store).body_model, **PLAIN}
        mixed = Mixed(parts, spread=spread, read_ahead=0, **options)
        mixed.trainer = FakeTrainer(global_rank=rank, world_size=2)
        drawn.append({name.split(" [")[0] for batch in mixed.train_dataloader() for name in batch.names})
        mapped = mixed.store("train")
        assert isinstance(mapped, MappedStore)
        read.append(set(mapped.shards))
    assert drawn[0] | drawn[1] == set(mapped.names) and len(mapped.names) == 20
    assert read[0] | read[1] == set(range(7))  # the clips in memory are the first
    if spread:
        assert not drawn[0] & drawn[1] and read[0] & read[1] == {0}
        assert [sum(name.startswith("clip") for name in mine) for mine in drawn] == [4, 4]
        assert [len(mine) for mine in drawn] == [10, 10] and [len(mine) for mine in read] == [4, 4]
    else:
        assert drawn[0] == drawn[1] and read[0] == read[1]


def test_shares_are_a_function_of_seed_epoch_sample_rank_and_world(store):
    mapped = data(store).store("train")
    alone = Augmentation(drop=0.0, compose=0.0)

    def make(rank: int, world: int, seed: int = 1) -> RandomWindows:
        return RandomWindows(mapped, 64, None, alone, seed, rank, world)

    first, again = make(1, 4), make(1, 4)
    assert first.shared and not make(0, 1).shared
    whole, parts = first(2, 0, 12), [again(2, 0, 5), again(2, 5, 7)]
    assert np.array_equal(whole.clips, np.concatenate([part.clips for part in parts]))
    assert np.array_equal(whole.starts, np.concatenate([part.starts for part in parts]))
    assert not np.array_equal(whole.starts, make(2, 4)(2, 0, 12).starts)
    assert not np.array_equal(whole.starts, make(1, 4, seed=2)(2, 0, 12).starts)


def test_sources_that_weights_do_not_name_are_told(store):
    """They are not trained on: who adds a data set to weighted ones would not see it."""
    mapped, plain = data(store).store("train"), Augmentation(drop=0.0, compose=0.0)
    mapped.sources = mapped.sources.astype(object)
    mapped.sources[0] = "another"
    weights = {source: 1.0 for source in mapped.sources if source != "another"}
    with pytest.warns(UserWarning, match="nothing of another is trained on: say a weight, or 0"):
        RandomWindows(mapped, 64, weights, plain, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RandomWindows(mapped, 64, weights | {"another": 0.0}, plain, 1)


def test_too_few_clips_are_drawn_from_by_everybody(store):
    mapped = data(store).store("train")
    assert mapped.owners(np.ones(len(mapped.names)), 100) is None
    alone = MappedStore(StoreReader(store).split("train"), 2, spread=False)
    assert alone.owners(np.ones(len(mapped.names)), 2) is None
    owners = mapped.owners(mapped.length / mapped.length.sum(), 2)
    assert owners is not None and owners.tolist() == [0] * 6 + [1] * 6


def test_what_a_page_and_help_say_of_the_number_of_processes_holds(store):
    """Samples of a store that is divided depend on it; undivided they do not."""

    def global_batch(world: int, spread: bool) -> list[str]:
        names = []
        for rank in range(world):
            one = data(store, spread=spread, batch_size=8 // world, epoch_size=64, **PLAIN)
            one.trainer = FakeTrainer(global_rank=rank, world_size=world)
            names += next(iter(one.train_dataloader())).names
        return names

    assert global_batch(2, spread=True) != global_batch(1, spread=True)
    assert global_batch(2, spread=False) == global_batch(1, spread=False)
    page = (Path(__file__).parents[3] / "docs" / "scale.md").read_text()
    assert "another number of\nprocesses draws other samples" in page
    assert "depends on their number as well" in " ".join((MotionDataModule.__doc__ or "").split())
