"""Motion representation: scenes, rotations, frames of reference, tokens (paper 3.1)."""

from magnet.motion.scene import Scene, concatenate
from magnet.motion.tokens import STRIDE, TokenLayout

__all__ = ["STRIDE", "Scene", "TokenLayout", "concatenate"]
