import pytest
import torch

from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout, by_frame, by_token, scene_transforms


@pytest.mark.parametrize("agents", [1, 2, 3, 4])
def test_a_token_holds_512_plus_36_numbers_an_agent(agents: int):
    assert TokenLayout(512, agents).width == 512 + 36 * agents


def test_pack_and_unpack_are_inverse(scene: Scene, generator):
    layout = TokenLayout(512, 3)
    latent = torch.randn(2, 16, 3, 512, generator=generator)
    parts = (latent, *scene_transforms(scene))
    for before, after in zip(parts, layout.unpack(layout.pack(*parts)), strict=True):
        assert torch.equal(before, after)


def test_groups_lie_where_unpack_finds_them():
    layout = TokenLayout(8, 3)
    latent, deltas, pairs = layout.unpack(layout.groups().float())
    assert latent.unique().tolist() == deltas.unique().tolist() == [0]
    assert [pairs[slot].unique().tolist() for slot in range(2)] == [[1], [2]]


def test_frames_and_tokens_are_two_views_of_the_same():
    frames = torch.arange(2 * 12 * 3 * 5).view(2, 12, 3, 5)
    tokens = by_token(frames)
    assert tokens.shape == (2, 3, 3, TOKEN_FRAMES, 5)
    assert torch.equal(tokens[1, 2, 0, 1], frames[1, 9, 0])
    assert torch.equal(by_frame(tokens), frames)


def test_a_broken_token_is_refused():
    with pytest.raises(ValueError, match="whole number of tokens"):
        by_token(torch.zeros(1, 10, 1, 3))


def test_a_relation_is_as_noisy_as_its_noisier_end():
    layout = TokenLayout(8, 3)
    levels = torch.tensor([[0, 500, 1000]])
    expected = [[0, 500, 1000], [500, 500, 1000], [1000, 1000, 1000]]
    assert layout.group_levels(levels)[0].tolist() == expected


def test_the_literal_reading_gives_one_level_a_token():
    layout = TokenLayout(8, 3, pairwise_noise="token")
    assert layout.group_levels(torch.tensor([[0, 500, 1000]]))[0].tolist() == [[0] * 3, [500] * 3, [1000] * 3]


def test_relations_to_absent_agents_do_not_count():
    there = TokenLayout(8, 3).group_present(torch.tensor([[True, False, True]]))
    assert there[0].tolist() == [[True, False, True], [False, False, False], [True, True, False]]
