"""What every metric is given: samples of the future beside the future that was recorded."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.motion.scene import BODY_JOINTS


@dataclass(frozen=True)
class Futures:
    """Generated and true joints over the same frames, in float64, absent agents zeroed."""

    generated: Tensor  # (S, B, T, P, 22, 3) metres, world
    truth: Tensor  # (B, T, P, 22, 3)
    present: Tensor  # (B, P) bool
    scored: Tensor  # (B, P) bool: present, and asked about

    @staticmethod
    def of(generated: Tensor, truth: Tensor, present: Tensor, agents: Tensor | None = None) -> Futures:
        """Checks what came and cuts both to the shorter one.

        Args:
            generated: (S, B, T, P, 22, 3) future joints of S samples a scene.
            truth: (B, T', P, 22, 3).
            present: (B, P) bool; an absent agent never counts, whatever its numbers.
            agents: (P,) or (B, P) bool, who is scored (partner tasks); None: everybody present.

        Raises:
            ValueError: shapes do not fit, or a joint of a present agent is not finite.
        """
        if generated.ndim != 6 or truth.ndim != 5 or generated.shape[-2:] != (BODY_JOINTS, 3):
            raise ValueError(
                f"got generated {tuple(generated.shape)} and truth {tuple(truth.shape)}, "
                f"expected (S, B, T, P, {BODY_JOINTS}, 3) and (B, T, P, {BODY_JOINTS}, 3)"
            )
        B, P = truth.shape[0], truth.shape[2]
        if generated.shape[1] != B or generated.shape[3:] != truth.shape[2:]:
            raise ValueError(
                f"got generated {tuple(generated.shape)} for truth {tuple(truth.shape)}, "
                f"expected {B} scenes of {P} agents in both; repeats of a scene belong to the axis of samples"
            )
        if present.shape != (B, P) or present.dtype != torch.bool:
            raise ValueError(f"present: got {tuple(present.shape)} {present.dtype}, expected {(B, P)} bool")
        if agents is not None and (agents.dtype != torch.bool or agents.shape not in ((P,), (B, P))):
            raise ValueError(f"agents: got {tuple(agents.shape)} {agents.dtype}, expected {(P,)} or {(B, P)} bool")
        frames = min(generated.shape[2], truth.shape[1])
        there = present[:, None, :, None, None]
        cut = Futures(
            generated=torch.where(there, generated[:, :, :frames].double(), 0.0),
            truth=torch.where(there, truth[:, :frames].double(), 0.0),
            present=present,
            scored=present if agents is None else present & agents.to(present.device),
        )
        _demand_finite("generated", cut.generated.isfinite().all(dim=0))
        _demand_finite("truth", cut.truth.isfinite())
        return cut

    @property
    def frames(self) -> int:
        return self.truth.shape[1]

    @property
    def samples(self) -> int:
        return self.generated.shape[0]

    def pairs(self) -> tuple[Tensor, Tensor, Tensor]:
        """Every two agents p < q, and where they count: both there, at least one scored. (Q,), (Q,), (B, Q) bool"""
        first, second = torch.triu_indices(self.truth.shape[2], self.truth.shape[2], offset=1, device=self.truth.device)
        both = self.present[:, first] & self.present[:, second]
        return first, second, both & (self.scored[:, first] | self.scored[:, second])


def without_pelvis(joints: Tensor) -> Tensor:
    """The 21 joints that are measured. (..., 22, 3) -> (..., 21, 3)"""
    return joints[..., 1:, :]


def _demand_finite(name: str, finite: Tensor) -> None:
    """(B, T, P, J, 3) bool"""
    if not bool(finite.all()):
        scene, frame, agent, joint, _ = (~finite).nonzero()[0].tolist()
        raise ValueError(
            f"{name}: joint {joint} of agent {agent}, frame {frame}, scene {scene} of the batch is not finite; "
            "mask such scenes out before measuring them"
        )
