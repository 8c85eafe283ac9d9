"""Laws of playback time."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnet.viewer.clock import Clock


@given(st.integers(1, 500), st.lists(st.floats(0, 3), max_size=20), st.booleans(), st.booleans())
def test_the_frame_always_exists(frames, times, loop, growing) -> None:
    clock = Clock(frames, 30.0, loop=loop, growing=growing)
    for seconds in times:
        assert 0 <= clock.tick(seconds) < frames


def test_time_passes_at_the_chosen_speed() -> None:
    clock = Clock(300, 30.0, speed=0.5)
    assert clock.tick(2.0) == 30


def test_a_speed_that_there_is_not_changes_nothing() -> None:
    """A client may send any text as the choice of a list; one that is no number would end the viewer for all."""
    clock = Clock(300, 30.0)
    clock.set_speed("0.25x")
    for name in ("nanx", "-1x", "x", "1e300x", ""):
        clock.set_speed(name)
    assert clock.speed == 0.25 and clock.tick(2.0) == 15


def test_a_slow_browser_skips_frames_instead_of_falling_behind() -> None:
    fast, slow = Clock(300, 30.0), Clock(300, 30.0)
    for _ in range(60):
        fast.tick(1 / 30)
    slow.tick(2.0)
    assert abs(fast.frame - slow.frame) <= 1


def test_looping_goes_round_and_not_looping_stops_at_the_end() -> None:
    round_, once = Clock(30, 30.0), Clock(30, 30.0, loop=False)
    assert round_.tick(1.5) == 15
    assert once.tick(1.5) == 29
    assert not once.playing
    once.play(True)
    assert once.frame == 0


def test_a_growing_motion_waits_for_more_at_its_end() -> None:
    clock = Clock(30, 30.0, growing=True, loop=False)
    assert clock.tick(5.0) == 29
    assert clock.playing
    clock.frames = 60
    assert clock.tick(0.5) > 29


def test_a_growing_motion_that_loops_goes_round_what_there_is() -> None:
    clock = Clock(30, 30.0, growing=True, loop=True)
    assert clock.tick(1.5) == 15
    assert clock.playing


@pytest.mark.parametrize(("start", "by", "end"), [(0, 1, 1), (0, -1, 29), (29, 1, 0), (5, -10, 25)])
def test_steps_stop_the_clock_and_go_round(start, by, end) -> None:
    clock = Clock(30, 30.0)
    clock.seek(start)
    clock.step(by)
    assert (clock.frame, clock.playing) == (end, False)
