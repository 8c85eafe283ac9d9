"""What is written of a run beside what it makes: its configuration, where it came from, a link to the latest."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from magnet.cli.checkpoint_config import CONFIG_KEY
from magnet.cli.provenance import provenance
from magnet.cli.run_folder import LATEST
from magnet.datamodules.store.reader import StoreError, StoreReader
from magnet.files import require_place, write_text
from magnet.training import origins
from magnet.version import __version__


def seeds(options: dict[str, Any]) -> dict[str, Any]:
    """What a run's randomness follows from, for its record: the main seed, and every one by the option that sets it.

    Samples follow from `seed`, where a command has it (`request.seed_of_samples`), batches from `data.seed`, noise in
    training from `model.seed`.
    """
    found = {name: options.get(name) for name in ("seed", "seed_everything")}
    for part in ("model", "data"):
        found[f"{part}.seed"] = ((options.get(part) or {}).get("init_args") or {}).get("seed")
    known = {name: seed for name, seed in found.items() if seed is not None}
    return {"seed": known.get("seed", known.get("seed_everything")), "seeds": known}


def with_stores(data: Any) -> Any:
    """The same data configurations; to each prepared store of a data set is added its name, as `store`.

    The path of a store says nothing of what it holds, and what the recordings ask for goes with the weights.
    """
    if isinstance(data, list):
        return [with_stores(each) for each in data]
    if not isinstance(data, dict):
        return data
    whole = {key: with_stores(value) for key, value in data.items()}
    said = data.get("init_args") if "class_path" in data else None
    place = (said.get("path") or said.get("root")) if isinstance(said, dict) else None
    try:
        name = StoreReader(place).manifest.get("name") if isinstance(place, str) else None
    except StoreError:  # a folder of recordings, or one that is gone
        name = None
    return whole if name is None else whole | {"store": name}


class Record(Callback):
    """Writes the configuration and where the run came from, and puts the options into every checkpoint.

    Args:
        folder: of the run.
        config: the whole configuration as YAML.
        options: {"model": ..., "data": ...} in plain values, for checkpoints.
        facts: what else run.json says.
        latest: keep a link `latest` beside the folder that leads to it once there is a checkpoint, or, where nothing
            is trained, once all is measured or sampled.
        goes_on: in the folder of the training that it goes on with, whose record is kept under another name.
        command: of the run.
    """

    def __init__(
        self,
        folder: Path,
        config: str,
        options: dict[str, Any],
        facts: dict[str, Any],
        latest: bool = False,
        goes_on: bool = False,
        command: str = "fit",
    ) -> None:
        self.folder, self.config, self.options, self.facts, self.latest = folder, config, options, facts, latest
        self.goes_on, self.command, self.begun = goes_on, command, False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Take the first process's folder: each names one by its own clock."""
        self.folder = Path(trainer.strategy.broadcast(str(self.folder)))
        if trainer.is_global_zero and not getattr(trainer, "fast_dev_run", False):
            require_place(self.folder / "run.json")  # before anything is sampled

    def _begin(self, trainer: Trainer, pl_module: LightningModule, *_: Any, **__: Any) -> None:
        """Write, once data, model and task have turned out to fit: a run that never began leaves nothing behind."""
        if self.begun or not trainer.is_global_zero or getattr(trainer, "fast_dev_run", False):
            return
        self.begun = True
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.goes_on:
            before = len(list(self.folder.glob("run-[0-9]*.json"))) + 1
            for name, suffix in (("config", "yaml"), ("run", "json")):
                if (self.folder / f"{name}.{suffix}").is_file():
                    (self.folder / f"{name}.{suffix}").replace(self.folder / f"{name}-{before}.{suffix}")
        # What is measured in a training's folder is recorded beside the training, which goes on as it was.
        own = f"-{self.command}" if self.command != "fit" and (self.folder / "checkpoints").is_dir() else ""
        write_text(self.folder / f"config{own}.yaml", self.config)
        write_text(self.folder / f"run{own}.json", json.dumps(provenance() | self.facts, indent=2) + "\n")

    on_validation_batch_end = on_test_batch_end = on_predict_batch_end = _begin

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._begin(trainer, pl_module)
        origins.saw(getattr(pl_module, "origin", None), with_stores(self.options.get("data")))

    def _end(self, *_: Any, **__: Any) -> None:
        link = self.folder.with_name(LATEST)
        if self.begun and self.latest and self.command != "fit" and not (link / "checkpoints").is_dir():
            point(link, self.folder)  # but a training's of the same configuration stays

    on_validation_end = on_test_end = on_predict_end = _end

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        checkpoint[CONFIG_KEY] = self.options
        checkpoint["magnet_version"] = __version__
        if trainer.is_global_zero and self.latest:
            point(self.folder.with_name(LATEST), self.folder)


UNLINKED: set[Path] = set()
"""Links that the file system did not take."""


def point(link: Path, folder: Path) -> None:
    """Make `link` a symbolic link to `folder` beside it; say so where the file system allows none."""
    if link.exists() and not link.is_symlink():
        return  # somebody's own folder
    part = link.with_name(f".{link.name}.part")
    try:
        part.unlink(missing_ok=True)
        part.symlink_to(folder.name, target_is_directory=True)
        part.replace(link)
    except OSError as error:
        if link not in UNLINKED:  # once, and not at every checkpoint
            print(f"magnet: no link {link}: {error}", file=sys.stderr)
        UNLINKED.add(link)
