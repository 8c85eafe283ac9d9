"""Options of the denoiser, in groups; each is a group of flags, such as `--model.network.width`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from magnet.checks import require_choice, require_number, require_whole
from magnet.motion.placement import Placement
from magnet.sampling.options import SamplerOptions, Settling

Rope = Literal["hidden", "heads", "none"]
Distribution = Literal["per_token", "per_timestep", "per_sequence", "mixture"]
PairwiseNoise = Literal["noisier_end", "token"]
Weighting = Literal["uniform", "min_snr"]


@dataclass(frozen=True)
class TransformerOptions:
    """Size and parts of the network, paper Table A.2.

    Args:
        width: hidden size d.
        layers: transformer blocks.
        heads: attention heads.
        mlp_ratio: MLP size over d.
        dropout: in attention and MLPs; not in the paper.
        level_width: size of the level embedding.
        agent_width: size of the agent embedding.
        slot_width: size of the level embedding of each partner slot (ours).
        rope: where time enters: `hidden` adds the embedded token to itself rotated, once (paper Table A.2), `heads`
            rotates queries and keys, `none` leaves time out (ablation, paper Table A.5).
        agent_embedding: false takes the agents' identities away (ablation, paper Table A.5).
        pairwise: false takes pairwise transforms out of the tokens (ablation, paper Table 5).
        causal_block: token steps of a block of attention; a token sees blocks up to its own (ours). 0: it sees
            everything, as in the paper.
        pairwise_posterior: pairwise transforms are their posterior, given what is shown and the deltas (ours), see
            `PairwisePosterior`.
        skip: the network tells only what noise hides (ours), see `skipped`.
        cond_dim: numbers C of a condition, such as a text's embedding (ours); 0: there is none.
        cond_dropout: share of training scenes whose condition is hidden, for classifier-free guidance (Ho and Salimans
            2022).
    """

    width: int = 512
    layers: int = 6
    heads: int = 8
    mlp_ratio: int = 4
    dropout: float = 0.05
    level_width: int = 256
    agent_width: int = 256
    slot_width: int = 32
    rope: Rope = "hidden"
    agent_embedding: bool = True
    pairwise: bool = True
    causal_block: int = 0
    pairwise_posterior: bool = False
    skip: bool = False
    cond_dim: int = 0
    cond_dropout: float = 0.1

    def __post_init__(self) -> None:
        for name in ("width", "layers", "heads", "mlp_ratio", "level_width", "agent_width", "slot_width"):
            require_whole(name, getattr(self, name), 1)
        for name in ("level_width", "slot_width"):
            if getattr(self, name) % 2:
                raise ValueError(
                    f"{name}: got {getattr(self, name)}, expected an even number, as sines and cosines are"
                )
        for name in ("causal_block", "cond_dim"):
            require_whole(name, getattr(self, name), 0)
        for name in ("dropout", "cond_dropout"):
            require_number(name, getattr(self, name), 0, 1)
        require_choice("rope", self.rope, Rope)


@dataclass(frozen=True)
class NoiseOptions:
    """Which noise levels are trained on.

    Args:
        distribution: how levels are drawn: `per_token` (paper 3.2), `per_timestep` (A.6.2, read as a choice when
            training), `per_sequence`, or `mixture` (ours: these and the patterns that sampling asks about).
        shift: over 1 draws high levels more often; see `magnet.sampling.noise.shifted`.
        pairwise: `noisier_end`: a pairwise transform is as noisy as the noisier of its two agents. `token`: one level a
            token as the paper reads literally, which leaks where unknown agents are.
        pairwise_metres: metres in a pairwise transform that count as one when tokens are normalized (ours): the
            smaller, the less noise hides where a partner is. 0: their standard deviation, as in the paper.
        faint_past: share of the roll-outs in `mixture` whose past is shown a little noisy, as samplers show what was
            made some seconds ago (ours); see `magnet.denoiser.levels.rollout_levels`.
        live: share of the roll-outs in `mixture` as tasks that go on live ask about: some agents' next tokens, the
            others' given so far or hidden (ours); see `magnet.denoiser.levels.live_levels`.
        from_nothing: share of the roll-outs in `mixture` without any past, of those in which everybody is generated
            (ours).
        to_end: share of the blocks at one level, in the roll-outs in `mixture`, that reach to the window's end, as
            samplers fill it; then who is given as far as the block is given throughout. Others end anywhere (ours).
        at_once: share of the scenes in `mixture` all of whose tokens are at one level, as scenes from nothing are
            sampled (ours).
    """

    distribution: Distribution = "per_token"
    shift: float = 1.0
    pairwise: PairwiseNoise = "noisier_end"
    pairwise_metres: float = 0.0
    faint_past: float = 0.0
    live: float = 0.0
    from_nothing: float = 0.2
    to_end: float = 0.0
    at_once: float = 0.05

    def __post_init__(self) -> None:
        require_choice("distribution", self.distribution, Distribution)
        require_number("shift", self.shift, over=0)
        require_choice("pairwise", self.pairwise, PairwiseNoise)
        require_number("pairwise_metres", self.pairwise_metres, least=0)
        for name in ("faint_past", "live", "from_nothing", "to_end", "at_once"):
            require_number(name, getattr(self, name), 0, 1)


@dataclass(frozen=True)
class DenoiserLoss:
    """Weights of the terms of the loss, and what each error counts. The paper gives no numbers for its lambdas.

    Args:
        latent: lambda_0 of paper Eq. 10.
        delta: lambda_1 of paper Eq. 10, on the canonical deltas from frame to frame.
        pairwise: lambda_2 of paper Eq. 10.
        huber: normalized error of these three above which it counts by its length, not by its square. The lower, the
            less those count who are fast where noise hides whether anybody is, and the calmer people become.
        consistency: lambda_3 of paper Eq. 10, for rotation and translation alike.
        consistency_warmup: training steps over which lambda_3 grows from 0.
        near: error of pairwise transforms in which centimetres near a partner count (ours).
        shake: error of how deltas change from frame to frame (ours).
        unfused: weight of the terms delta, pairwise and near on the network's own deltas and pairwise transforms, where
            `network.pairwise_posterior` replaces them (ours).
        joint: distance of the decoded joints, in metres (ours); see `magnet.denoiser.body_losses`.
        velocity: error of the decoded joints' velocities, in m/s (ours).
        partner: distance of the partners' decoded joints, as each sees them, in metres (ours).
        hands: error of the vectors between people's wrists within reach, in metres (ours).
        decoded_share: share of a batch's scenes, the least noisy, that are decoded for these four.
        weighting: how much a token's error counts by its noise: `uniform`, as in the paper, or `min_snr`; see
            `magnet.denoiser.losses.snr_weights`.
        snr_gamma: gamma of `min_snr`, the most that an error counts.
    """

    latent: float = 1.0
    delta: float = 1.0
    pairwise: float = 1.0
    huber: float = 1.0
    consistency: float = 0.1
    consistency_warmup: int = 1000
    near: float = 0.0
    shake: float = 0.0
    unfused: float = 0.5
    joint: float = 0.0
    velocity: float = 0.0
    partner: float = 0.0
    hands: float = 0.0
    decoded_share: float = 0.25
    weighting: Weighting = "uniform"
    snr_gamma: float = 5.0

    def __post_init__(self) -> None:
        require_whole("consistency_warmup", self.consistency_warmup, 0)
        require_number("decoded_share", self.decoded_share, 0, 1)
        require_number("huber", self.huber, over=0)
        require_choice("weighting", self.weighting, Weighting)
        require_number("snr_gamma", self.snr_gamma, over=0)


@dataclass(frozen=True)
class SelfForcing:
    """Training on a past that the model has made itself (ours); see `magnet.denoiser.self_forcing`.

    How such a past is placed in the world is said here, and not taken from the sampler, so that tuning the sampler
    changes no training.

    Args:
        share: of training scenes with a past, how many show it as the model would make it. With independent levels
            hardly any has one.
        placement: how its deltas and pairwise transforms become world poses; see `magnet.motion.placement.place`.
        pairwise_weight: weight of a pairwise transform against a delta in the placement `fuse`.
        displaced: share of the training scenes in which people stand a little off at first and come back, as those must
            who have drifted while they were generated; see `displaced_at_first`.
        far: share of these in which they stand metres off, as couples who have left each other do.
    """

    share: float = 0.0
    placement: Placement = "fuse"
    pairwise_weight: float = 0.02
    displaced: float = 0.0
    far: float = 0.0

    def __post_init__(self) -> None:
        for name in ("share", "displaced", "far"):
            require_number(name, getattr(self, name), 0, 1)
        require_choice("placement", self.placement, Placement)
        require_number("pairwise_weight", self.pairwise_weight, least=0)


@dataclass(frozen=True)
class Sampling:
    """How a trained model is best sampled: what a `SamplerOptions` leaves open (ours). None: as other models are.

    Args:
        stride: token steps finished before the window moves on.
        pyramid_offset: denoising steps from a token to the next; 0: the tokens of a stride are denoised together.
        turn: token steps of a turn, where agents take turns and their task leaves it open.
        opening: more denoising steps at the highest noise where nothing in a window is known.
        pairwise_weight: weight of a pairwise transform against a delta.
        settle: how poses are corrected.
        settle_groups: how those of three and more people from nothing are. None: as `settle`, with `firm` for `hold`.
        smooth_path: whether paths over the floor are smoothed.
        together: metres that couples stay within where scenes go on for long.
        noise_scale: standard deviation of the new noise in each denoising step.
        stabilization_level: noise level at which it is shown what it has made.
        stabilization_after: token steps after the last given one that are shown clean too.
        stabilization_beside: a higher such level for people beside somebody whose motion is given.
        stabilization_unseen: such a level in tasks whose agents act without seeing what others do next.
    """

    stride: int | None = None
    pyramid_offset: int | None = None
    turn: int | None = None
    opening: int | None = None
    pairwise_weight: float | None = None
    settle: Settling | None = None
    settle_groups: Settling | None = None
    smooth_path: bool | None = None
    together: float | None = None
    noise_scale: float | None = None
    stabilization_level: int | None = None
    stabilization_after: int = 0
    stabilization_beside: int | None = None
    stabilization_unseen: int | None = None

    def __post_init__(self) -> None:
        SamplerOptions().filled(self)  # which refuses what no sampler takes
        if self.settle_groups is not None:
            require_choice("settle_groups", self.settle_groups, Settling)
            if self.settle in (None, "off"):
                raise ValueError(f"settle_groups: got {self.settle_groups!r}, but nobody is corrected; give settle too")
