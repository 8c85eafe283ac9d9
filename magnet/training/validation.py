"""What a validation logs: means over a whole data set, whoever shares a batch or a process."""

from __future__ import annotations

from collections.abc import Mapping

from lightning.pytorch import LightningModule
from torch import Tensor

from magnet.motion.scene import Scene


def frames_of_people(scene: Scene) -> int:
    """How many frames of people count, who are present and whose frames are valid."""
    valid = scene.frames if scene.valid is None else scene.valid.sum(dim=1)
    return int((scene.present.sum(dim=1) * valid).sum())


def of_one_size(scene: Scene) -> list[list[int]]:
    """Which of the B scenes have as many people as each other, fewest first."""
    people = scene.present.sum(dim=1).tolist()
    return [[b for b, count in enumerate(people) if count == size] for size in sorted(set(people))]


def places_of(module: LightningModule, batch: Scene, validated: int) -> list[int]:
    """Which scenes of all that are validated a batch's are, whoever shares a batch or a process.

    validated: scenes of this process before it
    """
    return [(validated + b) * module.trainer.world_size + module.global_rank for b in range(batch.scenes)]


def log_means(module: LightningModule, losses: Mapping[str, Tensor], batch: Scene) -> None:
    """Log a batch's losses, which are means over the frames of people that count, for means over all batches."""
    # Lightning averages weights over processes in whole numbers, and what is left over is lost: here nothing is.
    weight = frames_of_people(batch) * module.trainer.world_size
    module.log_dict(dict(losses), batch_size=weight, sync_dist=True)
