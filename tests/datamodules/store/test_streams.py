"""Laws of the stream of training batches: it can be repeated, resumed and shared among processes."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from magnet.datamodules.options import Augmentation, HeldOutScenes
from magnet.datamodules.store.windows import uniforms
from magnet.motion.scene import concatenate
from tests.datamodules.fakes import FakeData, FakeTrainer, Recorder, couples_and_singles, one_epoch, quiet, same


def test_uniforms_of_a_sample_do_not_depend_on_its_neighbours() -> None:
    whole = uniforms(1, 2, 0, 20, 13)
    assert np.array_equal(whole[7:12], uniforms(1, 2, 7, 5, 13))
    assert not np.array_equal(whole, uniforms(2, 2, 0, 20, 13))
    assert not np.array_equal(whole, uniforms(1, 3, 0, 20, 13))
    assert abs(uniforms(1, 2, 0, 4000, 5).mean() - 0.5) < 0.01


def test_a_sample_depends_only_on_seed_epoch_and_number() -> None:
    clips = couples_and_singles()
    options: dict[str, Any] = {"max_agents": 4, "augment": Augmentation(compose=0.5, drop=0.3), "epoch_size": 96}
    small, large = (FakeData(clips, batch_size=size, **options).train_dataloader() for size in (8, 32))
    for _ in range(2):
        assert same(concatenate(list(small)), concatenate(list(large)))
    other = FakeData(clips, batch_size=32, seed=2, **options)
    first, second = FakeData(clips, batch_size=32, **options), FakeData(clips, batch_size=32, **options)
    assert same(one_epoch(first), one_epoch(second))
    assert one_epoch(other).names != one_epoch(FakeData(clips, batch_size=32, **options)).names


def test_epochs_differ() -> None:
    loader = FakeData(couples_and_singles()).train_dataloader()
    assert len(loader) == 4
    first, second = [b.names for b in loader], [b.names for b in loader]
    assert len(first) == len(second) == 4 and first != second


@pytest.mark.parametrize("seen", [0, 1, 3, 4, 6, 8])
def test_a_restored_stream_goes_on_exactly(seen: int) -> None:
    clips = couples_and_singles()

    def stream(data: FakeData) -> Any:
        loader = data.train_dataloader()
        while True:
            yield from loader

    whole, first, resumed = FakeData(clips), FakeData(clips), FakeData(clips)
    expected = stream(whole)
    running = stream(first)
    for _ in range(seen):
        assert same(next(expected), next(running))
    state = first.state_dict()
    resumed.load_state_dict(state)
    again = stream(resumed)
    for _ in range(6):
        assert same(next(expected), next(again))


@pytest.mark.filterwarnings("ignore:Be aware that when using `ckpt_path`")
@pytest.mark.parametrize(("stop", "limit"), [(2, "max_steps"), (4, "max_steps"), (7, "max_steps"), (1, "max_epochs")])
def test_training_interrupted_by_a_checkpoint_sees_what_it_would_have_seen(
    tmp_path: Path, stop: int, limit: str
) -> None:
    clips = couples_and_singles() + couples_and_singles("val")
    enough = {"max_steps": 12, "max_epochs": 3}[limit]
    whole = Recorder()
    quiet(tmp_path / "a", enable_checkpointing=False, **{limit: enough}).fit(whole, FakeData(clips))
    save = ModelCheckpoint(tmp_path, save_top_k=-1, **({"every_n_train_steps": 1} if limit == "max_steps" else {}))
    begun = Recorder()
    quiet(tmp_path / "b", callbacks=[save], **{limit: stop}).fit(begun, FakeData(clips))
    resumed = Recorder()
    checkpoint = save.best_model_path if limit == "max_epochs" else max(tmp_path.glob("*step=*.ckpt"), key=_step)
    quiet(tmp_path / "c", enable_checkpointing=False, **{limit: enough}).fit(
        resumed, FakeData(clips), ckpt_path=checkpoint
    )
    assert len(whole.seen) == 12
    assert begun.seen + resumed.seen == whole.seen
    assert torch.equal(resumed.weight, whole.weight)


@pytest.mark.filterwarnings("ignore:training goes without validation")
@pytest.mark.parametrize(("overfit", "batches"), [(1, 1), (3, 3), (0.5, 2)])
def test_overfitting_is_shown_the_same_batches_again_and_again(overfit: float, batches: int, tmp_path: Path) -> None:
    """Of four batches an epoch."""
    model, data = Recorder(), FakeData(couples_and_singles())
    quiet(tmp_path, enable_checkpointing=False, max_steps=3 * batches, overfit_batches=overfit).fit(model, data)
    assert len(set(model.seen)) == batches
    assert model.seen == model.seen[:batches] * 3


@pytest.mark.parametrize(("first", "then", "limit"), [(2, 4, "max_epochs"), (6, 11, "max_steps")])
def test_a_second_fit_of_a_trainer_goes_on_and_another_trainers_begins_anew(
    tmp_path: Path, first: int, then: int, limit: str
) -> None:
    clips = couples_and_singles() + couples_and_singles("val")
    whole = Recorder()
    quiet(tmp_path, enable_checkpointing=False, **{limit: then}).fit(whole, FakeData(clips))
    model, data = Recorder(), FakeData(clips)
    trainer = quiet(tmp_path, enable_checkpointing=False, **{limit: first})
    trainer.fit(model, data)
    begun = list(model.seen)
    loop = trainer.fit_loop if limit == "max_epochs" else trainer.fit_loop.epoch_loop
    setattr(loop, limit, then)
    trainer.fit(model, data)
    assert len(begun) < len(model.seen) and model.seen == whole.seen
    another = Recorder()
    quiet(tmp_path, enable_checkpointing=False, **{limit: first}).fit(another, data)
    assert another.seen == begun


def _step(path: Path) -> int:
    match = re.search(r"step=(\d+)", path.name)
    assert match
    return int(match[1])


@pytest.mark.filterwarnings("ignore:Lightning couldn't infer the indices")
def test_a_trainer_is_given_what_plain_iteration_gives(tmp_path: Path) -> None:
    clips = couples_and_singles("test") + couples_and_singles("val")
    options: dict[str, Any] = {"test": HeldOutScenes(context_frames=16, horizon_frames=32, batch_size=3)}
    expected = [batch.names for batch in FakeData(clips, **options).test_dataloader()]
    model = Recorder()
    trainer = quiet(tmp_path)
    trainer.test(model, FakeData(clips, **options), verbose=False)
    assert model.checked == expected
    assert trainer.predict(model, FakeData(clips, **options)) == expected
    model.checked.clear()
    trainer.validate(model, FakeData(clips, **options), verbose=False)
    assert model.checked == [batch.names for batch in FakeData(clips, **options).val_dataloader()]


# -- processes ---------------------------------------------------------------------------------


def rank_of(rank: int, world: int, **options: Any) -> FakeData:
    data = FakeData(couples_and_singles() + couples_and_singles("test"), **options)
    data.trainer = FakeTrainer(rank, world)  # type: ignore[assignment]
    return data


@pytest.mark.parametrize("world", [2, 3])
def test_training_shards_together_are_the_single_process(world: int) -> None:
    alone = [b.names for b in rank_of(0, 1, batch_size=4 * world, epoch_size=48).train_dataloader()]
    options = {"batch_size": 4, "epoch_size": 48}
    shards = [[b.names for b in rank_of(r, world, **options).train_dataloader()] for r in range(world)]
    assert [sum(parts, ()) for parts in zip(*shards, strict=True)] == alone


@pytest.mark.parametrize("batch_size", [1, 2, 5, 100])
@pytest.mark.parametrize("world", [1, 2, 4, 11])
def test_test_shards_are_disjoint_complete_and_equally_many_batches(world: int, batch_size: int) -> None:
    options: dict[str, Any] = {"test": HeldOutScenes(context_frames=8, horizon_frames=32, batch_size=batch_size)}
    alone = [name for batch in rank_of(0, 1, **options).test_dataloader() for name in batch.names]
    loaders = [rank_of(rank, world, **options).test_dataloader() for rank in range(world)]
    shards = [[batch.names for batch in loader] for loader in loaders]
    names = [name for shard in shards for batch in shard for name in batch]
    assert len(set(alone)) == len(alone) and sorted(names) == sorted(alone)
    assert {len(shard) for shard in shards} == {len(loader) for loader in loaders} == {len(shards[0])}
    assert max(len(batch) for shard in shards for batch in shard) <= batch_size + 1


def test_more_processes_than_test_scenes_are_refused() -> None:
    with pytest.raises(ValueError, match="windows for 50 processes"):
        rank_of(0, 50, test=HeldOutScenes(context_frames=8, horizon_frames=32)).test_dataloader()
