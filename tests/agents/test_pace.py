"""The pace of a process, in a made-up time."""

from __future__ import annotations

import pytest

from magnet.agents.run import LOST, PERIOD, Pace


def drifting(
    rates: list[float], tokens: int, pull: bool = True, way: float = 0.002, telling: bool = False
) -> list[list[float]]:
    """When each agent sends each token, in true time; their clocks run at these rates, and begin a little apart.

    A message takes `way` seconds; telling: it says how late its sender hears the others.
    """
    paces = [Pace(0.03 * number * rate) for number, rate in enumerate(rates)]
    sent: list[list[float]] = [[] for _ in rates]
    for index in range(tokens):
        now = [pace.due(index) / rate for pace, rate in zip(paces, rates, strict=True)]
        lags = [pace.lags.get if telling else {}.get for pace in paces]
        for me, (pace, rate) in enumerate(zip(paces, rates, strict=True)):
            sent[me].append(now[me])
            for other, at in enumerate(now):
                if pull and other != me:
                    pace.heard(str(other), index, (at + way) * rate, lags[other](str(me)))
            pace.sent(index, now[me] * rate)
    return sent


@pytest.mark.parametrize("rates", [[1.0, 1.01], [0.99, 1.0, 1.01], [1.0, 1.0, 1.01], [0.99, 1.0, 1.005, 1.01]])
def test_agents_keep_one_pace_though_their_clocks_drift(rates):
    """Two minutes: clocks a percent apart would be a second apart; together they stay within a token."""
    tokens = round(120 / PERIOD)
    alone, together = drifting(rates, tokens, False), drifting(rates, tokens)
    assert max(each[-1] for each in alone) - min(each[-1] for each in alone) > 1
    spread = [max(each) - min(each) for each in zip(*together, strict=True)]
    assert max(spread[30:]) < PERIOD
    assert 0.985 < (together[0][-1] - together[0][0]) / 120 < 1.015


@pytest.mark.parametrize("way", [0.1, 0.3])
@pytest.mark.parametrize("rates", [[1.0, 1.0], [1.0, 1.01], [0.99, 1.0, 1.01]])
def test_a_long_way_between_agents_slows_nobody(rates, way):
    """Each hears the others late, and does not wait for them; agents who did not tell theirs lost 2 s in a minute."""
    tokens = round(60 / PERIOD)
    sent = drifting(rates, tokens, way=way, telling=True)
    for each, rate in zip(sent, rates, strict=True):
        assert abs((each[-1] - each[30]) / ((tokens - 31) * PERIOD) - 1) < 0.0055, rate
    assert max(max(each) - min(each) for each in zip(*sent, strict=True)) < 0.1
    silent = drifting(rates, tokens, way=way)
    assert silent[0][-1] > sent[0][-1] + 1.0


@pytest.mark.parametrize("lag", [-1.5, 20.0])
def test_lags_that_cannot_be_are_not_counted(lag):
    told, untold = Pace(0.0), Pace(0.0)
    for pace, said in ((told, lag), (untold, None)):
        pace.heard("B", 0, 0.02, said)
        pace.sent(0, 0.0)
    assert told.start == untold.start == pytest.approx(0.002)


def test_who_is_far_behind_sets_its_clock_anew():
    pace = Pace(0.0)
    assert pace.sent(0, 2 * LOST) == pytest.approx(2 * LOST)
    assert pace.resets == 1 and pace.due(1) == pytest.approx(2 * LOST + PERIOD)
    pace.heard("B", 1, pace.due(1) + 5 * LOST)  # somebody else who is far behind is not waited for
    assert not pace.lateness


@pytest.mark.parametrize("others", [2, 3, 4])
def test_one_whose_clock_is_wrong_moves_nobody_elses_in_a_group(others):
    """It is half a second early, whatever the others do."""
    pace = Pace(0.0)
    for index in range(100):
        at = pace.due(index)
        for other in range(others):
            pace.heard(str(other), index, at - 0.5 * (other == 0))
        pace.sent(index, at)
    assert pace.start == pytest.approx(0.0, abs=1e-9)


def test_a_tenth_of_what_the_other_is_late_is_taken_up_and_five_milliseconds_at_most():
    for late, taken in ((0.01, 0.001), (-0.01, -0.001), (0.5, 0.005), (-0.5, -0.005)):
        pace = Pace(0.0)
        pace.heard("B", 0, late)
        pace.sent(0, 0.0)
        assert pace.start == pytest.approx(taken)


def test_how_late_somebody_is_is_averaged_over_some_tokens_and_a_second_off_does_not_count():
    pace = Pace(0.0)
    for index, late in enumerate((0.1, 0.2, -5 * LOST, 5 * LOST)):
        pace.heard("B", index, pace.due(index) + late)
    assert pace.lateness == {"B": pytest.approx(0.7 * 0.1 + 0.3 * 0.2)}


def test_who_is_gone_moves_nobodys_clock_any_more():
    pace = Pace(0.0)
    pace.heard("B", 0, 0.5)
    moved = [pace.start for index in range(100) if pace.sent(index, pace.due(index)) is not None]
    assert moved[10] > 0 and moved[-1] == moved[20] and not pace.lateness
