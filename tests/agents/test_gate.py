"""What is let in from the network, and what is not."""

from __future__ import annotations

import dataclasses
import json
import pickle
import random

import numpy as np
import pytest

from magnet.agents.gate import Gate
from magnet.agents.message import POSE, Message, pack, sealed, unpack

LATENT = 16


def gate(**options) -> Gate:
    return Gate(("A", "B"), "A", "feed", LATENT, **{"rate": 1e9, "burst": 1e9, **options})


def message(frame: int = 8, count: int = 4, token: bool = True) -> Message:
    poses = np.zeros((count, POSE), np.float32)
    poses[:, 1] = 0.9
    poses[:, 6::4] = 1.0  # w
    canonical = np.tile(np.eye(4, dtype=np.float32), (4, 1, 1)).ravel()
    told = np.concatenate([np.linspace(-1, 1, LATENT).astype(np.float32), canonical]) if token else None
    return Message("frames", "B", "B", 7, frame, 1.5, poses=poses, model="feed" if token else "", token=told)


LAGGING = dataclasses.replace(message(), lags={"A": -0.25, "\u9f8d": 0.0625})


def test_a_message_comes_back_as_it_was():
    for sent in (message(), message(9, 2, token=False), Message("hello", "B", "B", 1, -1, 0.0, heard=("A",)), LAGGING):
        back = unpack(pack(sent))
        for field in dataclasses.fields(Message):
            ours, theirs = getattr(sent, field.name), getattr(back, field.name)
            assert np.array_equal(ours, theirs) if isinstance(ours, np.ndarray) else ours == theirs
        assert gate().take(pack(sent), 0.0) is not None


def test_the_longest_names_of_any_script_fit_into_a_hello():
    names = tuple(letter * 64 for letter in "A\u9f8d\u0939\U0001f916")
    hello = Message("hello", names[3], names[3], 2**62, -1, 1.5e9, heard=names[:3])
    assert Gate(names, names[0], "", 0).take(pack(hello), 0.0) is not None


def test_lags_of_too_many_for_a_header_are_left_out():
    sent = dataclasses.replace(message(), lags={60 * "A" + str(number): 0.1 for number in range(40)})
    assert unpack(pack(sent)).lags == {} and gate().take(pack(sent), 0.0) is not None


def changed(**fields) -> list[bytes]:
    """A message with other values in its header, and the checksum of those."""
    parts = pack(message())
    return sealed([parts[0], json.dumps(json.loads(parts[1]) | fields).encode(), *parts[2:4]])


def posed(column: int, value: float) -> list[bytes]:
    sent = message()
    sent.poses[1, column] = value
    return pack(sent)


def told(number: int, value: float) -> list[bytes]:
    sent = message()
    assert sent.token is not None
    sent.token[number] = value
    return pack(sent)


WRONG = {
    "version": [changed(v=1), changed(v=3), changed(v="1")],
    "header": [
        changed(extra=1),
        changed(lags=[]), changed(lags={"A": "late"}), changed(lags={"A": None}), changed(lags={65 * "A": 0.1}),
        changed(lags={str(number): 0.1 for number in range(65)}),
        changed(frame="8"), changed(frame=8.5), changed(frame=True), changed(frame=-2),
        changed(count=5), changed(session=-1), changed(betas=[0] * 9), changed(betas=[None] * 10), changed(clock="now"),
        changed(heard="A"), changed(heard=[1]), changed(sender=3), changed(model="f" * 65), changed(clock=10**400),
        sealed([b"magnet/B", b"[" * 2000, b"", b""]), sealed([b"magnet/B", b"\xff{}", b"", b""]),
        changed(betas=[float("nan")] * 10), sealed([b"magnet/B", b"7", b"", b""]),
        changed(sender="\ud800"), changed(agent="\udfff"), changed(model="\ud800"), changed(heard=["B\ud800"]),
    ],
    "kind": [changed(kind="order"), changed(kind="hello"), changed(count=0), changed(kind=["frames"])],
    "topic": [changed(sender="A"), changed(sender="")],
    "shape": [changed(count=3), changed(model=""), sealed([*pack(message())[:3], b"\0" * 256])],
    "agent": [changed(agent="C")],
    "frame": [changed(frame=9), changed(frame=2**39), changed(frame=-1)],
    "range": [
        posed(0, np.nan), posed(2, 1e30), posed(1, 11), posed(9, np.inf), changed(betas=[11] + 9 * [0]),
        told(0, np.nan), told(0, 101), told(LATENT + 63, np.inf),
    ],
    "place": [told(LATENT + 3, 1.5)],
    "speed": [posed(0, 1.2)],
    "rotation": [posed(6, 0.9), posed(6, -1e30), told(LATENT, 1.1), told(LATENT + 7, 0.2), told(LATENT + 12, 1e-3)],
    "size": [[], pack(message())[:4], [*pack(message()), b""], sealed([b"magnet/B", b"{}", b"\0" * 70000, b""])],
    "checksum": [[*pack(message())[:4], b"\0\0\0\0"]],
}  # fmt: skip


