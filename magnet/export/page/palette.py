"""Colours of people: those of the pictures, nearer to the background where motion was given to the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magnet.export.drawing import AGENTS, TILES

PALENESS = 0.58
"""How far the colour of given motion lies towards white, or on a dark page towards `DUSK`."""
DUSK = (46, 51, 62)
"""Towards which colours are dim: not black, so that limbs are told from a dark floor."""

GHOST = (150, 156, 168)
STANDS = (20, 160, 110)
SLIDES = (235, 125, 20)
TOUCHES = (250, 200, 40)
COLLIDES = (225, 30, 45)
FLOOR = TILES[0]
LINES = TILES[1]

Colours = NDArray[np.uint8]


def agent_colours(slots: list[int] | tuple[int, ...]) -> Colours:
    """One colour a slot, as in the pictures. -> (P, 3)"""
    return np.array([AGENTS[slot % len(AGENTS)] for slot in slots], dtype=np.uint8)


def hexed(colour: Sequence[int] | Colours) -> str:
    """A colour as pages and SVG have it: #rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*(int(c) for c in colour))


def pale(colours: Colours, share: float = PALENESS) -> Colours:
    """Colours of given motion. (..., 3)"""
    return (colours + share * (255.0 - colours)).round().astype(np.uint8)


def dim(colours: Colours, share: float = PALENESS) -> Colours:
    """Colours of given motion on a dark page, where pale people would be what is seen first. (..., 3)"""
    return (colours + share * (np.array(DUSK) - colours.astype(float))).round().astype(np.uint8)


def for_batches(colours: Colours | NDArray[np.floating]) -> Colours:
    """Colours as viser 1.1 wants them for batches of meshes: it takes them for linear ones and shows them paler."""
    return (255 * (np.asarray(colours, dtype=float) / 255) ** 2.2).round().astype(np.uint8)
