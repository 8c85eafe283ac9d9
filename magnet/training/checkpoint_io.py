"""Lets Lightning read and write checkpoints as `magnet.checkpoints` does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO

from magnet import checkpoints


class CheckpointIO(TorchCheckpointIO):
    """Lets Lightning load released folders like its own checkpoints, and writes a checksum beside each checkpoint."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        # Elsewhere than on a disk; or for SLURM to start again with: Lightning counts files of such names.
        if storage_options is not None or "://" in str(path) or Path(path).name.startswith(checkpoints.REQUEUED):
            super().save_checkpoint(checkpoint, path, storage_options)
        else:
            checkpoints.save(checkpoint, Path(path))

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        return checkpoints.read(path)

    def remove_checkpoint(self, path: Any) -> None:
        super().remove_checkpoint(path)
        if "://" not in str(path):
            checkpoints.checksum_file(Path(path)).unlink(missing_ok=True)