@pytest.mark.parametrize("reason", WRONG)
def test_each_thing_that_can_be_wrong_is_refused_by_name(reason):
    for parts in WRONG[reason]:
        ours = gate()
        ours.now = 8
        assert ours.take(parts, 0.0) is None
        assert dict(ours.refused) == {reason: 1}, parts[1:2]


def test_of_ten_thousand_broken_messages_none_is_taken_and_none_harms():
    """Bits turned, bytes lost, parts cut, exchanged or made up; and numbers of any kind behind a right checksum."""
    draw, ours = random.Random(0), gate()
    ours.now = 8
    wrong = [parts for group in WRONG.values() for parts in group]
    whole = pack(message())
    for number in range(10_000):
        kind, parts = number % 5, list(draw.choice([whole, *wrong]))
        place = draw.randrange(len(parts)) if parts else 0
        part = bytearray(parts[place]) if parts else bytearray()
        if kind == 0:
            part = part or bytearray(b"?")
            for _ in range(draw.randint(1, 4)):
                part[draw.randrange(len(part))] ^= 1 << draw.randrange(8)
        elif kind == 1:
            part = part[: draw.randrange(len(part))] if len(part) else bytearray(b"?")
        elif kind == 2:
            part[draw.randint(0, len(part)) :] = draw.randbytes(draw.randint(1, 64))
        elif kind == 3:
            parts = [draw.randbytes(draw.randint(0, 300)) for _ in range(draw.randint(0, 7))]
        else:  # by somebody who knows how to seal a message
            body = [whole[0], whole[1], bytes(np.frombuffer(draw.randbytes(4 * 4 * POSE), "<f4").tobytes()), whole[3]]
            if draw.random() < 0.5:
                body[1] = bytes(draw.choice(b'"{}[]:,0-9eE.') if draw.random() < 0.05 else byte for byte in whole[1])
                body[2] = draw.randbytes(draw.randrange(2000))
                if draw.random() < 0.2:  # any letter that JSON can spell, half a surrogate pair among them
                    letter = f'"\\u{draw.randrange(0x10000):04x}"'.encode()
                    body[1] = whole[1].replace(b'"B"', letter, draw.randint(1, 2))
            parts = sealed(body)
        if kind < 3 and parts:
            parts[place] = bytes(part)
        if parts == whole:
            continue
        assert ours.take(parts, number / 100) is None, parts
    assert ours.taken == 0 and sum(ours.refused.values()) > 9_900


def test_who_sends_too_fast_for_somebody_else_or_from_an_ended_process_is_not_heard():
    ours = gate(rate=10, burst=5)
    taken = [ours.take(pack(message()), 0.001 * number) is not None for number in range(100)]
    assert sum(taken) == 5 and ours.take(pack(message()), 1.0) is not None
    assert gate().take(pack(message()), 0.0, peer="B") and not gate().take(pack(message()), 0.0, peer="C")
    ours = gate()
    assert ours.take(pack(dataclasses.replace(message(), session=9)), 0.0)
    assert not ours.take(pack(message()), 0.1) and ours.refused["session"] == 1
    mine = gate().take(sealed([b"magnet/A", pack(message())[1].replace(b'"B"', b'"A"'), *pack(message())[2:4]]), 0.0)
    assert mine is None


def test_a_token_of_another_model_does_not_matter_and_the_poses_are_taken():
    sent = dataclasses.replace(message(), model="other", token=np.full(9999, np.nan, np.float32))
    taken = gate().take(pack(sent), 0.0)
    assert taken is not None and taken.token is None and taken.model == ""
    assert np.array_equal(taken.poses, sent.poses)


def test_who_starts_again_with_a_clock_that_went_back_is_heard_once_it_was_silent_for_as_long_as_who_is_gone():
    """A robot without a battery for its clock begins at 1970; as long as the other process is heard, it stays out."""
    ours = gate()
    older = pack(dataclasses.replace(message(), session=3))
    assert ours.take(pack(message()), 0.0) and ours.take(older, 2.0) is None
    assert ours.take(older, 2.2) and ours.take(older, 2.25), "and goes on being heard"
    assert ours.take(pack(message()), 2.3), "a later session replaces at once"
    assert ours.take(older, 4.4) is None and dict(ours.refused) == {"session": 2}


