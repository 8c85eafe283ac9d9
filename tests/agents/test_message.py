"""The message as bytes: what docs/agents.md says, written and read by nothing of ours, and the ends of its ranges."""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from magnet.agents.message import Message, RefusedMessage, pack, sealed, unpack

POSES = np.linspace(-2, 2, 4 * 91, dtype=np.float32).reshape(4, 91)
TOKEN = np.linspace(-1, 1, 70, dtype=np.float32)
FIELDS: dict[str, Any] = {
    "v": 2, "kind": "frames", "agent": "B", "sender": "Zo\u00eb", "session": 7, "frame": 8, "count": 4, "clock": 1.5,
    "betas": [0.5] * 10, "model": "feed", "heard": ["A"],
}  # fmt: skip
SENT = Message("frames", "B", "Zo\u00eb", 7, 8, 1.5, (0.5,) * 10, POSES, "feed", TOKEN, ("A",))


def checksum(parts: list[bytes]) -> bytes:
    """Over each part after its length."""
    return struct.pack("<I", zlib.crc32(b"".join(struct.pack("<I", len(part)) + part for part in parts)))


def by_hand(poses: np.ndarray = POSES, token: np.ndarray = TOKEN, room: int = 0, **fields: Any) -> list[bytes]:
    """A message as the docs have it; `room`: so many bytes of header, filled with spaces."""
    said = FIELDS | {"count": len(poses)} | fields
    header = json.dumps(said, ensure_ascii=False).encode()
    parts = [
        f"magnet/{said['sender']}".encode(),
        header + b" " * max(room - len(header), 0),
        struct.pack(f"<{poses.size}f", *poses.ravel().tolist()),
        struct.pack(f"<{token.size}f", *token.tolist()),
    ]
    return [*parts, checksum(parts)]


def same(one: Message, other: Message) -> bool:
    tokens = (one.token, other.token)
    alike = all(each is None for each in tokens) or np.array_equal(*tokens)  # type: ignore[arg-type]
    plain = (replace(each, poses=POSES, token=None) for each in (one, other))
    return (
        alike and np.array_equal(one.poses, other.poses) and [*plain].count(replace(one, poses=POSES, token=None)) == 2
    )


def test_the_bytes_are_those_that_are_documented() -> None:
    topic, header, poses, token, end = pack(SENT)
    wanted = by_hand()
    assert (topic, poses, token) == (wanted[0], wanted[2], wanted[3])
    assert json.loads(header.decode()) == FIELDS
    assert end == checksum([topic, header, poses, token])


def test_what_is_written_as_documented_is_read() -> None:
    assert same(unpack(by_hand()), SENT)
    bare = unpack(by_hand(POSES[:2], np.zeros(0), model="", frame=10))
    assert same(bare, replace(SENT, poses=POSES[:2], model="", token=None, frame=10))
    hello = unpack(by_hand(POSES[:0], np.zeros(0), kind="hello", model="", frame=-1))
    assert same(hello, replace(SENT, kind="hello", poses=POSES[:0], model="", token=None, frame=-1))


def test_another_version_is_told_as_that_whatever_fields_it_has() -> None:
    plain = by_hand(POSES[:0], np.zeros(0), kind="hello", model="", frame=-1)
    assert unpack(plain).kind == "hello"
    for fields in ({"v": 1}, {"v": 3, "mood": "fine"}, {"v": "2"}):
        with pytest.raises(RefusedMessage, match=r"^version$"):
            unpack(by_hand(POSES[:0], np.zeros(0), **{"kind": "hello", "model": "", "frame": -1} | fields))
    with pytest.raises(RefusedMessage, match=r"^header$"):
        unpack(by_hand(mood="fine"))


RANGES: dict[str, tuple[list[Any], list[Any]]] = {
    "session": ([0, 2**63], [-1, 2**63 + 1]),
    "frame": ([-1, 0, 2**40], [-2, 2**40 + 1]),
    "clock": ([0, -1e299, 1e299], [1e301, -1e301, math.inf, -math.inf, math.nan, True, "1"]),
    "betas": ([[0] * 10, [-1e299] * 10], [[0.0] * 11, [True] * 10, [math.inf] * 10, [math.nan] * 10]),
    "heard": ([[], ["A" * 64] * 20, ["A"] * 64], [["A"] * 65, ["A" * 65], [None]]),
    "agent": (["", "\u9f8d" * 64], ["A" * 65]),
    "sender": (["B" * 64], ["B" * 65]),
    "model": (["f" * 64], ["f" * 65]),
}


@pytest.mark.parametrize("field", RANGES)
def test_the_ends_of_a_fields_range_are_taken_and_nothing_beyond_them(field: str) -> None:
    within, beyond = RANGES[field]
    for value in within:
        unpack(by_hand(**{field: value}))
    for value in beyond:
        with pytest.raises(RefusedMessage, match="header"):
            unpack(by_hand(**{field: value}))


def test_the_ends_of_sizes_are_taken_and_nothing_beyond_them() -> None:
    unpack(by_hand(room=2048))
    with pytest.raises(RefusedMessage, match="size"):
        unpack(by_hand(room=2049))
    rest = sum(map(len, by_hand(token=np.zeros(0), room=400)))  # a multiple of four with so much header
    most = (65536 - rest) // 4
    assert sum(map(len, by_hand(token=np.zeros(most), room=400 + (65536 - rest) % 4))) == 65536
    unpack(by_hand(token=np.zeros(most), room=400 + (65536 - rest) % 4))
    with pytest.raises(RefusedMessage, match="size"):
        unpack(by_hand(token=np.zeros(most), room=401 + (65536 - rest) % 4))


def test_a_token_has_a_latent_and_four_frames_and_comes_with_four_poses() -> None:
    unpack(by_hand(token=TOKEN[:65]))
    cut = by_hand()[:4]
    cut[3] = cut[3][:-1]
    for wrong in (
        by_hand(token=TOKEN[:64]),
        by_hand(token=TOKEN[:49]),
        by_hand(POSES[:3]),
        by_hand(token=np.zeros(0)),
        sealed(cut),
    ):
        with pytest.raises(RefusedMessage, match="shape"):
            unpack(wrong)


def test_what_json_has_no_word_for_is_not_sent() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        pack(replace(SENT, clock=math.nan))
