"""Data sets that were prepared once by `magnet data prepare` and are trained from by memory map."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar

from magnet.datamodules.base import Clip, EmptySplitError, MotionDataModule, Split
from magnet.datamodules.reading.recording import Reader
from magnet.datamodules.registry import register_data
from magnet.datamodules.store.mapped import MappedStore
from magnet.datamodules.store.memory import MemoryStore
from magnet.datamodules.store.reader import StoreError, StoreReader, StoreSplit, body_hash


@register_data(combines=True)
class Prepared(MotionDataModule):
    """Random windows of a prepared store of any size, in constant memory.

    If the store has enough clips, each process reads its own part of it: sample k of process r is sample k * world + r
    of an epoch and depends only on (seed, epoch, k, r, world). Parts are equally likely, so that a step over all
    processes draws like one over the whole store.

    Args:
        path: the store's folder, as `magnet data prepare` wrote it.
        root: another name of `path`, as the folders of other data sets are called.
        spread: let each process read its own part if there are enough clips; False: all draw from all clips.
        roles: words such as leader and follower; people whose names in the store hold the first word get the first
            slots, and so on; others follow in the order of the recording. In training it has no effect unless
            `augment.shuffle` is off; in tests it always says who is agent 0.
        device_resident: keep all frames decoded in memory, on the trainer's device; for stores that fit there.
        body_model: "open", or the path of the body file that the store was prepared with.
        max_agents: slots P of every batch; at least the store's largest group.
        **kwargs: as for MotionDataModule.

    Raises:
        ValueError: no path; the folder is no store or another data set's; the body is not the store's. When the
            data are first used.
    """

    reader: ClassVar[type[Reader] | None] = None
    """Reader of the data set whose stores these are; None: any store."""

    def __init__(
        self,
        path: str = "",
        root: str = "",
        spread: bool = True,
        roles: Sequence[str] = (),
        device_resident: bool = False,
        body_model: str = "open",
        max_agents: int = 2,
        **kwargs: Any,
    ) -> None:
        super().__init__(device_resident=device_resident, body_model=body_model, max_agents=max_agents, **kwargs)
        if path and root and path != root:
            raise ValueError(f"path {path} and root {root} are two names of one thing, the store's folder; give one")
        self.path, self.spread, self.roles = path or root, spread, tuple(roles)

    @property
    def maps_files(self) -> bool:  # type: ignore[override]
        return not self.device_resident

    @cached_property
    def folder(self) -> StoreReader:
        """The opened store."""
        name = self.reader.name if self.reader else "NAME"
        command = f"magnet data prepare {name} --root DOWNLOAD --out STORE, then --data.path STORE"
        if not self.path:
            raise ValueError(f"{type(self).__name__}: no store was given; {command}")
        try:
            folder = StoreReader(self.path)
        except StoreError as error:
            raise StoreError(f"{error} ({type(self).__name__}: {command})") from error
        if self.reader and folder.manifest["name"] != self.reader.name:
            raise ValueError(
                f"{self.path} is a store of {folder.manifest['title']}, not of {self.reader.title}; choose the data "
                f"set's own class, or Prepared for any store"
            )
        wanted = folder.manifest["body"]
        if body_hash(self.body) != wanted["sha256"]:
            raise ValueError(
                f"{self.path} was prepared with body {wanted['id']!r} ({wanted['sha256'][:8]}), but body_model "
                f"{self.body_model!r} is {self.body.id!r} ({body_hash(self.body)[:8]}): give the same file with "
                f"--data.body_model FILE, or prepare again with this one"
            )
        folder.require_roles(self.roles)
        folder.body = self.body.id  # the same joints, whatever the file is called now
        return folder

    def prepare_data(self) -> None:
        """Check that the store exists and belongs to this body."""
        assert self.folder

    def clips(self, split: Split) -> list[Clip]:
        """All clips of a split in memory, of `self.body`."""
        return self.folder.clips(split, self.roles)

    def split_data(self, split: Split) -> StoreSplit | None:
        """The split's rows on disk."""
        part = self.folder.split(split, self.roles)
        return part if part.name else None

    def open_store(self, split: Split) -> MemoryStore:
        """The split by memory map; in memory if `device_resident`."""
        part = self.split_data(split)
        if part is None:
            has = [name for name, facts in self.folder.manifest["splits"].items() if facts["clips"]]
            raise EmptySplitError(
                f"{self.folder.path}: split {split} is empty, the store has {', '.join(has)}; prepare it with a list "
                f"of splits of your own (--splits FILE), or leave out what needs it"
            )
        if self.device_resident:
            return super().open_store(split)
        return MappedStore(part, self.max_agents, self.spread)
