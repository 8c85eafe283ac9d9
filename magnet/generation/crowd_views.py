"""What the network is shown of a crowd: the tokens of each view of neighbours, and what is read from its answer."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.motion.frames import from_9d, inverse, partners, to_9d
from magnet.motion.neighbours import CrowdViews
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.noise import LEVELS, add_noise, alpha_bar

PAIR = 9 * TOKEN_FRAMES
"""Numbers of a token about one partner."""


@dataclass(frozen=True)
class Window:
    """What is known of a crowd in the W token steps that the network is asked about.

    Attributes:
        views: the groups that it looks at.
        table: (P, K) int, the partners that tokens hold pairwise transforms to.
        latent: numbers of a token about the pose, which come first.
        mean, std: (36,) of a pairwise transform's numbers, the same for all slots.
        guess: (W, P, D) what was predicted last; 0 where nothing was.
        T_world_can: (W, 4, P, 4, 4) as people are placed.
    """

    views: CrowdViews
    table: Tensor
    latent: int
    mean: Tensor
    std: Tensor
    guess: Tensor
    T_world_can: Tensor

    def pair_numbers(self, slot: Tensor) -> Tensor:
        """Where a token holds its pairwise transform to the partner in a slot. (E,) int -> (E, 36) int"""
        return self.latent + PAIR * (1 + slot[:, None]) + torch.arange(PAIR, device=slot.device)


def gathered(views: CrowdViews, latent: int, noisy: Tensor, levels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Each view's tokens as they are, without what no token says of a pair (that is of any other partner there).

    noisy (R, W, P, D), levels (R, W, P) -> the own numbers (R, W, V, M, latent + 36), those of pairs (R, W, V, M, K,
    36), and levels (R, W, V, M)
    """
    own = latent + PAIR
    pairs = noisy[..., own:].unflatten(-1, (-1, PAIR))
    about = pairs[:, :, views.people[..., None], views.pair.clamp_min(0)]
    return noisy[:, :, views.people, :own], about, levels[:, :, views.people]


def shown_to_views(known: Window, noisy: Tensor, levels: Tensor) -> tuple[Tensor, Tensor]:
    """What each view of a crowd is shown: tokens (R V, W, M, D) and their levels (R V, W, M).

    noisy (R, W, P, D), levels (R, W, P)
    """
    own, about, each = gathered(known.views, known.latent, noisy, levels)
    work_out(known, about, noisy, levels)
    each = torch.where(~known.views.present, LEVELS, each)
    return by_view(torch.cat([own, about.flatten(-2)], dim=-1)), by_view(each)


def by_view(each: Tensor) -> Tensor:
    """(R, W, V, ...) -> (R V, W, ...)"""
    return each.transpose(1, 2).flatten(0, 1)


def lacking(views: CrowdViews) -> tuple[Tensor, Tensor, Tensor]:
    """Views, slots and partner slots (E,) whose pairwise transform no token holds: the two are no partners."""
    other = partners(views.people.shape[1], views.people.device)  # (M, K)
    v, a, s = ((views.pair < 0) & views.present[..., None] & views.present[:, other]).nonzero(as_tuple=True)
    return v, a, s


def work_out(known: Window, about: Tensor, noisy: Tensor, levels: Tensor) -> None:
    """Fill in pairwise transforms of two people of a view who are no partners. about (R, W, V, M, K, 36)

    The view's ego holds pairwise transforms to both: from their expected values, with the noise of one of them.
    Two who are known stand where they are placed, whatever an ego who is not known expects.
    """
    views = known.views
    v, a, s = lacking(views)
    if not len(v):
        return
    other = partners(views.people.shape[1], views.people.device)
    ego, one, two = views.ego[v], views.people[v, a], views.people[v, other[a, s]]
    (T_ego_one, *first), (T_ego_two, *second) = (seen_by(known, ego, who, noisy, levels) for who in (one, two))
    level = torch.maximum(levels[:, :, one], levels[:, :, two])
    T_world_can = known.T_world_can.transpose(1, 2)  # (W, P, 4, 4, 4)
    placed = inverse(T_world_can[:, one]) @ T_world_can[:, two]
    T_one_two = torch.where((level == 0)[..., None, None, None], placed, inverse(T_ego_one) @ T_ego_two)
    clean = (to_9d(T_one_two).flatten(-2) - known.mean) / known.std  # (R, W, E, 36)
    noise = noisier(first, second)
    about[:, :, v, a, s] = add_noise(clean, noise, level[..., None])


def noisier(first: list[Tensor], second: list[Tensor]) -> Tensor:
    """Of two noises (..., 36) with their levels (...): that of the higher level, the second where they are alike."""
    return torch.where((second[1] >= first[1])[..., None], second[0], first[0])


def seen_by(known: Window, ego: Tensor, who: Tensor, noisy: Tensor, levels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How people stand as an ego expects it, and the noise and the level of what the ego's token says of that.

    ego, who (E,) int -> T_ego_who (R, W, E, 4, 4), noise (R, W, E, 36), level (R, W, E); -1: of the ego itself
    """
    slot = (known.table[ego] == who[:, None]).int().argmax(dim=1)
    numbers = known.pair_numbers(slot)
    said, level = noisy[:, :, ego[:, None], numbers], torch.maximum(levels[:, :, ego], levels[:, :, who])
    clean = torch.where(level[..., None] == 0, said, known.guess[:, ego[:, None], numbers])
    share = alpha_bar(level)[..., None]
    noise = (said - share.sqrt() * clean) / (1 - share).clamp_min(1e-6).sqrt()
    T_ego_who = from_9d((clean * known.std + known.mean).unflatten(-1, (TOKEN_FRAMES, 9)))
    itself = (who == ego)[:, None, None, None]
    return (
        torch.where(itself, torch.eye(4, dtype=T_ego_who.dtype, device=ego.device), T_ego_who),
        noise,
        torch.where(who == ego, -1, level),
    )


def read_from_views(views: CrowdViews, latent: int, clean: Tensor) -> Tensor:
    """Everybody from the own view. (R, V, W, M, D) -> (R, W, P, D)"""
    own = latent + PAIR
    mine = clean[:, views.view, :, views.slot]  # (P, R, W, D)
    pairs = mine[..., own:].unflatten(-1, (-1, PAIR))
    person = torch.arange(len(mine), device=clean.device)[:, None]
    about = pairs[person, :, :, views.partner_slot.clamp_min(0)]  # (P, K, R, W, 36)
    read = torch.cat([mine[..., :own], about.permute(0, 2, 3, 1, 4).flatten(-2)], dim=-1)
    return read.permute(1, 2, 0, 3)
