import pytest
import torch

from magnet.denoiser.levels import (
    FAINT,
    FROM_NOTHING_MIXED,
    MIXED,
    ROLES,
    UNKNOWN_AFTER,
    draw_levels,
    drawn,
    drawn_roles,
    live_levels,
    rollout_levels,
)
from magnet.denoiser.options import NoiseOptions
from magnet.sampling.noise import LEVELS

KINDS = ["per_token", "per_timestep", "per_sequence", "mixture"]
MIXTURE = NoiseOptions("mixture")


@pytest.mark.parametrize("kind", KINDS)
def test_levels_span_clean_to_pure_noise_and_follow_the_seed(kind, generator):
    levels = draw_levels(NoiseOptions(kind), (4000, 4, 2), generator)
    assert levels.shape == (4000, 4, 2)
    assert (int(levels.min()), int(levels.max())) == (0, LEVELS)
    again = [draw_levels(NoiseOptions(kind), (8, 4, 2), torch.Generator().manual_seed(1)) for _ in range(2)]
    assert torch.equal(*again)


def test_tokens_are_independent_time_steps_shared_sequences_equal(generator):
    per_token = draw_levels(NoiseOptions("per_token"), (2000, 3, 2), generator).double().flatten(1)
    correlation = torch.corrcoef(per_token.T) - torch.eye(6)
    assert correlation.abs().max() < 0.1
    per_timestep = draw_levels(NoiseOptions("per_timestep"), (50, 3, 2), generator)
    assert torch.equal(per_timestep[..., 0], per_timestep[..., 1])
    per_sequence = draw_levels(NoiseOptions("per_sequence"), (50, 3, 2), generator)
    assert (per_sequence == per_sequence[:, :1, :1]).all()


def test_a_roll_out_is_a_clean_past_a_block_and_an_unknown_future(generator):
    levels = rollout_levels(MIXTURE, (3000, 16, 2), generator)
    assert (levels.diff(dim=1) >= 0).all()
    assert (levels[:, -1] == LEVELS).any() and (levels[:, 0] == 0).any()


def test_more_roll_outs_begin_from_nothing_than_chance_gives(generator):
    levels = rollout_levels(MIXTURE, (4000, 16, 2), generator)
    alone, mixed = (share + (1 - share) / 16 for share in (MIXTURE.from_nothing, FROM_NOTHING_MIXED))
    given = (ROLES[1] + ROLES[2]) / 2  # in half of the scenes it is this one who is generated whatever is drawn
    expected = (1 - MIXED) * alone + MIXED * (1 - given) * mixed
    assert (levels[:, 0] > 0).double().mean() == pytest.approx(expected, abs=0.02)


def test_a_partner_from_nothing_is_trained_as_often_as_inpainting_needs(generator):
    """One in seven roll-outs of two people gives one of them wholly and nothing of the other, in four slots too."""
    for slots in (2, 4):
        present = torch.arange(slots).expand(8000, slots) < 2
        levels = rollout_levels(MIXTURE, (8000, 16, slots), generator, present=present)[..., :2]
        given, lacking = (levels == 0).all(dim=1), (levels > 0).all(dim=1)
        assert ((given & lacking.flip(1)).any(dim=1)).double().mean() > 1 / 8


