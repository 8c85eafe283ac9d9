"""A small picture of noise levels: token time to the right, people downwards, paler where noisier."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnet.export.page.palette import agent_colours
from magnet.export.trace import DenoisingTrace
from magnet.sampling.noise import LEVELS

CELL = 14


def level_image(recording: DenoisingTrace, step: int) -> NDArray[np.uint8]:
    """Levels after a step: full colour is clean, white pure noise; the window is framed. -> (H, W, 3)"""
    levels = recording.levels[step].numpy().astype(float) / LEVELS  # (N, P)
    N, P = levels.shape
    noise = levels.T[..., None]  # (P, N, 1)
    cells = (1 - noise) * agent_colours(tuple(range(P)))[:, None] + noise * 255.0
    image = np.kron(cells, np.ones((CELL, CELL, 1)))
    image[::CELL], image[:, ::CELL] = 214, 214
    first = int(recording.start[step]) // 4
    last = min(first + recording.estimates.frames // 4, N)
    image[:2, first * CELL : last * CELL] = image[-2:, first * CELL : last * CELL] = 60
    image[:, first * CELL : first * CELL + 2] = image[:, last * CELL - 2 : last * CELL] = 60
    return image.round().astype(np.uint8)
