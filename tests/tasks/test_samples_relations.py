"""What turn-taking samples where tokens say of each other where the other is, which is known in closed form too.

A token holds its agent's number x and, for each partner, how far that one's number is from its own. The best denoiser
of such tokens is affine, so as in `test_samples` the distribution of a sample is read off without statistics.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from magnet.motion.frames import partners
from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import alpha_bar
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import AHEAD, Grid
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.tasks.base import Task
from tests.cases import few

PAST, TOKENS = 1, 3
STEPS = (50, 100)  # the covariance at infinitely many steps is extrapolated from these
TOLERANCE = 0.004


class Related:
    """Jointly Gaussian numbers over (time, agent, group): each agent's own, and its distance to each partner."""

    def __init__(self, agents: int) -> None:
        generator = torch.Generator().manual_seed(agents)
        self.layout, self.agents = TokenLayout(latent=1, agents=agents), agents
        self.numbers = torch.tensor([0, *(37 + 36 * slot for slot in range(agents - 1))])  # the first of each group
        time = torch.arange(TOKENS).repeat_interleave(agents).double()
        agent = torch.arange(agents).repeat(TOKENS)
        own = (-(time[:, None] - time).abs() / 2).exp() * torch.where(agent[:, None] == agent, 1.0, 0.7)
        odd = 0.15 * torch.randn(own.shape, generator=generator, dtype=torch.float64)
        self.own = own + odd @ odd.T  # covariance of the agents' own numbers
        eye = torch.eye(TOKENS * agents, dtype=torch.float64).view(TOKENS, agents, -1)
        away = eye[:, partners(agents)] - eye[:, :, None]  # (N, P, slots, NP)
        self.reads = torch.cat([eye[:, :, None], away], dim=2).flatten(0, 2)  # every number from the own ones
        self.covariance = self.reads @ self.own @ self.reads.T

    def denoise(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        """E[all numbers | each with noise of its group's level]; what comes after the window is integrated out."""
        clean, flat = torch.zeros_like(noisy), levels.flatten(1)
        size = flat.shape[1] * self.agents
        for row in flat.unique(dim=0):
            alpha = alpha_bar(self.layout.group_levels(row.view(-1, self.agents)).flatten()).double()
            scaled = self.covariance[:size, :size] * alpha.sqrt()
            gain = scaled @ torch.linalg.pinv(alpha.sqrt()[:, None] * scaled + torch.diag(1 - alpha), hermitian=True)
            who = (flat == row).all(dim=1)
            told = noisy[who][..., self.numbers]
            clean[who.nonzero(), ..., self.numbers] = (told.flatten(1) @ gain.T).view(told.shape).permute(0, 3, 1, 2)
        return clean


class Given:
    """Noise and mask_noise of one's own choice."""

    eta = 0.0

    def __init__(self, noise: Tensor, mask_noise: Tensor) -> None:
        self.noise, self.mask_noise = noise, mask_noise

    def draw(self, count: int) -> tuple[Tensor, Tensor]:
        return self.noise, self.mask_noise


def covariance(world: Related, task: Task, steps: int) -> Tensor:
    """Of all numbers of the tokens that a task generates, with a past of zeros; nothing else is random."""
    plan = {"pyramid_offset": 0, "spacing": "even"}
    schedule = task.schedule(Grid(TOKENS, world.agents, PAST, steps, window=TOKENS + AHEAD, stride=1, **plan))
    G = world.agents
    size = TOKENS * world.agents * G
    noise = torch.zeros(2 * size, TOKENS, world.agents, world.layout.width, dtype=torch.float64)
    mask_noise = noise.clone()
    one = torch.eye(size, dtype=torch.float64).view(size, TOKENS, world.agents, G)
    noise[:size, ..., world.numbers], mask_noise[size:, ..., world.numbers] = one, one
    present = torch.ones(2 * size, world.agents, dtype=torch.bool)
    start = torch.zeros_like(noise)
    out = sample(world.denoise, schedule, start, present, world.layout, noise=Given(noise, mask_noise))
    made = out[:, PAST:][..., world.numbers].flatten(1)  # (draws, numbers)
    assert (made[size:].abs() < 1e-9).all(), "what hides a token tells nothing"
    return made[:size].T @ made[:size]


def off(world: Related, task: Task) -> float:
    """How far the covariance is from that of the future given the past, pairs included."""
    coarse, fine = (covariance(world, task, steps) for steps in STEPS)
    known = PAST * world.agents
    gain = world.own[known:, :known] @ torch.linalg.inv(world.own[:known, :known])
    reads = world.reads[known * world.agents :, known:]
    right = reads @ (world.own[known:, known:] - gain @ world.own[:known, known:]) @ reads.T
    return float((2 * fine - coarse - right).abs().max())


@pytest.mark.parametrize("offset", few([0.0, 0.5, 1.0], 1))
@pytest.mark.parametrize(("people", "order"), [(2, ()), (2, (1, 0)), (3, (2, 0, 1))])
def test_turns_sample_the_joint_future_with_relations_that_fit(people, order, offset):
    assert off(Related(people), AgenticAsync(offset, order, block=1)) < TOLERANCE


def test_agents_in_step_do_not():
    assert off(Related(2), AgenticSync()) > 10 * TOLERANCE
