"""What predicted tokens mean for bodies: where joints are, how fast, and where the partner's are (ours)."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.body import Body
from magnet.body.joints import WRISTS
from magnet.denoiser.token_core import TokenModelCore
from magnet.motion.frames import partners, pose_features
from magnet.motion.scene import FPS, Scene
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout, by_frame, pairwise_by_frame
from magnet.sampling.noise import alpha_bar
from magnet.tokenizer.base import PoseTokenizer
from magnet.tokenizer.losses import length, masked_mean, matrices, moved, world_velocity
from magnet.waiting import may_look

BODY_LOSSES = ("joint", "velocity", "partner", "hands")

WITHIN_REACH = 0.4
"""Metres: only wrists that were recorded nearer to each other than this count in `hands`."""


def decoded_losses(
    model: TokenModelCore,
    body: Body,
    clean: Tensor,
    tokens: Tensor,
    levels: Tensor,
    scene: Scene,
    there: Tensor,
    share: float,
) -> dict[str, Tensor]:
    """`body_losses` on the least noisy scenes of a batch.

    Args:
        model: whose frozen tokenizer decodes.
        body: whose joints are compared, on the tokens' device.
        clean: (B, N, P, D) predicted tokens, normalized.
        tokens: (B, N, P, D) the true ones in real units.
        levels: (B, N, P) int.
        scene: the batch, of P agents.
        there: (B, N, P, 1 + slots) bool, as in `token_losses`.
        share: of the scenes, how many are decoded; at least one is.
    """
    signal = alpha_bar(levels)
    chosen = least_noisy(signal, there, max(1, round(share * len(clean))))
    few, kind = scene.select(chosen), clean.device.type
    half = kind, torch.get_autocast_dtype(kind), torch.is_autocast_enabled(kind)
    with torch.autocast(kind, enabled=False):
        predicted = model.normalizer.denormalize(clean[chosen])
        latent, deltas, _ = model.layout.unpack(predicted)
        real = pose_features(few)
        with torch.autocast(*half):  # only networks may run in half precision
            pose = decoded_people(model.tokenizer, latent, deltas, few, real)
        mine, true = (body.forward_kinematics(*matrices(each), few.betas[:, None]) for each in (pose, real))
        return body_losses(predicted, tokens[chosen], mine, true, signal[chosen], there[chosen], model.layout)


def decoded_people(tokenizer: PoseTokenizer, latent: Tensor, deltas: Tensor, scene: Scene, pose: Tensor) -> Tensor:
    """Poses (B, T, P, 135) with those of people who are there decoded; empty slots stay, and on a CPU cost nothing.

    latent (B, N, P, C), deltas (B, N, P, 4, 9)
    """
    people, seen = scene.present, may_look(pose.device)
    by_slot = (latent.transpose(1, 2), scene.betas, deltas.transpose(1, 2))
    by_person = [x[people] if seen else x.flatten(0, 1) for x in by_slot]
    made = tokenizer.decode(by_person[0][:, :, None], by_person[1][:, None], by_person[2][:, :, None])
    poses, made = pose.transpose(1, 2), made[:, :, 0].float()
    if seen:
        return poses.index_put((people,), made).transpose(1, 2)
    return torch.where(people[..., None, None], made.view_as(poses), poses).transpose(1, 2)


def least_noisy(signal: Tensor, there: Tensor, count: int) -> Tensor:
    """The scenes of a batch whose tokens are least noisy: only there a mean is close to a motion.

    signal (B, N, P) share of signal, there (B, N, P, G) bool -> (count,) int
    """
    counts = there[..., 0]
    mean = torch.where(counts, signal, 0.0).sum(dim=(1, 2)) / counts.sum(dim=(1, 2)).clamp_min(1)
    return mean.topk(min(count, len(mean))).indices


def body_losses(
    tokens: Tensor, truth: Tensor, mine: Tensor, real: Tensor, signal: Tensor, there: Tensor, layout: TokenLayout
) -> dict[str, Tensor]:
    """Errors of decoded bodies, each weighted by how little noise the tokens had.

    Args:
        tokens: (B, N, P, D) predicted, in real units; latents are not read.
        truth: the same of the recording.
        mine: (B, T, P, 22, 3) joints decoded from `tokens`, each person's in the own canonical frame, metres.
        real: the same of the recording.
        signal: (B, N, P) share of signal of the noisy tokens.
        there: (B, N, P, 1 + slots) bool, as in `token_losses`.
        layout: of the tokens.

    Returns:
        joint: distance of joints in one's own canonical frame, metres. velocity: error of the joints' velocities over
        the ground, m/s. partner: distance of the partners' joints as seen from one's own frame, metres. hands: error
        of the vectors from one's own wrists to a partner's that were recorded within reach, metres.
    """
    _, deltas, pairs = layout.unpack(tokens)
    _, true_deltas, true_pairs = layout.unpack(truth)
    weight = signal.repeat_interleave(TOKEN_FRAMES, dim=1)  # (B, T, P)
    counts = there.repeat_interleave(TOKEN_FRAMES, dim=1)
    own = counts[..., 0]
    losses = {"joint": masked_mean(weight * _mean_length(mine - real), own)}

    velocity = world_velocity(mine, by_frame(deltas)) - world_velocity(real, by_frame(true_deltas))
    both = own[:, 1:] & own[:, :-1]
    losses["velocity"] = masked_mean(weight[:, 1:] * _mean_length(FPS * velocity), both)
    if layout.slots:
        other = partners(layout.agents, tokens.device)
        seen = moved(pairwise_by_frame(pairs), mine[:, :, other])  # (B, T, P, P - 1, 22, 3)
        seen_real = moved(pairwise_by_frame(true_pairs), real[:, :, other])
        least = torch.minimum(weight[..., None], weight[:, :, other])
        losses["partner"] = masked_mean(least * _mean_length(seen - seen_real), counts[..., 1:])
        reach, real_reach = _between_wrists(mine, seen), _between_wrists(real, seen_real)
        near = counts[..., 1:, None, None] & (real_reach.norm(dim=-1) < WITHIN_REACH)
        losses["hands"] = masked_mean(least[..., None, None] * length(reach - real_reach), near)
    return losses


def _between_wrists(mine: Tensor, seen: Tensor) -> Tensor:
    """Vectors from each of one's own wrists to each of a partner's, from joints in one's own frame.

    mine (B, T, P, 22, 3), seen (B, T, P, P - 1, 22, 3) -> (B, T, P, P - 1, 2, 2, 3)
    """
    wrists = slice(WRISTS[0], WRISTS[1] + 1)  # a tuple would be sent to the device each time
    return seen[..., None, wrists, :] - mine[:, :, :, None, wrists, None, :]


def _mean_length(away: Tensor) -> Tensor:
    """Mean length over joints. (..., 22, 3) -> (...)"""
    return length(away).mean(-1)
