"""ReMoCap's ready fits of made-up motion, which `magnet data fake` does not write."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from magnet.datamodules.fakes.motion import FakeMotion


def write_fitted_scenes(out: Path, scenes: Mapping[str, FakeMotion]) -> None:
    """Ready fits of any motions by take."""
    out.mkdir(parents=True, exist_ok=True)
    for name, shown in scenes.items():
        body = shown.poses[:, :, 1:].reshape(shown.frames, 2, 63).swapaxes(0, 1)
        np.savez(
            out / f"{int(name.rpartition('_')[2])}.npz",
            body_pose=np.concatenate([body, np.zeros((2, shown.frames, 90))], axis=2).astype(np.float32),
            orient=shown.poses[:, :, 0].swapaxes(0, 1).astype(np.float32),
            trans=shown.transl.swapaxes(0, 1).astype(np.float32),
            betas=np.repeat(shown.betas[:, None], shown.frames, axis=1).astype(np.float32),
        )
