"""Runs the cells that are missing, one after another; what is done stays done."""

from __future__ import annotations

import shutil
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from magnet.files import CannotWrite
from magnet.report import measure
from magnet.report.cells import Cell, Store
from magnet.report.plan import extended
from magnet.shared import sharing

GUESSED = {"train": 600.0, "measure": 45.0, "speed": 60.0, "long": 60.0}
"""Seconds of a cell where none of its kind is done: two cores, small budget."""

BAR = 24
CHECKPOINTED = 100
"""Training steps after which a training that is stopped can go on, where the budget says how large a batch is."""

Fit = Callable[[list[str]], int]
"""`magnet fit` with these arguments. -> its exit code"""


@dataclass
class Runner:
    """What it takes to run cells.

    Args:
        store: of what is done.
        fit: trains.
        configs: folder of configurations to train.
        shipped: checkpoint that speeds are compared with.
        rounds: of a speed.
        code: commit of the code that runs them; empty where there is none.
        data: file of data options that trainings see in place of their own; None: their own.
        say: is told each line of progress.
    """

    store: Store
    fit: Fit
    configs: Path
    shipped: str
    rounds: int = 3
    code: str = ""
    data: Path | None = None
    say: Callable[[str], None] = print
    failed: dict[Cell, str] = field(default_factory=dict)

    def missing(self, cells: Sequence[Cell]) -> list[Cell]:
        """Those that are not done, and trainings that are, where their weights are wanted and lie elsewhere."""
        wanted = {cell for cell in cells if self.store.get(cell) is None}
        trainings = {cell.needs for cell in wanted if cell.needs is not None}
        wanted |= {training for training in trainings if not self._checkpoint(training).is_file()}
        return [cell for cell in cells if cell in wanted]

    def _checkpoint(self, training: Cell) -> Path:
        """Where the weights of a training lie once it is done."""
        return self.store.folder / "trainings" / training.name / "checkpoints" / "last.ckpt"

    def seconds(self, cell: Cell) -> float:
        """How long a cell may take: as long as others of its kind did, here."""
        took = self.store.of_kind(cell.kind)
        return statistics.median(took) if took else GUESSED[cell.kind]

    def times(self, cells: Sequence[Cell]) -> list[float]:
        """How long each of some cells may take, in seconds; what is done is read once for each kind."""
        took = {kind: self.seconds(cell) for kind, cell in {cell.kind: cell for cell in cells}.items()}
        return [took[cell.kind] for cell in cells]

    def run(self, cells: Sequence[Cell]) -> None:
        """Run what is missing, in order. What cannot be done is in `failed` then, with the reason."""
        with sharing():  # trainings of a seed see the same batches
            self._run_all(self.missing(cells))

    def _run_all(self, todo: Sequence[Cell]) -> None:
        for number, cell in enumerate(todo):
            left = sum(self.times(todo[number:]))
            full = BAR * number // max(len(todo), 1)
            bar = "#" * full + "." * (BAR - full)
            self.say(f"[{bar}] {number + 1}/{len(todo)} {cell.name}, about {clock(left)} left")
            if cell.needs in self.failed:
                self.failed[cell] = self.failed[cell.needs]
                continue
            try:
                self._run(cell)
            except CannotWrite:  # nor could what others give
                raise
            except (ValueError, OSError, ImportError, RuntimeError) as error:
                self.failed[cell] = " ".join(str(error).split())
                self.say(f"  not done: {self.failed[cell]}")

    def _run(self, cell: Cell) -> None:
        began, worked = time.perf_counter(), time.process_time()
        if cell.kind == "train":
            result = {"rows": {}, "checkpoint": str(self._train(cell).relative_to(self.store.folder))}
        else:
            where = (self._weights(cell), self.shipped, self.rounds, self.store.film(cell))
            result = dict(measure.run(cell, *where))
        took = {"seconds": time.perf_counter() - began, "processor_seconds": time.process_time() - worked}
        self.store.put(cell, {**result, **{name: round(each, 1) for name, each in took.items()}, "code": self.code})

    def _weights(self, cell: Cell) -> str | None:
        if cell.model is None:
            return None
        if cell.needs is None:
            return cell.model.checkpoint
        trained = self.store.get(cell.needs)
        if trained is None:
            raise ValueError(f"{cell.needs.name}: is not trained")
        return str(self.store.folder / trained["checkpoint"])

    def _train(self, cell: Cell) -> Path:
        """Train, or go on from the last checkpoint. Returns the one at the end."""
        assert cell.model is not None and cell.model.config is not None
        config = self.configs / f"{cell.model.config}.yaml"
        if not config.is_file():
            raise FileNotFoundError(f"{config}: no such configuration to train")
        last = self._checkpoint(cell)
        folder = last.parents[1]
        words = ["--config", str(config)]
        words += ["--config", str(self.data), *own_window(config)] if self.data is not None else []
        words += ["--out", str(folder), "--seed_everything", str(cell.seed)]
        words += ["--model.seed", str(cell.seed), "--data.seed", str(cell.seed)]
        words += ["--trainer.max_steps", str(cell.model.steps)] if cell.model.steps is not None else []
        if (batch := cell.model.batch) is not None:
            words += ["--data.batch_size", str(batch), "--data.epoch_size", str(batch * CHECKPOINTED)]
        if last.is_file():
            words += ["--ckpt_path", str(last)]
        elif folder.exists():
            shutil.rmtree(folder)  # stopped before there was anything to go on from
        code = self.fit(words)
        if code == 130:
            raise KeyboardInterrupt
        if code or not last.is_file():
            raise ValueError(f"{config.name}: the training ended with code {code}; its messages say why")
        return last


def own_window(config: Path) -> list[str]:
    """Flags for the window that a training asks for itself, whatever other data it is given."""
    frames = asked_window(config)[1]
    return [] if frames is None else ["--data.window_frames", str(frames)]


def asked_window(config: Path) -> tuple[bool, int | None]:
    """Whether a configuration names a model, with all that it extends, and the window that it asks for.

    Files of data alone that it extends ask for none: other data take their place.
    """
    said = yaml.safe_load(config.read_text(encoding="utf-8")) or {}
    below = [asked_window(file) for file in extended(config, said)]
    data = said.get("data")
    options = data.get("init_args") if isinstance(data, dict) else None  # a bare word names a class
    own = options.get("window_frames") if isinstance(options, dict) else None
    asked = [frames for model, frames in [*below, (True, own)] if model and frames is not None]
    return "model" in said or any(model for model, _ in below), asked[-1] if asked else None


def clock(seconds: float) -> str:
    """Seconds as h:mm."""
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02} h" if minutes else "a minute"