@pytest.mark.parametrize("draw", [rollout_levels, live_levels])
def test_in_every_roll_out_somebody_who_is_there_is_generated(draw, generator):
    """Of two people in five slots, in any two of them."""
    present = torch.rand(4000, 5, generator=generator).argsort(dim=1) < 2
    levels = draw(MIXTURE, (4000, 16, 5), generator, present=present)
    generated = ((levels > 0) & (levels < LEVELS)).any(dim=1) & present
    assert generated.any(dim=1).double().mean() > 0.97  # level K, unknown as what follows it, is drawn once in a while
    roles = drawn_roles((0.1, 0.9), (4000, 1, 5), generator, present)[:, 0]
    assert ((roles == 0) & present).any(dim=1).all()
    assert float((roles[~present] == 0).double().mean()) == pytest.approx(0.1, abs=0.02)
    assert float((roles[present] == 0).double().mean()) == pytest.approx(0.55, abs=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_a_shift_draws_high_levels_more_often_and_keeps_both_ends(kind, generator):
    even, moved = (draw_levels(NoiseOptions(kind, shift), (4000, 4, 2), generator).double() for shift in (1.0, 3.0))
    assert (int(moved.min()), int(moved.max())) == (0, LEVELS)
    assert moved.mean() > even.mean() + 40
    if kind != "mixture":
        assert moved.median() == pytest.approx(750, abs=30)  # 3 / 2 over 1 + 2 / 2


def test_a_faint_past_is_at_one_level_up_to_the_faintest_and_those_who_are_given_stay_clean(generator):
    levels = rollout_levels(NoiseOptions("mixture", faint_past=1.0), (6000, 16, 2), generator)
    assert (levels[:, :, 0] == 0).all(dim=1).any()  # given to the end
    first, last = levels[:, 0, 0], levels[:, -1, 0]
    past = (first > 0) & (first <= FAINT) & (last == LEVELS) & (levels[:, 1, 0] == first)
    assert past.any()
    changes = (levels[:, :, 0].clamp_max(FAINT + 1).diff(dim=1) != 0).sum(dim=1)
    assert changes[past].float().mean() < 4  # of the past, the block and what is unknown
    later = (levels[:, 0, 0] == 0) & ((levels[:, :, 0] > 0) & (levels[:, :, 0] <= FAINT)).any(dim=1)
    assert later.any()  # in others it begins some tokens later


def test_so_many_pasts_are_faint_as_are_asked_for(generator):
    shares = []
    for faint in (0.0, 0.5, 1.0):
        levels = rollout_levels(NoiseOptions("mixture", faint_past=faint), (20_000, 16, 2), generator)[:, :, 0]
        shares.append(float(((levels > 0) & (levels <= FAINT)).any(dim=1).double().mean()))
    never, half, always = shares
    assert always - never > 0.1
    assert half - never == pytest.approx((always - never) / 2, abs=0.015)


def test_live_levels_are_a_past_one_or_two_tokens_and_an_unknown_future(generator):
    levels = live_levels(NoiseOptions("mixture", 3.0), (4000, 16, 2), generator)
    generated = (levels > 0) & (levels < LEVELS)
    assert set(generated.sum(dim=1).unique().tolist()) <= {0, 1, 2}
    assert (levels.diff(dim=1) >= 0).all()
    assert (levels[:, 0] == 0).all() and (levels[:, -UNKNOWN_AFTER + 1 :] == LEVELS).all()
    assert generated.any(dim=2).any(dim=1).double().mean() > 0.99  # level K is drawn once in a while
    where = generated.any(dim=2).double().argmax(dim=1)
    assert 0.4 < float((where == 16 - 1 - UNKNOWN_AFTER).double().mean()) < 0.65  # where a window that moves has it


def test_one_live_block_in_five_is_of_two_tokens(generator):
    levels = live_levels(NoiseOptions("mixture"), (4000, 16, 2), generator)
    length = ((levels > 0) & (levels < LEVELS)).sum(dim=1).amax(dim=1)
    length = length[length > 0]
    assert float((length == 2).double().mean()) == pytest.approx(0.2, abs=0.03)


def test_live_levels_ask_what_each_live_task_asks(generator):
    levels = live_levels(MIXTURE, (4000, 16, 2), generator)
    begins = (levels > 0).any(dim=2).double().argmax(dim=1)
    first, second = levels[torch.arange(4000), begins].unbind(dim=1)
    busy = (first > 0) & (first < LEVELS)
    together, after, hidden = (
        float((busy & also).double().mean()) for also in (second == first, second == 0, second == LEVELS)
    )
    assert min(together, after, hidden) > 0.1


def test_a_live_past_is_faint_for_those_who_are_not_given(generator):
    levels = live_levels(NoiseOptions("mixture", faint_past=1.0), (4000, 16, 2), generator)
    dark = (levels == LEVELS).all(dim=2)
    begins = torch.where(dark.any(dim=1), dark.double().argmax(dim=1), 16) - 1  # the block's last
    last = levels[torch.arange(4000), begins]
    given = (last == 0) & ~(last == 0).all(dim=1, keepdim=True)
    past = torch.arange(16)[:, None] < begins[:, None, None]
    faint = ((levels > 0) & (levels <= FAINT) & past).any(dim=1)
    assert given.any() and not faint[given].any()
    assert float(faint[last == LEVELS].double().mean()) > 0.75


def test_half_of_the_faint_live_pasts_are_faint_from_the_first_token_on(generator):
    """The others are clean for a while, as where what was given comes before what was made."""
    levels = live_levels(NoiseOptions("mixture", faint_past=0.5), (20_000, 16, 1), generator)[..., 0]
    faint = (levels > 0) & (levels <= FAINT)
    apart = ((levels > FAINT) & (levels < LEVELS)).any(dim=1)  # the block is not as faint as the past may be
    long = apart & ((levels <= FAINT).sum(dim=1) >= 8)  # so that what begins at random begins within it
    some = faint[long].any(dim=1)
    assert float(faint[long][some, 0].double().mean()) == pytest.approx(0.52, abs=0.04)


def test_a_share_of_the_roll_outs_is_live(generator):
    def narrow(levels):
        busy = ((levels > 0) & (levels < LEVELS)).any(dim=2).sum(dim=1)
        return float((busy <= 2).double().mean())

    few, many = (
        narrow(draw_levels(NoiseOptions("mixture", live=live), (4000, 16, 2), generator)) for live in (0.0, 0.5)
    )
    assert many > few + 0.2


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_so_many_scenes_begin_from_nothing_as_are_asked_for(share, generator):
    """Of those in which everybody is generated; in the others `FROM_NOTHING_MIXED` do."""
    levels = rollout_levels(NoiseOptions("mixture", from_nothing=share), (20_000, 16, 2), generator)
    nothing = float((levels[:, 0] > 0).all(dim=1).double().mean())
    alone, mixed = (each + (1 - each) / 16 for each in (share, FROM_NOTHING_MIXED))
    both = 1 - ROLES[1] - ROLES[2]
    assert nothing == pytest.approx((1 - MIXED) * alone + MIXED * both * mixed, abs=0.02)


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_so_many_blocks_fill_the_window_as_are_asked_for(share, generator):
    """Of those at one level, of scenes in which everybody is generated; the others end anywhere."""
    levels = rollout_levels(NoiseOptions("mixture", from_nothing=1.0, to_end=share), (40_000, 16, 2), generator)
    active = (levels > 0) & (levels < LEVELS)
    alike = (levels[:, :, 0] == levels[:, :, 1]).all(dim=1) & active[:, 0].all(dim=1)
    stop = active.all(dim=2).sum(dim=1)
    level = levels[:, 0, 0]
    in_block = torch.arange(16) < stop[:, None]
    flat = alike & ((levels[:, :, 0] == level[:, None]) | ~in_block).all(dim=1) & (stop > 1)
    whole = float((stop[flat] == 16).double().mean())
    assert whole == pytest.approx(share + (1 - share) / 15, abs=0.05)


@pytest.mark.parametrize("at_once", [0.05, 0.4])
def test_a_mixture_draws_kinds_two_to_one_to_six_and_a_half_beside_scenes_at_one_level(at_once, generator):
    """Levels of each token, of each time step, and roll-outs, which of all levels but one are steps up or down."""
    levels = draw_levels(NoiseOptions("mixture", at_once=at_once, from_nothing=0.0), (20_000, 16, 2), generator)
    falls = (levels.diff(dim=1) < 0).any(dim=1)
    token = (levels[..., 0] != levels[..., 1]).all(dim=1) & falls.all(dim=1)
    step = (levels[..., 0] == levels[..., 1]).all(dim=1) & falls.all(dim=1)
    rest = (1 - at_once) / (0.2 + 0.1 + 0.65)
    assert float(token.double().mean()) == pytest.approx(0.2 * rest, abs=0.015)
    assert float(step.double().mean()) == pytest.approx(0.1 * rest, abs=0.015)


@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_six_of_ten_roll_outs_are_ramps_of_three_to_twelve_tokens_begun_anywhere(shift, generator):
    levels = rollout_levels(NoiseOptions("mixture", shift), (20_000, 64, 1), generator)[..., 0].double() / LEVELS
    even = levels / (shift - (shift - 1) * levels)  # as they were before `shifted`
    here = (even > 0) & (even < 1)
    first = here.int().argmax(dim=1)
    one, two, three = (even.gather(1, (first + more).clamp_max(63)[:, None])[:, 0] for more in (0, 1, 2))
    ramp = (here.sum(dim=1) >= 3) & (two > one + 0.01)
    assert float(ramp.double().mean()) == pytest.approx(0.6, abs=0.04), "but for those that the window's end cuts"
    slope = (two - one)[ramp]
    torch.testing.assert_close((three - two)[ramp], slope, rtol=0, atol=5e-3)
    assert 1 / 12.5 < float(slope.min()) < 1 / 11 and 1 / 3.5 < float(slope.max()) < 1 / 2.9
    begun = one[ramp] / slope
    assert float(begun.mean()) == pytest.approx(0.5, abs=0.03) and 0.9 < float(begun.max()) < 1.1


@pytest.mark.parametrize(
    ("draw", "shares"), [(rollout_levels, (0.45, 0.1, 0.37, 0.08)), (live_levels, (0.45, 0.33, 0.0, 0.22))]
)
def test_so_many_are_generated_given_so_far_given_and_hidden(draw, shares, generator):
    """Of eight agents, of whom one is generated whatever is drawn, where they have roles of their own."""
    levels = draw(NoiseOptions("mixture", from_nothing=0.0), (20_000, 16, 8), generator)
    busy = (levels > 0) & (levels < LEVELS)
    now = busy.any(dim=2).int().argmax(dim=1)  # the block's first token
    at, last = levels[torch.arange(20_000), now], levels[:, -1]
    some = busy.any(dim=2).any(dim=1) & (last == LEVELS).any(dim=1) & (now > 0) & ~(at == at[:, :1]).all(dim=1)
    generated = busy[torch.arange(20_000), now]
    given = (levels == 0).all(dim=1)
    kinds = generated, (at == 0) & ~given, given, at == LEVELS
    for found, share, forced in zip(kinds, shares, (1, 0, 0, 0), strict=True):
        expected = forced / 8 + 7 / 8 * share
        assert float(found[some].double().mean()) == pytest.approx(expected, abs=0.03)


def test_what_a_place_draws_does_not_depend_on_who_shares_its_batch(generator):
    there = torch.ones(3, 2, dtype=torch.bool)
    seeded = [torch.Generator().manual_seed(5) for _ in range(3)]
    whole = drawn(MIXTURE, torch.Size((3, 8, 2, 4)), seeded[0], there, places=(7, 8, 9))
    other = drawn(MIXTURE, torch.Size((2, 8, 2, 4)), seeded[1], there[:2], places=(9, 7))
    again = drawn(MIXTURE, torch.Size((1, 8, 2, 4)), torch.Generator().manual_seed(6), there[:1], places=(7,))
    for mine, theirs, elsewhere in zip(whole, other, again, strict=True):
        assert torch.equal(mine[[2, 0]], theirs)
        assert not torch.equal(mine[:1], elsewhere), "with another seed it is another"
    alone = drawn(MIXTURE, torch.Size((2, 8, 2, 4)), seeded[2], there[:2])
    assert torch.equal(alone[0], draw_levels(MIXTURE, (2, 8, 2), torch.Generator().manual_seed(5), there[:2]))


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_so_many_scenes_are_at_one_level_as_are_asked_for(share, generator):
    levels = draw_levels(NoiseOptions("mixture", at_once=share, from_nothing=0.0), (20_000, 16, 2), generator)
    one = (levels == levels[:, :1, :1]).flatten(1).all(dim=1)
    assert float(one.double().mean()) == pytest.approx(share, abs=0.02)
