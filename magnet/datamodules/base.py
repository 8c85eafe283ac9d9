"""The base of all data sets: a list of clips, from which batches of `Scene` are made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from lightning.pytorch import LightningDataModule, Trainer
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor

from magnet.body import Body, load_body
from magnet.datamodules.clip import MOST, RESHAPED, Clip, Split, at_least, at_most
from magnet.datamodules.doubted import doubt_of
from magnet.datamodules.options import AUGMENTATION, HELD_OUT, Augmentation, HeldOutScenes
from magnet.datamodules.store.loaders import FixedLoader, TrainLoader
from magnet.datamodules.store.memory import MemoryStore, WindowIndex
from magnet.datamodules.store.reader import StoreSplit
from magnet.datamodules.store.windows import RandomWindows, composed_windows, fixed_windows, longest_stretch
from magnet.errors import DataError
from magnet.motion.required import require_rate
from magnet.motion.scene import Scene
from magnet.motion.tokens import MOST_SLOTS
from magnet.plugins import attempted, told
from magnet.seeding import derive

__all__ = ["Clip", "EmptySplitError", "MotionDataModule", "Split", "clips_of"]


class EmptySplitError(ValueError):
    """A split has no clips; the message names the splits that have some."""


def clips_of(data: MotionDataModule, split: Split) -> list[Clip]:
    """The clips of a split, checked, because a data set may be somebody else's.

    Raises:
        DataError: it is not there, takes no split, raises what is no ValueError, or gives something else than clips.
        ValueError: a clip has another frame rate than the models.

    Warns:
        once for each data set, if its clips look like another unit, up axis or floor.
    """
    name = f"data set {type(data).__module__}.{type(data).__qualname__}"
    given: list[Any] = []
    with torch.inference_mode(False), torch.enable_grad():  # Lightning tests in it, and clips may have to be fitted
        error = attempted(lambda: given.append(data.clips(split)))
    if isinstance(error, ValueError | OSError | ImportError):
        raise error  # what is wrong with files, or not installed, is said already
    if error is not None:
        raise DataError(f"{name}: clips({split!r}) fails: {told(error)}; see docs/own.md") from error
    (clips,) = given
    if not isinstance(clips, list | tuple):
        raise DataError(f"{name}: clips({split!r}) gave {type(clips).__name__}, expected a list of Clip")
    if strange := [clip for clip in clips if not isinstance(clip, Clip)]:
        raise DataError(f"{name}: clips({split!r}) gave {type(strange[0]).__name__} in its list, expected Clip")
    if other := [clip for clip in clips if clip.split != split]:
        raise DataError(
            f"{name}: clips({split!r}) gave {other[0].name}, which is of split {other[0].split!r}; "
            "give only those of the split that is asked for"
        )
    for clip in clips:
        require_rate(clip.scene, f"{name}: clip {clip.name}")
    if not data.doubted and (doubt := doubt_of(clips)):
        data.doubted = True
        rank_zero_warn(f"{name}: {doubt}")
    return list(clips)


class MotionDataModule(LightningDataModule):
    """Base of all data sets; a subclass implements `clips` and perhaps `prepare_data`.

    All frames of a split are kept in memory, on the trainer's device if there is a trainer, and batches are gathered
    there. Without a trainer the loaders yield scenes on the CPU.

    Args:
        window_frames: frames of a training and validation window; 64 are 16 tokens (the paper does not say).
        batch_size: scenes a training batch and process (paper A.3).
        max_agents: slots P of every batch; smaller scenes leave slots empty (paper 4, 2 to 4 people).
        augment: what happens to training windows.
        test: scenes to test on.
        weights: share of each source of clips among training windows; what is not named is not trained on, which a
            warning says unless its share is 0. None: as many as it has frames.
        epoch_size: training windows per epoch over all processes; None: four times as many as fit side by side into
            the training frames.
        val_batch_size: scenes a validation batch.
        seed: seeds all randomness here: sample i of epoch e depends only on (seed, e, i). Of a prepared store that
            processes divide among them (`spread`), it depends on their number as well.
        body_model: "open" or the path of a body file in SMPL-X's npz layout.
        device_resident: keep all frames on the trainer's device; False: gather on the CPU and send batches,
            for data sets larger than the GPU's memory.
        read_ahead: training batches that threads read from disk while the model computes; 0: none. Clips in memory
            need no reading ahead.

    Raises:
        ValueError: a number is out of its range.
    """

    doubted: bool = False  # it has been said that clips look wrong; True from the start: they are not looked at
    maps_files: ClassVar[bool] = False  # `open_store` leaves frames on disk and sends them compact to the device

    def __init__(
        self,
        window_frames: int = 64,
        batch_size: int = 256,
        max_agents: int = 2,
        augment: Augmentation = AUGMENTATION,
        test: HeldOutScenes = HELD_OUT,
        weights: dict[str, float] | None = None,
        epoch_size: int | None = None,
        val_batch_size: int = 256,
        seed: int = 1111,
        body_model: str = "open",
        device_resident: bool = True,
        read_ahead: int = 2,
    ) -> None:
        super().__init__()
        at_least(1, window_frames=window_frames, batch_size=batch_size, max_agents=max_agents, epoch_size=epoch_size)
        at_least(1, val_batch_size=val_batch_size)
        at_most(MOST, window_frames=window_frames, batch_size=batch_size, val_batch_size=val_batch_size)
        at_most(MOST_SLOTS, max_agents=max_agents)
        at_least(0, read_ahead=read_ahead)
        self.window_frames = window_frames
        self.batch_size = batch_size
        self.max_agents = max_agents
        self.augment = augment
        self.test = test
        self.weights: Mapping[str, float] | None = weights
        self.epoch_size = epoch_size
        self.val_batch_size = val_batch_size
        self.seed = seed
        self.body_model = body_model
        self.device_resident = device_resident
        self.read_ahead = read_ahead
        self._stores: dict[tuple[str, torch.device], MemoryStore] = {}
        self._train_loader: TrainLoader | None = None
        self._trained_by: Trainer | None = None
        self._resume: dict[str, int] | None = None

    # -- what a data set implements ------------------------------------------------------------

    def clips(self, split: Split) -> list[Clip]:
        """Clips of a split: 30 fps, y up, floor at height 0, all of `self.body`. Called once a split."""
        raise NotImplementedError(f"{type(self).__name__} must implement clips(split)")

    @cached_property
    def body(self) -> Body:
        """The body model that shape numbers of all clips belong to."""
        return load_body(self.body_model)

    # -- clips in memory -----------------------------------------------------------------------

    def store(self, split: Split, device: torch.device | str = "cpu") -> MemoryStore:
        """All clips of a split as flat tensors; read once, kept on each device asked for.

        Raises:
            ValueError: the split has no clips.
        """
        device = torch.device(device)
        if (split, device) not in self._stores:
            if device.type == "cpu":
                self._stores[split, device] = self.open_store(split)
            else:
                self._stores[split, device] = self.store(split).to(device)
        return self._stores[split, device]

    def open_store(self, split: Split) -> MemoryStore:
        """The clips of a split as a store on the CPU; in memory unless a data set overrides this.

        Raises:
            EmptySplitError: the split has no clips.
        """
        clips = clips_of(self, split)
        if not clips:
            raise EmptySplitError(
                f"{type(self).__name__}: split {split} is empty; give it recordings, or leave out what needs it"
            )
        return MemoryStore(clips, self.max_agents)

    def split_data(self, split: Split) -> StoreSplit | None:
        """The clips of a split as rows to be read by memory map; None: there are none."""
        clips = clips_of(self, split)
        return StoreSplit.encoded(clips) if clips else None

    def _placed(self, split: Split) -> MemoryStore:
        """The split's store where the trainer computes."""
        device = torch.device("cpu")
        if self.trainer is not None and (self.device_resident or self.maps_files):
            device = self.trainer.strategy.root_device
        return self.store(split, device)

    def _gather(self, split: Split, frames: int, windows: WindowIndex) -> Scene:
        return self._placed(split).gather(windows, frames, self.augment.compose_clearance)

    def _shard(self) -> tuple[int, int]:
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)

    # -- loaders -------------------------------------------------------------------------------

    def train_dataloader(self) -> TrainLoader:
        """Random windows (batch_size, window_frames, max_agents).

        They continue from a loaded state, or where the last loader of the same trainer ended; for another trainer they
        start anew.
        """
        if self.trainer is not None and self.trainer is self._trained_by:
            self._resume = self.state_dict()
        self._trained_by = self.trainer
        self._close()
        store = self.store("train")
        place = self._shard()
        draws = RandomWindows(store, self.window_frames, self.weights, self.augment, self.seed, *place)
        size = self.epoch_size or 4 * -(-int(store.length.sum()) // self.window_frames)
        placed, frames, clearance = self._placed("train"), self.window_frames, self.augment.compose_clearance
        self._train_loader = TrainLoader(
            draws,
            lambda windows: placed.fetch(windows, frames, clearance),
            lambda fetched: placed.finish(fetched, clearance),
            self.batch_size,
            size,
            *place,
            shared=draws.shared,
            ahead=self.read_ahead if placed.on_disk else 0,
            overfit=0 if self.trainer is None else self.trainer.overfit_batches,  # type: ignore[attr-defined]
        )
        if self._resume:
            self._train_loader.load_state_dict(self._resume)
        self._resume = None
        return self._train_loader

    def statistics_batches(self, batches: int = 8) -> Iterator[Scene]:
        """Training batches for statistics: the same on every rank, and separate from the training stream."""
        store = self.store("train")
        draws = RandomWindows(store, self.window_frames, self.weights, self.augment, derive(self.seed, "statistics"))
        for number in range(batches):
            yield self._gather("train", self.window_frames, draws(0, number * self.batch_size, self.batch_size))

    def val_dataloader(self) -> FixedLoader | list[Any]:
        """Windows of the val split side by side, nothing random (val_batch_size, window_frames, max_agents).

        Without clips to validate on there is no loader: training goes on without validation, and says so.
        """
        try:
            store = self.store("val")
        except EmptySplitError as error:
            rank_zero_warn(f"training goes without validation, and no best checkpoint is chosen: {error}")
            return []
        windows = fixed_windows(store, self.window_frames, self.window_frames, pad=True)
        return self._fixed("val", windows, self.window_frames, self.val_batch_size)

    def kinds_of(self, labels: Sequence[str]) -> tuple[str, ...]:
        """The source of each training scene, by its label; on other bodies a dance is the same dance."""
        return tuple(source.replace(RESHAPED, "") for source in self.store("train").sources_of(labels))

    def test_dataloader(self) -> FixedLoader:
        """Context and horizon of scenes of the test split (test.batch_size, context + horizon, max_agents)."""
        return self._fixed("test", self.test_windows(), self.test.frames, self.test.batch_size)

    def predict_dataloader(self) -> FixedLoader:
        """The same scenes as `test_dataloader`."""
        return self.test_dataloader()

    def _some(self, split: Split, windows: WindowIndex, frames: int) -> WindowIndex:
        """The windows, of which there must be some."""
        if not len(windows):
            store = self.store(split)
            rest = longest_stretch(store) - self.test.context_frames
            fewer = "ask for fewer frames"
            if frames == self.test.frames and rest > 0:
                fewer += f": --data.test.horizon_frames {rest} at most, after {self.test.context_frames} of context"
            raise ValueError(
                f"{type(self).__name__}: split {split} has no clean stretch of {frames} frames; its longest clip has"
                f" {int(store.length.max())}; {fewer}"
            )
        return windows

    def _fixed(self, split: Split, windows: WindowIndex, frames: int, batch_size: int) -> FixedLoader:
        windows = self._some(split, windows, frames)
        return FixedLoader(windows, lambda part: self._gather(split, frames, part), batch_size, *self._shard())

    def test_windows(self) -> WindowIndex:
        """Which windows the test scenes are; composed ones come last."""
        store, frames = self.store("test"), self.test.frames
        plain = windows = fixed_windows(store, frames, self.test.stride or frames)
        if self.test.limit is not None and len(plain) > self.test.limit:
            kept = np.arange(self.test.limit) * len(plain) // self.test.limit
            windows = plain[kept]
        return self._with_composed(store, windows, plain, self.test.composed)

    def _with_composed(self, store: MemoryStore, windows: WindowIndex, plain: WindowIndex, count: int) -> WindowIndex:
        """The windows, and behind them so many scenes that are made of two plain ones each."""
        if not count or not len(plain):
            return windows
        composed = composed_windows(store, plain, count, self.augment.compose_apart, self.seed)
        return WindowIndex.concatenate([windows, composed])

    def train_scenes(self, frames: int, stride: int = 30, composed: int = 0, most: int | None = None) -> Scene:
        """Valid training windows of `frames` frames, `stride` apart, and `composed` scenes made of two of them each.

        Args:
            most: of more windows so many, evenly spread; None: all.

        Raises:
            ValueError: no clip is long enough.
        """
        return self.store("train").gather(
            self._train_index(frames, stride, composed, most), frames, self.augment.compose_clearance
        )

    def train_windows(
        self, frames: int, stride: int = 30, composed: int = 0, most: int | None = None, chunk: int = 64
    ) -> Iterator[Scene]:
        """The same as `train_scenes`, in batches of at most `chunk` scenes.

        Raises:
            ValueError: no clip is long enough.
        """
        store, windows = self.store("train"), self._train_index(frames, stride, composed, most)
        for first in range(0, len(windows), chunk):
            yield store.gather(windows[first : first + chunk], frames, self.augment.compose_clearance)

    def _train_index(self, frames: int, stride: int, composed: int, most: int | None) -> WindowIndex:
        store = self.store("train")
        windows = self._some("train", fixed_windows(store, frames, stride), frames)
        if most is not None and len(windows) > most:
            windows = windows[np.linspace(0, len(windows) - 1, most).round().astype(np.int64)]
        return self._with_composed(store, windows, windows, composed)

    # -- Lightning -----------------------------------------------------------------------------

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        """Move scenes by `Scene.to`, and anything else as Lightning does."""
        if isinstance(batch, Scene | Tensor):
            return batch.to(device)
        return super().transfer_batch_to_device(batch, device, dataloader_idx)

    def __getstate__(self) -> dict[str, Any]:
        """Without the loader of a training, which is no part of a copy, nor of what is sent to a spawned process."""
        return {**self.__dict__, "_train_loader": None, "_trained_by": None}

    def teardown(self, stage: str) -> None:
        """End the threads that read ahead; the next batch starts new ones."""
        self._close()

    def _close(self) -> None:
        if self._train_loader is not None:
            self._train_loader.close()

    def state_dict(self) -> dict[str, Any]:
        """Position in the training stream. Lightning restores a loader's own state only within an epoch."""
        return {} if self._train_loader is None else self._train_loader.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue training with the next sample."""
        if state_dict:
            self._resume = {"epoch": state_dict["epoch"], "sample": state_dict["sample"]}
            if self._train_loader is not None:
                self._train_loader.load_state_dict(self._resume)
