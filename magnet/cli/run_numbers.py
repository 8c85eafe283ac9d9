"""Numbers that a run's libraries take and then fail on with words of their own."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from magnet.cli.errors import CommandError
from magnet.cli.flags import valued

MOST_SEED = 2**32 - 1
"""What Lightning takes, for NumPy's seeds."""
MOST_DEVICES = 1024
LARGEST = 2**63 - 1
"""What torch takes for a whole number."""


def require_numbers(config: Any) -> None:
    """Refuse numbers of the Trainer's, in a command's parsed options, that it takes and then fails on."""
    seed, trainer = config.get("seed_everything"), config.get("trainer") or {}
    if isinstance(seed, int) and not isinstance(seed, bool) and not 0 <= seed <= MOST_SEED:
        raise CommandError(f"--seed_everything {seed}: expected 0 to {MOST_SEED}")
    together, devices = trainer.get("accumulate_grad_batches"), trainer.get("devices")
    if together is not None and together < 1:
        raise CommandError(f"--trainer.accumulate_grad_batches {together}: expected at least 1")
    if isinstance(devices, str) and re.fullmatch(r"-?\d+", devices):
        devices = int(devices)
    word = isinstance(devices, str) and devices != "auto" and re.fullmatch(r"\d+(,\d*)+", devices) is None
    if word or (isinstance(devices, int) and not -1 <= devices <= MOST_DEVICES):
        raise CommandError(
            f"--trainer.devices {devices}: expected 1 to {MOST_DEVICES:,}, a list such as [0,1], or auto"
        )


def too_large(arguments: Sequence[str]) -> str | None:
    """Names an option whose whole number is larger than any that torch takes; None where there is none."""
    for name, value in valued(arguments):
        if re.fullmatch(r"-?\d+", value) and abs(int(value)) > LARGEST:
            return f"{name} {value}: too large, expected at most {LARGEST}"
    return None
