"""Synthetic scenes: people with planted feet, coupled in ways known in closed form."""

from magnet.synthesis.generate import COUPLINGS, CoupledScene, synthesize
from magnet.synthesis.measures import coupling_error

__all__ = ["COUPLINGS", "CoupledScene", "coupling_error", "synthesize"]
