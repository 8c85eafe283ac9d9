"""Who must not be moved: the same people whichever shape the mask has."""

import pytest
import torch

from magnet.body.fixed import fixed_anywhere, fixed_in, fixed_of

B, T = 2, 5
WHO = torch.tensor([True, False, True])


@pytest.mark.parametrize("shape", [(3,), (T, 3), (1, T, 3), (B, T, 3)])
def test_a_part_of_a_mask_is_the_mask_of_the_part(shape: tuple[int, ...]) -> None:
    fixed = WHO.expand(shape)
    for frames in (slice(1, 3), torch.tensor([0, 4])):
        assert torch.equal(fixed_in(fixed, frames).expand(B, 2, 3), WHO.expand(B, 2, 3))
    assert torch.equal(fixed_of(fixed, torch.tensor([1]), B).expand(1, T, 3), WHO.expand(1, T, 3))
    assert torch.equal(fixed_anywhere(fixed).expand(B, 3), WHO.expand(B, 3))


def test_one_frame_is_enough_to_stay_and_scenes_keep_their_own() -> None:
    fixed = torch.zeros(B, T, 3, dtype=torch.bool)
    fixed[1, 2, 0] = True
    assert fixed_anywhere(fixed).tolist() == [[False, False, False], [True, False, False]]
    assert fixed_of(fixed, slice(1, 2), B).sum() == 1 and fixed_of(fixed, slice(0, 1), B).sum() == 0
    assert fixed_in(None, slice(1)) is None and fixed_of(None, slice(1), B) is None
