"""Tokenizer: four frames of one person's pose to one vector of a codebook, and back (paper 3.1)."""

from magnet.tokenizer.codebook import Codebook, Quantised
from magnet.tokenizer.module import Tokenizer
from magnet.tokenizer.raw import RawPose

__all__ = ["Codebook", "Quantised", "RawPose", "Tokenizer"]
