"""How long a training will take, told when its first steps have shown it."""

from __future__ import annotations

import math
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Timer

from magnet.training.step_rate import WARM_UP, now

MEASURED = 5
"""Steps that are measured, after those that warm up."""


class Duration(Callback):
    """Prints, after the first eight steps, how long the rest will take here, and how to make it shorter."""

    def __init__(self) -> None:
        self.seen, self.step = 0, -1
        self.begun = 0.0

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if trainer.global_step == self.step:  # of a step's several batches (accumulate_grad_batches) the first counts
            return
        self.step = trainer.global_step
        if self.seen in (WARM_UP, WARM_UP + MEASURED):
            if self.seen > WARM_UP:  # from start to start: waiting for data counts, too
                seconds = (now(pl_module.device) - self.begun) / MEASURED
                if trainer.is_global_zero:
                    steps = min(steps_left(trainer), seconds_left(trainer) / seconds)
                    print(announced(seconds, steps, where(pl_module.device)), flush=True)
            self.begun = now(pl_module.device)
        self.seen += 1


def steps_left(trainer: Trainer) -> float:
    """Steps until training ends by itself; infinite where nothing ends it."""
    limits = [float(trainer.estimated_stepping_batches)]
    if trainer.max_steps >= 0:
        limits.append(float(trainer.max_steps))
    return max(min(limits) - trainer.global_step, 0.0)


def seconds_left(trainer: Trainer) -> float:
    """Seconds until `max_time` ends a training; infinite where none was given."""
    left = [left for _, left in times(trainer)]
    return max(min(left, default=math.inf), 0.0)


def share_of_time(trainer: Trainer) -> float:
    """The share of `max_time` that is over, of what was resumed as well; 0 where none was given.

    All processes hear that of the first one, whose clocks differ: it must be asked for by all of them.
    """
    clocks = times(trainer)
    share = max((over / max(over + left, 1e-9) for over, left in clocks), default=0.0)
    return trainer.strategy.broadcast(share) if clocks and trainer.world_size > 1 else share


def times(trainer: Trainer) -> list[tuple[float, float]]:
    """Seconds that are over and left for each limit of time."""
    timers = [each for each in trainer.callbacks if isinstance(each, Timer)]  # type: ignore[attr-defined]
    both = [(each.time_elapsed(), each.time_remaining()) for each in timers]
    return [(over, left) for over, left in both if left is not None]


def announced(seconds: float, steps: float, place: str) -> str:
    """The line: a step takes so long, all of them so long."""
    each = f"{seconds:.2f} s" if seconds >= 0.1 else f"{1000 * seconds:.0f} ms"
    if math.isinf(steps):
        return f"a step takes {each} on {place}; nothing ends this training: say --trainer.max_steps N"
    all_of_it = told(seconds * steps)
    return (
        f"about {all_of_it} for {steps:,.0f} steps of {each} on {place}; --trainer.max_steps N makes it shorter, "
        "Ctrl+C stops it, --ckpt_path last goes on"
    )


def told(seconds: float) -> str:
    """A length of time as one says it."""
    for limit, unit, name in ((90, 1, "seconds"), (90 * 60, 60, "minutes"), (48 * 3600, 3600, "hours")):
        if seconds < limit:
            exact = unit > 1 and seconds / unit < 10
            return f"{seconds / unit:.{int(exact)}f} {name}"
    return f"{seconds / 86400:.1f} days"


def where(device: torch.device) -> str:
    """What a training runs on."""
    threads = torch.get_num_threads()
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"{threads} CPU thread{'s' * (threads > 1)}"
