"""The input of every metric: sampled futures and the recorded one."""

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
    scored: Tensor  # (B, T, P) bool: present, and this frame of this agent was generated
    units: Tensor | None = None  # (B,) int: clips that are not independent have the same; negative: its own

    @staticmethod
    def of(
        generated: Tensor, truth: Tensor, present: Tensor, agents: Tensor | None = None, units: Tensor | None = None
    ) -> Futures:
        """Check the input and cut both futures to the shorter one.

        Args:
            generated: (S, B, T, P, 22, 3) future joints of S samples a scene.
            truth: (B, T', P, 22, 3).
            present: (B, P) bool; an absent agent never counts, whatever its numbers.
            agents: bool, what was generated and is scored: (P,), (B, P), (T, P) or (B, T, P), where in the last
                form B and T may be 1; None: everything of everybody present. What is not scored was given, so
                `generated` is expected to repeat it there.
            units: (B,) int, which clips intervals take as one; None: each is its own.

        Raises:
            ValueError: no tensors, no sample, shapes that do not fit, B = T leave open what two axes of `agents`
                are, or a joint of a present agent is not finite.
        """
        for name, given in (("generated", generated), ("truth", truth), ("present", present), ("agents", agents)):
            if not isinstance(given, Tensor) and not (name == "agents" and given is None):
                raise ValueError(f"{name}: got {type(given).__name__}, expected a tensor; torch.as_tensor makes one")
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
        if units is not None and (units.shape != (B,) or units.is_floating_point()):
            raise ValueError(f"units: got {tuple(units.shape)} {units.dtype}, expected {(B,)} int")
        if not generated.shape[0]:
            raise ValueError("generated: got 0 samples, expected at least one")
        lengths = (generated.shape[2], truth.shape[1])
        frames = min(lengths)
        cut = Futures(
            generated=_of_those_present(generated[:, :, :frames], present),
            truth=_of_those_present(truth[:, :frames], present),
            present=present,
            scored=present[:, None] & _by_frame(agents, B, lengths, P).to(present.device),
            units=units,
        )
        _demand_finite("generated", cut.generated)
        _demand_finite("truth", cut.truth[None])
        return cut

    @property
    def frames(self) -> int:
        return self.truth.shape[1]

    @property
    def samples(self) -> int:
        return self.generated.shape[0]

    def spans(self, frames: int) -> Tensor:
        """Which differences over so many frames in a row count: those with a scored frame. (B, T - frames + 1, P)

        So a step between two given frames never counts, and the step at a seam does: it is the generated end
        that makes it.
        """
        if frames > self.frames:
            return self.scored[:, :0]
        return self.scored.unfold(1, frames, 1).any(dim=-1)

    def pairs(self) -> tuple[Tensor, Tensor, Tensor]:
        """Every two agents p < q, and where they count. (Q,), (Q,), (B, T, Q) bool

        A pair counts in the frames in which both are there and at least one is scored.
        """
        first, second = torch.triu_indices(self.truth.shape[2], self.truth.shape[2], offset=1, device=self.truth.device)
        both = self.present[:, first] & self.present[:, second]
        return first, second, both[:, None] & (self.scored[..., first] | self.scored[..., second])


def without_pelvis(joints: Tensor) -> Tensor:
    """The 21 joints that are measured. (..., 22, 3) -> (..., 21, 3)"""
    return joints[..., 1:, :]


def _by_frame(agents: Tensor | None, B: int, lengths: tuple[int, int], P: int) -> Tensor:
    """`agents` of `Futures.of` as (B or 1, T, P) bool, T the shorter of two lengths."""
    frames = min(lengths)
    if agents is None:
        return torch.ones(1, frames, P, dtype=torch.bool)
    shape = tuple(agents.shape)
    if agents.ndim == 2 and B in lengths and shape == (B, P):
        raise ValueError(
            f"agents: got {shape} for {B} scenes of {B} frames, which may mean either; "
            f"expected {(B, 1, P)} or {(1, B, P)}"
        )
    if shape == (P,):
        agents = agents[None, None]
    elif shape == (B, P):
        agents = agents[:, None]
    elif agents.ndim == 2:
        agents = agents[None]
    fits = agents.ndim == 3 and agents.shape[0] in (1, B) and agents.shape[1] in (1, *lengths) and agents.shape[2] == P
    if not fits or agents.dtype != torch.bool:
        raise ValueError(
            f"agents: got {shape} {agents.dtype}, expected {(P,)}, {(B, P)}, {(frames, P)} or {(B, frames, P)} bool"
        )
    if agents.shape[1] == 1:
        return agents.expand(-1, frames, -1)
    return agents[:, :frames]


def _of_those_present(joints: Tensor, present: Tensor) -> Tensor:
    """In float64, absent agents zeroed. joints (..., B, T, P, J, 3), present (B, P)"""
    if bool(present.all()):
        return joints.double()
    return torch.where(present[:, None, :, None, None], joints.double(), 0.0)


def _demand_finite(name: str, joints: Tensor) -> None:
    """(S, B, T, P, J, 3) float64"""
    if bool(joints.sum().isfinite()):  # one number tells of all, without a mask as large as the joints
        return
    finite = joints.isfinite().all(dim=0)
    if not bool(finite.all()):
        scene, frame, agent, joint, _ = (~finite).nonzero()[0].tolist()
        raise ValueError(
            f"{name}: joint {joint} of agent {agent}, frame {frame}, scene {scene} of the batch is not finite; "
            "mask such scenes out before measuring them"
        )
