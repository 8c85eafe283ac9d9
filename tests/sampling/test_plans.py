"""Parts of plans: openings, blocks of time steps, positions of the window, levels that are moved toward noise."""

from __future__ import annotations

import pytest
import torch

from magnet.sampling.grid import Grid
from magnet.sampling.noise import LEVELS, shifted
from magnet.sampling.plans import blocks, opened, token_levels, window_positions


def test_an_opening_is_above_every_first_level_and_only_for_what_moves_first() -> None:
    levels = torch.tensor([[1000, 1000, 1000], [700, 960, 1000], [0, 400, 1000]])[:, None]  # (S + 1, 1, P)
    more = opened(levels, 3)[:, 0]
    assert len(more) > 3 and torch.equal(more[[0, -2, -1]], levels[:, 0])
    assert (more[1:-2, :2] > 960).all() and (more[1:-2, :2].diff(dim=0) < 0).all()
    assert (more[:, 2] == LEVELS).all(), "what waits waits"
    known = levels.clone()
    known[:, 0, 2] = 0
    assert torch.equal(opened(known, 3), known) and torch.equal(opened(levels, 0), levels)


@pytest.mark.parametrize(
    ("block", "found"), [(2, [(1, 3), (3, 5), (5, 6), (8, 9)]), (1, [(n, n + 1) for n in (1, 2, 3, 4, 5, 8)])]
)
def test_blocks_end_with_their_targets(block: int, found: list[tuple[int, int]]) -> None:
    target = torch.tensor([0, 1, 1, 1, 1, 1, 0, 0, 1, 0], dtype=torch.bool)[:, None]
    assert list(blocks(target, block)) == found


@pytest.mark.parametrize("window", [1, 2, 5, 8, 30])
@pytest.mark.parametrize("tokens", [1, 7, 20])
def test_the_window_is_filled_and_then_moves_on_with_finished_tokens_in_view(tokens: int, window: int) -> None:
    for stride in range(1, window + 1):
        for context in range(tokens):
            grid = Grid(tokens, 1, context, steps=2, window=window, stride=stride)
            target = ~grid.past()
            positions, after = list(window_positions(target, grid)), context
            for number, (start, first, last) in enumerate(positions):
                stop = min(start + window, tokens)
                assert first == after < last <= stop and start >= 0 and stop - start == min(window, tokens)
                assert number or last == stop, "the first is filled"
                assert last - first >= min(stride, tokens - first), "a stride of new tokens at least"
                assert first - start >= min(first, window - stride) or stop == tokens
                after = last
            assert after == tokens
    assert not list(window_positions(torch.zeros(tokens, 1, dtype=torch.bool), grid))


def test_levels_of_each_tokens_own_are_moved_toward_noise_too() -> None:
    even, moved = (
        token_levels(Grid(4, 2, 0, steps=9, noise_sampling="independent", spacing="even", shift=shift))
        for shift in (1.0, 3.0)
    )
    assert torch.equal(moved, shifted(even, 3.0)) and not torch.equal(moved, even)
