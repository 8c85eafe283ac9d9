"""Options of the tokenizer, in groups; each is a group of flags, such as `--model.quantizer.codebook_size`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from magnet.checks import require_choice, require_number, require_whole

QuantizerKind = Literal["residual_vq", "fsq"]


@dataclass(frozen=True)
class AutoencoderOptions:
    """Size of encoder and decoder.

    Args:
        width: channels of the convolutions, paper Table A.2.
        depth: residual blocks in each of the two stages; the paper does not say.
        causal: no token sees later frames (ours, for streaming).
        lookahead: tokens after its own that a causal decoder's frame sees, 0 or 1 (ours).
        embed_dim: numbers that narrow codes are projected from (ours); 0: none.
    """

    width: int = 512
    depth: int = 3
    causal: bool = False
    lookahead: int = 0
    embed_dim: int = 0

    def __post_init__(self) -> None:
        require_whole("width", self.width, 1)
        require_whole("depth", self.depth, 1)
        require_whole("lookahead", self.lookahead, 0, 1)
        require_whole("embed_dim", self.embed_dim, 0)
        if self.lookahead and not self.causal:
            raise ValueError(
                "lookahead: got 1 without causal, but a tokenizer that is not causal sees all frames; set causal, too"
            )


@dataclass(frozen=True)
class QuantizerOptions:
    """What makes codes of the encoder's output.

    Args:
        kind: `residual_vq`: codebooks that are learned, of which the paper has one. `fsq`: finite scalar quantization,
            which has no codebook to learn (ours): each number of a code is rounded to one of a few levels.
        codebook_size: codes in each codebook, paper Table A.2. Only of `residual_vq`, as all that follows up to levels.
        codebook_dim: numbers in a code, paper Table A.2.
        num_quantizers: codebooks in a row, each coding what is left over (ours); the paper has 1.
        ema_decay: of the moving averages that the codes follow.
        dead_code_threshold: codes chosen less often than this a batch start anew.
        continuous_steps: training steps before there are codes, half of all at most (ours).
        levels: of `fsq`, so many values each number of a code can have. The default makes 64,000 codes (Mentzer et al.
            2023, Table 1).
    """

    kind: QuantizerKind = "residual_vq"
    codebook_size: int = 1024
    codebook_dim: int = 512
    num_quantizers: int = 1
    ema_decay: float = 0.99
    dead_code_threshold: float = 1.0
    continuous_steps: int = 0
    levels: tuple[int, ...] = (8, 8, 8, 5, 5, 5)

    def __post_init__(self) -> None:
        require_choice("kind", self.kind, QuantizerKind)
        for name in ("codebook_size", "codebook_dim", "num_quantizers"):
            require_whole(name, getattr(self, name), 1)
        require_whole("continuous_steps", self.continuous_steps, 0)
        require_number("ema_decay", self.ema_decay, 0, 1)
        require_number("dead_code_threshold", self.dead_code_threshold, least=0)
        object.__setattr__(self, "levels", tuple(self.levels))  # lists come from files
        if not self.levels:
            raise ValueError("levels: got none, expected how many values each number of a code can have, such as [8,5]")
        for level in self.levels:
            require_whole("levels", level, 2)


@dataclass(frozen=True)
class TokenizerLoss:
    """Weights of the terms of the loss; see `magnet.tokenizer.losses.reconstruction_losses`.

    Args:
        joint_rotation: lambda_j of paper Eq. 4, on the mean angle of the 21 joints.
        root_rotation: lambda_r of paper Eq. 4, on the rotation of Eq. 5.
        root_translation: lambda_r of paper Eq. 4, on the translation of Eq. 5.
        commitment: pulls embeddings to their codes; the paper does not say.
        joint: distance of the decoded joints, in metres (ours).
        hand: distance of the middles of the hands, in metres (ours).
        velocity: error of the decoded joints' velocities, in m/s, against flicker (ours).
        foot_velocity: the same of ankles and toes alone, against sliding feet (ours).
        foot_contact: sliding of toes that stand in the recording, in m/s (ours).
    """

    joint_rotation: float = 1.0
    root_rotation: float = 0.5
    root_translation: float = 0.5
    commitment: float = 0.3
    joint: float = 0.0
    hand: float = 0.0
    velocity: float = 0.0
    foot_velocity: float = 0.0
    foot_contact: float = 0.0


@dataclass(frozen=True)
class AugmentOptions:
    """What is changed in training batches, so that a small data set is not learnt by heart (ours).

    Args:
        limb_swap_prob: share of limbs that move as somebody else's of the batch do.
        joint_noise: each joint is turned at random, alike in all frames; standard deviation, radians.
        root_noise: the deltas that the decoder is given are off by up to so many m/s, as sampled ones are; with the
            loss `foot_contact` the decoder learns to keep feet where they stand.
    """

    limb_swap_prob: float = 0.0
    joint_noise: float = 0.0
    root_noise: float = 0.0

    def __post_init__(self) -> None:
        require_number("limb_swap_prob", self.limb_swap_prob, 0, 1)
        require_number("joint_noise", self.joint_noise, least=0)
        require_number("root_noise", self.root_noise, least=0)
