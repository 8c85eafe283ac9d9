"""What the network is shown of two people of a view who are no partners, and that what it says is read back."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from magnet.denoiser.module import Denoiser
from magnet.generation import crowd as crowds
from magnet.generation import crowd_views
from magnet.generation.crowd import CrowdRollout
from magnet.generation.crowd_start import compose
from magnet.generation.crowd_views import Window, gathered, lacking, read_from_views, shown_to_views
from magnet.motion.frames import inverse, partners, to_9d
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser

Shown = tuple[Tensor, Tensor]


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "posterior"])
def model(request: pytest.FixtureRequest) -> Denoiser:
    return tiny_denoiser(max_agents=4, window=8, network={"pairwise_posterior": request.param})


def near_crowd() -> Scene:
    """Nine people, so near that views hold two who are no partners."""
    generator = torch.Generator().manual_seed(9)
    couples = random_scene(3, 24, 2, generator)
    return compose([couples.select([number]) for number in range(3)], 9, generator, 1.4)


def watched(model: Denoiser, monkeypatch: pytest.MonkeyPatch, look: Any) -> None:
    """Sample a crowd some of whom are given; `look` gets all that is shown: (Window, noisy, levels, shown, each)."""

    def show(known: Window, noisy: Tensor, levels: Tensor) -> Shown:
        shown = shown_to_views(known, noisy, levels)
        look(known, noisy, levels, *shown)
        return shown

    monkeypatch.setattr(crowds, "shown_to_views", show)
    task = registry.get("motion_control")(target=(0, 2, 4, 6))
    quick = SamplerOptions(steps=2, stride=2)
    list(CrowdRollout(model, near_crowd(), task, 8, 16, quick, torch.Generator().manual_seed(5)).chunks())


def test_two_who_are_known_are_shown_where_they_stand_to_whoever_is_not(model, monkeypatch) -> None:
    """Of two known people who are no partners of each other, the ego's expectation is not shown as if it were known."""
    seen = []

    def look(known: Window, noisy: Tensor, levels: Tensor, shown: Tensor, each: Tensor) -> None:
        views, other = known.views, partners(4)
        said = model.layout.unpack(model.normalizer.denormalize(shown))[2].unflatten(0, (1, -1))[
            0
        ]  # (V, W, M, K, 4, 9)
        v, a, s = lacking(views)
        both = (each[v, :, a] == 0) & (each[v, :, other[a, s]] == 0)  # (E, W)
        e, w = both.nonzero(as_tuple=True)
        one, two = views.people[v, a][e], views.people[v, other[a, s]][e]
        place = known.T_world_can.transpose(1, 2)  # (W, P, 4, 4, 4)
        truth = to_9d(inverse(place[w, one]) @ place[w, two])
        torch.testing.assert_close(said[v[e], w, a[e], s[e]], truth, rtol=0, atol=1e-4)
        seen.append(int((each[v[e], w, views.slot[views.ego[v[e]]]] > 0).sum()))

    watched(model, monkeypatch, look)
    assert sum(seen) > 0, "some egos are not known"


def test_two_who_are_no_partners_are_shown_with_the_noise_of_the_noisier(model, monkeypatch) -> None:
    """An ego's token holds no noise of the ego itself, and none of somebody whom both know."""
    differ, plain, asked = [], crowd_views.seen_by, []

    def seen_by(known: Window, ego: Tensor, who: Tensor, noisy: Tensor, levels: Tensor) -> Any:
        T_ego_who, noise, level = plain(known, ego, who, noisy, levels)
        asked.append(level)  # of the first, then of the second, whose noises are told apart by sign
        return T_ego_who, torch.full_like(noise, 1e6 if len(asked) % 2 == 0 else -1e6), level

    def look(known: Window, noisy: Tensor, levels: Tensor, shown: Tensor, each: Tensor) -> None:
        v, a, s = lacking(known.views)
        if not len(v):
            return
        first, second = asked[-2:]
        pairs = shown[..., known.latent + crowd_views.PAIR :].unflatten(-1, (-1, crowd_views.PAIR))
        of_second = (pairs[v, :, a, s].mean(dim=-1) > 0).T[None]  # (1, W, E)
        other = partners(4)
        highest = torch.maximum(*(levels[:, :, known.views.people[v, slot]] for slot in (a, other[a, s])))
        unlike = (first != second) & (highest > 0)
        assert torch.equal(of_second[unlike], (second > first)[unlike])
        differ.append(int(unlike.sum()))

    monkeypatch.setattr(crowd_views, "seen_by", seen_by)
    watched(model, monkeypatch, look)
    assert sum(differ) > 0, "some are given, others are not"


def test_what_is_shown_is_read_back_by_whom_it_is_of(model, monkeypatch) -> None:
    """Everybody's own numbers come back, and those of pairs wherever somebody is there."""
    rounds = []

    def look(known: Window, noisy: Tensor, levels: Tensor, shown: Tensor, each: Tensor) -> None:
        read = read_from_views(known.views, known.latent, shown.unflatten(0, (1, -1)))
        own = known.latent + crowd_views.PAIR
        assert torch.equal(read[..., :own], noisy[..., :own])
        there = known.table != torch.arange(len(known.table))[:, None]  # (P, K)
        pairs = [every[..., own:].unflatten(-1, (-1, crowd_views.PAIR))[:, :, there] for every in (read, noisy)]
        assert torch.equal(*pairs)
        assert torch.equal(
            gathered(known.views, known.latent, noisy, levels)[2][:, :, known.views.present],
            each.unflatten(0, (1, -1)).transpose(1, 2)[:, :, known.views.present],
        )
        rounds.append(int(there.sum()))

    watched(model, monkeypatch, look)
    assert rounds and min(rounds) > 9, "most have several partners"
