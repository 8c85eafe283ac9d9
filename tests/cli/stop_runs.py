"""Trainings of two processes that are told to end, for `test_interrupts`: `python -m tests.cli.stop_runs FOLDER`."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from magnet.tokenizer.module import Tokenizer
from tests.cli.scale_runs import ended, started

WORDS = ("--trainer.max_steps", "6", "--trainer.max_epochs", "1", "--trainer.val_check_interval", "3")
TOLD: dict[str, tuple[str, dict[int, list[tuple[int, int]]]]] = {
    "one": ("training_step", {1: [(1, signal.SIGINT)]}),
    "both": ("training_step", {0: [(1, signal.SIGINT)], 1: [(0, signal.SIGINT)]}),
    "passed on": ("training_step", {0: [(1, signal.SIGINT)] * 2, 1: [(1, signal.SIGINT)] * 2}),
    "before a validation": ("training_step", {1: [(2, signal.SIGINT)]}),
    "in a validation": ("validation_step", {0: [(0, signal.SIGINT)]}),
    "ended": ("training_step", {0: [(3, signal.SIGTERM)], 1: [(3, signal.SIGTERM)]}),
    "ended in a validation": ("validation_step", {1: [(0, signal.SIGTERM)]}),
}
"""What is told: in which method, and for each process in which batches it gets which signal."""


def telling(method: str, when: dict[int, list[tuple[int, int]]]) -> Callable[[], None]:
    """Have a process get signals in a method of the tokenizer, once each."""
    plain = getattr(Tokenizer, method)
    left = {rank: list(each) for rank, each in when.items()}

    def step(self: Tokenizer, batch: Any, batch_idx: int) -> Any:
        mine = left.get(int(os.environ["RANK"]), [])
        while mine and mine[0][0] == batch_idx and not self.trainer.sanity_checking:
            os.kill(os.getpid(), mine.pop(0)[1])
        return plain(self, batch, batch_idx)

    setattr(Tokenizer, method, step)
    return lambda: setattr(Tokenizer, method, plain)


def main(folder: Path) -> None:
    """All runs; exit codes in codes.json."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    codes = {"whole": ended(started(2, folder / "whole", *WORDS))}
    for name, (method, when) in TOLD.items():
        back = telling(method, when)
        codes[name] = ended(started(2, folder / name, *WORDS), 60)
        back()
        shutil.copytree(folder / name, folder / f"{name}, on")
        codes[f"{name}, on"] = ended(started(2, folder / f"{name}, on", *WORDS, "--ckpt_path", "last"))
    (folder / "codes.json").write_text(json.dumps(codes))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
