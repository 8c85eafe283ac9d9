"""Tokenizer: four frames of one person's pose to one vector of a codebook, and back (paper 3.1)."""

from magnet.tokenizer.module import Tokenizer
from magnet.tokenizer.quantizer import Quantized, ResidualVQ
from magnet.tokenizer.raw import RawPose

__all__ = ["Quantized", "RawPose", "ResidualVQ", "Tokenizer"]