def test_what_is_told_somebody_else_of_its_past_is_neither_taken_nor_refused():
    ours = Gate(("A", "B", "C"), "A", "feed", LATENT)
    ours.now = 4000  # what somebody is told who was away for long is long ago
    assert ours.take(pack(dataclasses.replace(message(token=False), agent="C")), 0.0, peer="B") is None
    assert (ours.taken, ours.passed_over, dict(ours.refused)) == (0, 1, {})
    assert ours.take(pack(dataclasses.replace(message(4000, token=False), agent="A")), 0.0, peer="B") is not None


def test_what_is_told_oneself_of_a_past_that_is_long_over_is_neither_taken_nor_refused():
    """Who comes back after ten seconds is told where it was; with many others, some tell it after its first token."""
    ours = Gate(("A", "B", "C"), "A", "feed", LATENT)
    ours.now = 428
    told = dataclasses.replace(message(72, token=False), agent="A")
    assert ours.take(pack(told), 0.0, peer="B") is None and (ours.passed_over, dict(ours.refused)) == (1, {})
    assert ours.take(pack(message(72)), 0.0, peer="B") is None and dict(ours.refused) == {"frame": 1}


def at(frame: int, x: float, count: int = 1, **fields) -> list[bytes]:
    """A message of somebody who stands at x metres."""
    sent = message(frame, count, token=False)
    sent.poses[:, 0] = x
    return pack(dataclasses.replace(sent, **fields))


def moved(**changes: float) -> list[bytes]:
    """A message in which a number of each frame, or of its token, is another: x, y, z, w, latent or beta."""
    sent = message(token="latent" in changes)
    columns = {"x": 0, "y": 1, "z": 2, "w": 6}
    for name, value in changes.items():
        if name in columns:
            sent.poses[:, columns[name]] = value
        elif sent.token is not None:
            sent.token[3] = value
    return pack(dataclasses.replace(sent, betas=(0.0, changes.get("beta", 0.0), *([0.0] * 8))))


BOUNDS = {
    "x": ([1000, -1000], [1001, -1001], "range"),
    "y": ([10, -10], [10.1, -10.1], "range"),
    "z": ([1000, -1000], [1001, -1001], "range"),
    "w": ([1.0099, 0.9901], [1.011, 0.989], "rotation"),
    "latent": ([100, -100], [100.1, -100.1], "range"),
    "beta": ([10, -10], [10.1, -10.1], "range"),
}


@pytest.mark.parametrize("name", BOUNDS)
def test_numbers_are_let_in_up_to_their_bounds_on_both_sides(name: str) -> None:
    within, beyond, reason = BOUNDS[name]
    for value in within:
        assert gate().take(moved(**{name: value}), 0.0) is not None, value
    for value in beyond:
        ours = gate()
        assert ours.take(moved(**{name: value}), 0.0) is None and dict(ours.refused) == {reason: 1}, value


@pytest.mark.parametrize(("now", "due", "first", "last"), [(400, 0, 100, 700), (400, 800, 100, 1100), (8, 8, 0, 308)])
def test_frames_of_ten_seconds_before_and_after_are_of_use(now: int, due: int, first: int, last: int) -> None:
    for frame, wanted in ((first - 4, False), (first, True), (last, True), (last + 4, False)):
        ours = gate()
        ours.now, ours.due = now, due
        if frame >= 0:
            assert (ours.take(pack(message(frame, token=False)), 0.0) is not None) == wanted, frame
            assert wanted or dict(ours.refused) == {"frame": 1}
    own = gate()
    own.now, own.due = now, due
    mine = dataclasses.replace(message(first, token=False), agent="A")
    assert own.take(pack(mine), 0.0) is not None, "of oneself, too"


def test_no_frames_are_before_the_first_ones_own_or_anothers() -> None:
    for agent, now in (("B", None), ("B", 8), ("A", 400)):
        ours = gate()
        ours.now = now
        assert ours.take(at(-1, 0.0, agent=agent), 0.0) is None
        assert (dict(ours.refused), ours.passed_over) == ({"frame": 1}, 0)


def test_so_many_messages_are_heard_at_once_and_a_second_and_silence_earns_no_more() -> None:
    ours = Gate(("A", "B"), "A", "feed", LATENT)
    parts = pack(message())

    def taken(seconds: float) -> int:
        return sum(ours.take(parts, seconds) is not None for _ in range(500))

    assert [taken(0.0), taken(1.0), taken(1.5), taken(100.0), taken(50.0)] == [240, 120, 60, 240, 0]


