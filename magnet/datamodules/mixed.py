"""Several data sets as one."""

from __future__ import annotations

from typing import Any

from magnet.datamodules.base import Clip, MotionDataModule, Split, clips_of
from magnet.datamodules.registry import register_data
from magnet.datamodules.store.mapped import MappedStore
from magnet.datamodules.store.memory import MemoryStore
from magnet.datamodules.store.reader import StoreSplit


class Parts(MotionDataModule):
    """Base of data sets that are made of others, all of one body.

    Args:
        data: the others.
        **kwargs: as for MotionDataModule.

    Raises:
        ValueError: no data sets, or bodies differ.
    """

    doubted = True  # each of the others is looked at by itself

    def __init__(self, data: list[MotionDataModule], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not data:
            raise ValueError("data: got no data sets, expected at least one")
        bodies = {part.body_model for part in data} | {self.body_model}
        if len(bodies) > 1:
            raise ValueError(f"body_model: data sets of one body can be mixed, got {sorted(bodies)}")
        self.data = list(data)

    def prepare_data(self) -> None:
        """Let every data set prepare its files."""
        for part in self.data:
            part.prepare_data()

    def setup(self, stage: str) -> None:
        """Let every data set set itself up."""
        for part in self.data:
            part.setup(stage)


@register_data(combines=True)
class Mixed(Parts):
    """Trains on several data sets at once; tests on one of them, or on all.

    Only the clips of each data set are used: window, batch and augmentation are set here. If one of them is a prepared
    store read by memory map, all are treated as one: the frames of the others are kept in memory as rows of a store,
    188 bytes per frame and person, and each process reads its own part of every source of clips.

    Args:
        data: the data sets; all of one body.
        test_on: position in `data` of the one whose test split is used; None: all of them.
        val_on: the same for the val split.
        spread: as for `Prepared`; has no effect where no data set is read by memory map.
        **kwargs: as for MotionDataModule; `weights` says how the sources of clips are mixed.

    Raises:
        ValueError: no data sets, bodies differ, or no such position.
    """

    def __init__(
        self,
        data: list[MotionDataModule],
        test_on: int | None = None,
        val_on: int | None = None,
        spread: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(data, **kwargs)
        for name, position in {"test_on": test_on, "val_on": val_on}.items():
            if position is not None and not 0 <= position < len(data):
                raise ValueError(f"{name}: got {position}, expected a position from 0 to {len(data) - 1}")
        self.spread = spread
        self.chosen = {"train": None, "val": val_on, "test": test_on}

    @property
    def maps_files(self) -> bool:  # type: ignore[override]
        return any(part.maps_files for part in self.data)

    def clips(self, split: Split) -> list[Clip]:
        """Clips of all data sets, or of the one chosen for the split."""
        return [clip for part in self._used(split) for clip in clips_of(part, split)]

    def split_data(self, split: Split) -> StoreSplit | None:
        """Rows of all data sets, or of the one chosen for the split."""
        parts = [data for part in self._used(split) if (data := part.split_data(split)) is not None]
        return StoreSplit.concatenate(parts) if parts else None

    def open_store(self, split: Split) -> MemoryStore:
        """By memory map where a data set is; else all clips in memory."""
        if self.maps_files and (data := self.split_data(split)) is not None:
            return MappedStore(data, self.max_agents, self.spread)
        return super().open_store(split)

    def _used(self, split: Split) -> list[MotionDataModule]:
        chosen = self.chosen[split]
        return self.data if chosen is None else [self.data[chosen]]
