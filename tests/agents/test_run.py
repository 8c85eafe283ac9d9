"""The pace of a process, and how it meets others, in a made-up time."""

from __future__ import annotations

import pytest

from magnet.agents.run import LOST, PERIOD, Pace


def drifting(rates: list[float], tokens: int, pull: bool = True) -> list[list[float]]:
    """When each agent sends each token, in true time; their clocks run at these rates, and begin a little apart."""
    paces = [Pace(0.03 * number * rate) for number, rate in enumerate(rates)]
    sent: list[list[float]] = [[] for _ in rates]
    for index in range(tokens):
        now = [pace.due(index) / rate for pace, rate in zip(paces, rates, strict=True)]
        for me, (pace, rate) in enumerate(zip(paces, rates, strict=True)):
            sent[me].append(now[me])
            for other, at in enumerate(now):
                if pull and other != me:
                    pace.heard(str(other), index, (at + 0.002) * rate)
            pace.sent(index, now[me] * rate)
    return sent


@pytest.mark.parametrize("rates", [[1.0, 1.01], [0.99, 1.0, 1.005, 1.01]])
def test_agents_keep_one_pace_though_their_clocks_drift(rates):
    """Two minutes: clocks a percent apart would be a second apart; together they stay within a token."""
    tokens = round(120 / PERIOD)
    alone, together = drifting(rates, tokens, False), drifting(rates, tokens)
    assert max(each[-1] for each in alone) - min(each[-1] for each in alone) > 1
    spread = [max(each) - min(each) for each in zip(*together, strict=True)]
    assert max(spread[30:]) < PERIOD
    assert 0.985 < (together[0][-1] - together[0][0]) / 120 < 1.015


def test_who_is_far_behind_sets_its_clock_anew():
    pace = Pace(0.0)
    assert pace.sent(0, 2 * LOST) == pytest.approx(2 * LOST)
    assert pace.resets == 1 and pace.due(1) == pytest.approx(2 * LOST + PERIOD)
    pace.heard("B", 1, pace.due(1) + 5 * LOST)  # somebody else who is far behind is not waited for
    assert not pace.lateness
