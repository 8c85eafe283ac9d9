"""What the model predicts after a block: each agent's first word, in its own view."""

import dataclasses
import itertools

import pytest
import torch

from magnet.generation.expected import Ahead, Expected, own_view, views
from magnet.generation.rollout import Rollout
from magnet.sampling.noise import LEVELS
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Stage
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.testing import random_scene


def test_each_agents_first_word_of_what_comes_counts():
    """Later stages of the same block have seen more."""
    rows = torch.full((2, 3, 2), LEVELS)
    rows[:, :2] = 0
    first, second = rows.clone(), rows.clone()
    first[1, 2, 0], second[:, 2, 0], second[1, 2, 1] = 0, 0, 0
    one, two = torch.full((1, 1, 5, 2, 4), 1.0), torch.full((1, 1, 5, 2, 4), 2.0)
    alone = torch.zeros(2, dtype=torch.long)
    expected = Expected(4)
    expected.keep(Stage(5, first, ahead=2), one, alone)
    ahead = expected.behind(8)
    assert ahead.tokens.shape == (1, 2, 2, 2, 4) and ahead.told.tolist() == [True, False]
    assert ahead.within.shape == (1, 2, 1, 2, 4)  # the block's, for who does not see it
    expected.keep(Stage(5, second, ahead=2), two, alone)
    ahead = expected.behind(8)
    for tokens in (ahead.tokens, ahead.within):
        assert ahead.told.all() and (tokens[:, 0] == 1).all() and (tokens[:, 1] == 2).all()
    assert expected.behind(9) is None


def test_everybody_expects_others_as_its_own_view_shows_them():
    rows = torch.zeros(2, 3, 2, dtype=torch.long)
    rows[0, 2] = LEVELS
    clean = torch.arange(2.0)[:, None, None, None].expand(1, 2, 5, 2, 4)
    expected = Expected(4)
    expected.keep(Stage(5, rows, ahead=2), clean, torch.tensor([1, 0]))
    ahead = expected.behind(8)
    assert ahead.told.all() and (ahead.tokens[:, 0] == 1).all() and (ahead.tokens[:, 1] == 0).all()


def test_every_agent_is_read_from_its_own_view_without_guidance():
    """Scenes first, then views, then branches."""
    hidden = torch.zeros(3, 2, 3, dtype=torch.bool)
    hidden[0, 1, 1] = hidden[2, 1, 0] = True
    kinds, of = hidden.unique(dim=0, return_inverse=True)
    stage = Stage(0, torch.zeros(2, 2, 3, dtype=torch.long), ~hidden)
    clean = torch.zeros(2, len(kinds), 4, 2, 3, 1)
    clean += 100 * torch.arange(2).view(2, 1, 1, 1, 1, 1) + 10 * torch.arange(len(kinds)).view(1, -1, 1, 1, 1, 1)
    clean += torch.arange(4).view(1, 1, 4, 1, 1, 1)
    seen = own_view(clean.flatten(0, 2), stage, 2)
    for scene in range(2):
        for agent in range(3):
            assert (seen[scene, :, agent] == 100 * scene + 10 * int(of[agent])).all()
    each, view_of = views(clean.flatten(0, 2), stage, 2)
    assert each.shape == (2, len(kinds), 2, 3, 1) and torch.equal(view_of, of)
    plain = own_view(clean[:, 0].flatten(0, 1), dataclasses.replace(stage, visibility=None), 2)
    assert plain.shape == (2, 2, 3, 1) and (plain[1] == 100).all()


@pytest.mark.parametrize("task", [AgenticAsync(), AgenticSync()], ids=str)
def test_whoever_is_made_later_is_expected_in_the_block_alike_in_every_precision(model, task):
    """Packed weights predict only what is read, and 0 elsewhere."""
    scene = random_scene(1, 16, 2, torch.Generator().manual_seed(3))

    def within(precision: str) -> torch.Tensor:
        options, generator = (
            SamplerOptions(steps=2, settle="firm", precision=precision),
            torch.Generator().manual_seed(1),
        )
        rollout = Rollout(model, scene, task, 16, 16, 1, options, generator, chunk=1)
        list(itertools.islice(rollout.chunks(), 5))
        ahead = rollout.expected.behind(rollout.expected.row)
        assert isinstance(ahead, Ahead) and ahead.within.shape[2] == 1
        return ahead.within[:, :2, :, :2]

    assert model.posterior is None
    assert torch.allclose(within("float32"), within("reference"), atol=1e-3)
