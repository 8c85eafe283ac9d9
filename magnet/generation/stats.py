"""How consistent sampled tokens are, and what they cost."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass
class SamplingStats:
    """How consistent sampled tokens are and what they cost; filled while sampling.

    `quantization_error`: distance of a sampled latent to its code, as a share of the code's length.
    `pairwise_drift`: metres between a sampled pairwise transform and what the placed agents imply.
    `calls`: how often the network ran, a batch at a time. `evaluations`: how often it ran for each scene, views and
    guidance branches counted one by one.
    """

    quantization_error_sum: float = 0.0
    quantization_errors: int = 0
    pairwise_drift_sum: float = 0.0
    pairwise_drifts: int = 0
    runs: int = 0
    calls: int = 0
    scenes: int = 0
    windows: int = 0  # that went through the network

    @property
    def evaluations(self) -> float:
        return self.windows / max(self.scenes, 1)

    def means(self) -> dict[str, float]:
        """Means over all that was added; `calls` is the mean of a run of the sampler."""
        return {
            "quantization_error": self.quantization_error_sum / max(self.quantization_errors, 1),
            "pairwise_drift": self.pairwise_drift_sum / max(self.pairwise_drifts, 1),
            "calls": self.calls / max(self.runs, 1),
            "evaluations": self.evaluations,
        }

    def begin(self, scenes: int) -> None:
        """A run of the sampler starts."""
        self.runs += 1
        self.scenes += scenes

    def add_call(self, windows: int) -> None:
        """The network runs on so many windows."""
        self.calls += 1
        self.windows += windows

    def add_quantization_error(self, latent: Tensor, code: Tensor, counts: Tensor) -> None:
        """latent, code (B, n, P, C), counts (B, n, P) bool"""
        away = ((latent - code).norm(dim=-1) / code.norm(dim=-1).clamp_min(1e-6))[counts]
        self.quantization_error_sum += float(away.sum())
        self.quantization_errors += len(away)

    def add_pairwise_drift(self, pairs: Tensor, implied: Tensor, counts: Tensor) -> None:
        """pairs, implied (B, n, P, slots, 4, 9), counts (B, n, P, slots) bool"""
        away = (pairs - implied)[..., 6:].norm(dim=-1).mean(dim=-1)[counts]
        self.pairwise_drift_sum += float(away.sum())
        self.pairwise_drifts += len(away)
