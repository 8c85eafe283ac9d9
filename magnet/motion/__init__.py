"""Motion representation: scenes, rotations, frames of reference, tokens (paper 3.1)."""

from magnet.motion.scene import Scene, concatenate
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout

__all__ = ["TOKEN_FRAMES", "Scene", "TokenLayout", "concatenate"]
