"""Cells: the small jobs that tables are made of, and the files of those that are done."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from magnet.files import write_whole

Kind = Literal["train", "measure", "speed", "long"]
FORMAT = 1
PACKED = "cells.json"


@dataclass(frozen=True)
class Budget:
    """How much is spent on every cell alike.

    Args:
        scenes: test scenes at most.
        samples: futures of each.
        seeds: of sampling, or of training where something is trained.
        steps: of each training; None: as its configuration says.
        frames: of a long generation.
        speed_rounds: how often a speed is taken.
        batch: windows of a training step; None: as the configuration says.
        whole_benchmark: measure the open benchmark as its page asks, whatever the rest says.
        sampler: preset that models are sampled by.
    """

    scenes: int
    samples: int
    seeds: int
    steps: int | None
    frames: int
    speed_rounds: int
    batch: int | None = None
    whole_benchmark: bool = True
    sampler: str = "default"

    @property
    def told(self) -> str:
        """In words."""
        steps = "as configurations say" if self.steps is None else f"of {self.steps} steps"
        steps += "" if self.batch is None else f" of {self.batch} windows"
        words = [f"at most {self.scenes} test scenes", f"{self.samples} samples of each", f"{self.seeds} seeds"]
        words += [f"trainings {steps}", f"{self.frames} frames in a long generation"]
        return ", ".join(words if self.sampler == "default" else [*words, f"sampler {self.sampler}"])


BUDGETS = {
    "tiny": Budget(2, 2, 2, 2, 40, 1, whole_benchmark=False),
    "evening": Budget(8, 2, 3, 200, 300, 4, batch=8),
    "small": Budget(8, 5, 3, None, 300, 3),
    "paper": Budget(1_000_000, 10, 3, None, 1800, 5, sampler="paper"),
}
"""`tiny` is for tests, `evening` for half a core and four hours, `small` for two cores and a day, `paper` for a GPU
and the paper's own data."""


@dataclass(frozen=True)
class Weights:
    """Where weights come from: a checkpoint that is there, or a training of this report.

    Args:
        checkpoint: shipped name or path; None: `config` is trained.
        config: name of a configuration to train, without .yaml.
        steps: of its training; None: as the configuration says.
        batch: windows of each step; None: as the configuration says.
        digest: of the weights' file, or of the configuration with all that it extends.
    """

    checkpoint: str | None = None
    config: str | None = None
    steps: int | None = None
    batch: int | None = None
    digest: str = ""


@dataclass(frozen=True)
class Cell:
    """One job; equal cells are one.

    Args:
        kind: train a configuration; measure a task; take its speed; generate for long.
        seed: of everything.
        data: salsa, synthetic2 to synthetic4, or a file of data options.
        model: what is measured or trained; None: baselines and floors.
        task: name of the task.
        task_options: as `name=value`, sorted.
        sampler: options other than the default ones, as `name=value`, sorted; `preset` may be among them.
        leak: `pairs`: pairwise transforms are as clean as their token, the paper read literally.
        scenes: test scenes at most.
        samples: of each.
        frames: generated, of a long generation.
    """

    kind: Kind
    seed: int
    data: str = ""
    model: Weights | None = None
    task: str = ""
    task_options: tuple[tuple[str, Any], ...] = ()
    sampler: tuple[tuple[str, Any], ...] = ()
    leak: str = ""
    scenes: int = 0
    samples: int = 0
    frames: int = 0

    @property
    def needs(self) -> Cell | None:
        """The training whose weights are used."""
        if self.kind == "train" or self.model is None or self.model.config is None:
            return None
        return Cell("train", self.seed, model=self.model)

    @property
    def settings(self) -> dict[str, Any]:
        """All that the result depends on, JSON-ready."""
        return json.loads(json.dumps({"format": FORMAT, **asdict(self)}))

    @property
    def name(self) -> str:
        """Of its file: readable, and unlike that of any other cell."""
        of = "" if self.model is None else self.model.config or Path(str(self.model.checkpoint)).stem
        words = [self.kind, of or "floors", self.task, Path(self.data).stem, self.leak, f"seed{self.seed}"]
        digest = hashlib.sha256(json.dumps(self.settings, sort_keys=True).encode()).hexdigest()[:10]
        return re.sub(r"[^A-Za-z0-9_-]+", "_", "-".join(word for word in words if word)) + f"-{digest}"


@dataclass
class Store:
    """Results of cells in a folder, one JSON file each, whole or not there; those in its `cells.json` count, too.

    Args:
        folder: of the report.
    """

    folder: Path
    kept: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        packed = self.folder / PACKED
        if packed.is_file():
            self.kept |= json.loads(packed.read_text(encoding="utf-8"))

    def path(self, cell: Cell) -> Path:
        return self.folder / "cells" / f"{cell.name}.json"

    def film(self, cell: Cell) -> Path | None:
        """Where a scene of a measurement is kept for films: of the first seed alone."""
        shown = cell.kind == "measure" and cell.seed == 0
        return self.folder / "films" / f"{cell.name}.npz" if shown else None

    def get(self, cell: Cell) -> dict[str, Any] | None:
        """What a cell gave; None where it is not done, or was done by other settings."""
        path = self.path(cell)
        if cell.name not in self.kept and path.is_file():
            try:
                content = json.loads(path.read_text(encoding="utf-8"))
            except ValueError:
                return None  # not ours: what is ours is whole
            if content.get("settings") == cell.settings:
                self.kept[cell.name] = content
        found = self.kept.get(cell.name)
        return found if found and found.get("settings") == cell.settings else None

    def pack(self) -> None:
        """Write all that was asked for into one file, a line a cell, to seven digits: small enough to be passed on."""
        found = self.kept
        lines = [
            f"{json.dumps(name)}: {json.dumps(short(found[name]), separators=(',', ':'))}" for name in sorted(found)
        ]
        write_whole(self.folder, PACKED, ("{\n" + ",\n".join(lines) + "\n}\n").encode())

    def put(self, cell: Cell, result: Mapping[str, Any]) -> dict[str, Any]:
        """Keep what a cell gave: written aside, then renamed, so that a kill leaves all of it or nothing."""
        content = {"settings": cell.settings, **result}
        text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False)
        path = self.path(cell)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path.parent, path.name, text.encode())
        self.kept[cell.name] = json.loads(text)
        return self.kept[cell.name]

    def of_kind(self, kind: Kind) -> list[float]:
        """Seconds that finished cells of a kind took."""
        mine = {path.stem: path for path in sorted((self.folder / "cells").glob(f"{kind}-*.json"))}
        found = [content for name, content in self.kept.items() if name.startswith(kind) and name not in mine]
        for path in mine.values():
            with contextlib.suppress(ValueError):
                found.append(json.loads(path.read_text(encoding="utf-8")))
        return [float(content["seconds"]) for content in found if "seconds" in content]


def short(content: Any) -> Any:
    """The same with numbers of seven digits. content: JSON-ready"""
    if isinstance(content, dict):
        return {name: short(value) for name, value in content.items()}
    if isinstance(content, list):
        return [short(value) for value in content]
    return float(f"{content:.7g}") if isinstance(content, float) else content