def test_a_token_must_be_of_this_size_upright_unmirrored_and_where_the_pelvis_is() -> None:
    def told(change) -> str:
        sent = message()
        assert sent.token is not None
        frames = sent.token[LATENT:].reshape(4, 4, 4)
        sent.poses[:, 2] += 5.0
        frames[:, 2, 3] = 5.0
        token = change(sent.token, frames)
        ours = gate()
        ours.take(pack(dataclasses.replace(sent, token=sent.token if token is None else token)), 0.0)
        return "".join(ours.refused)

    def place(row: int, metres: float):
        return lambda token, frames: frames.__setitem__((slice(None), row, 3), metres)

    assert told(lambda token, frames: None) == ""
    assert told(lambda token, frames: np.append(token, 0.0)) == "shape"
    assert told(lambda token, frames: frames.__setitem__((1, 2, 2), -1.0)) == "rotation"
    for row, near, far in ((0, 0.99, 1.01), (0, -0.99, -1.01), (2, 5.99, 6.01), (2, 4.01, 3.99)):
        assert [told(place(row, near)), told(place(row, far))] == ["", "place"]


def test_a_frame_that_is_told_again_may_be_a_metre_away_and_no_farther() -> None:
    ours = gate()
    taken = [ours.take(at(8, x), 0.0) is not None for x in (0.0, 0.9, 2.0)]
    assert taken == [True, True, False]


def test_what_is_remembered_of_places_is_the_newest_and_does_not_grow() -> None:
    ours, sizes = gate(), []
    for frame in range(0, 1600, 4):
        assert ours.take(at(frame, 0.0, 4), 0.0)
        sizes.append(len(pickle.dumps(ours)))
    assert sizes[-1] < 1.1 * sizes[len(sizes) // 2]
    assert ours.take(at(1600, 50.0), 0.0) is None and dict(ours.refused) == {"speed": 1}


def test_a_pelvis_that_jumps_from_one_message_to_the_next_is_refused():
    ours = gate()
    places = [(8, 0.0), (9, 500.0), (10, -500.0), (9, 0.9), (11, 3.1), (11, 2.8), (11, 4.2), (10, 1.85)]
    taken = [ours.take(at(*place), 0.0) is not None for place in places]
    assert taken == [True, False, False, True, False, True, False, True]
    assert dict(ours.refused) == {"speed": 4}


def test_frames_that_come_late_are_compared_with_those_before_and_behind_them():
    ours = gate()
    assert ours.take(at(12, 0.0, 4), 0.0) and ours.take(at(20, 0.0, 4), 0.0)
    assert ours.take(at(16, 30.0, 4), 0.0) is None and ours.take(at(16, 0.5, 4), 0.0)
    assert ours.take(at(16, 0.5, 4), 0.0), "told again"


def test_who_was_gone_for_two_seconds_comes_back_where_they_are_and_not_sooner():
    for away, back in ((64, False), (65, True)):
        ours = gate()
        assert ours.take(at(8, 0.0), 0.0)
        assert (ours.take(at(8 + away, 400.0), 0.0) is not None) == back
        assert (ours.take(at(9 + away, 400.5), 0.0) is not None) or not back
    ours = gate()
    assert ours.take(at(8, 0.0), 0.0)
    tries = [ours.take(at(8 + frame, 400.0), 0.0) is not None for frame in range(1, 80)]
    assert tries.index(True) == 64 and all(tries[64:]), "also who goes on telling from there"
    assert ours.take(at(88, 0.0, session=8), 0.0) is None, "a new process of theirs does not make a jump right"


def test_who_told_of_far_ahead_before_one_has_begun_jumps_no_more_than_others():
    ours = gate()
    for frame in range(4000, 4700):
        assert ours.take(at(frame, 0.0), 0.0)
    assert ours.take(at(8, 0.0), 0.0) and ours.take(at(9, 400.0), 0.0) is None and dict(ours.refused) == {"speed": 1}


def test_what_others_tell_of_somebody_binds_only_what_they_tell():
    """Who has come back is told of its own past by everybody; one who tells it wrong keeps nobody else out."""
    ours = Gate(("A", "B", "C"), "A", "feed", LATENT)
    assert ours.take(at(8, 300.0, agent="A"), 0.0, peer="B")
    mine = dataclasses.replace(message(8, 1, token=False), sender="C", agent="A")
    assert ours.take(pack(mine), 0.0, peer="C") and ours.take(at(8, 0.0), 0.0, peer="B")
