"""The message between agents, version 2: what docs/agents.md describes, as bytes and back, and nothing of the network.

Five parts: topic, header (JSON), poses, token, checksum. Another layout is another version, and so is a field more.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NoReturn

import numpy as np

VERSION = 2
"""It was 1 before a header had `lags`."""
JOINTS = 21
POSE = 3 + 4 + 4 * JOINTS
"""Numbers of a pose: the pelvis's place and rotation, and the rotation of each body joint; quaternions as x y z w."""
TOKEN = 4
"""Frames of a token."""
PLACED = TOKEN * 16
"""Numbers of a token after its latent: four canonical frames."""
PARTS = 5
"""Parts of a message."""
LARGEST = 65536
"""Bytes of a message, at most."""
HEADER = 2048
"""Bytes of a header, at most."""
LONGEST = 64
"""Letters of a name, at most."""
LAGS = "lags"
"""The one field of a header that may be left out."""
KEYS = {"v", "kind", "agent", "sender", "session", "frame", "count", "clock", "betas", "model", "heard"}

Kind = Literal["frames", "hello"]


class RefusedMessage(ValueError):
    """A message that is not taken; says why in few words."""


@dataclass(frozen=True)
class Message:
    """What one process tells the others.

    Attributes:
        kind: `frames` of one token, or `hello`: I am here, I have heard these, send me what I have missed.
        agent: whose frames these are; another's than the sender's, where somebody who has come back is told its past.
        session: when the sender's process began, in nanoseconds; a later one replaces an earlier one.
        frame: number of the first frame, 0 is the first after the start scene; of a hello the next one, -1: none yet.
        clock: the sender's, in seconds.
        poses: (F, 91) float32.
        model: fingerprint of the model that `token` is of; empty: no token.
        token: (C + 64,) float32, the normalized latent and four canonical frames (4, 4, 4).
        heard: of whom a hello's sender has heard.
        lags: seconds by which others' tokens come to the sender later than it tells its own.
    """

    kind: Kind
    agent: str
    sender: str
    session: int
    frame: int
    clock: float
    betas: tuple[float, ...] = (0.0,) * 10
    poses: np.ndarray = field(default_factory=lambda: np.zeros((0, POSE), np.float32))
    model: str = ""
    token: np.ndarray | None = None
    heard: tuple[str, ...] = ()
    lags: Mapping[str, float] = field(default_factory=dict)


def pack(message: Message) -> list[bytes]:
    """The parts of a message."""
    header: dict[str, Any] = {
        "v": VERSION, "kind": message.kind, "agent": message.agent, "sender": message.sender,
        "session": message.session, "frame": message.frame, "count": len(message.poses), "clock": message.clock,
        "betas": list(message.betas), "model": message.model, "heard": list(message.heard),
    }  # fmt: skip
    token = b"" if message.token is None else message.token.astype("<f4").tobytes()
    text = _text_of(header | {LAGS: {name: round(each, 4) for name, each in message.lags.items()}})
    if not message.lags or len(text) > HEADER:  # of very many with long names
        text = _text_of(header)
    return sealed([f"magnet/{message.sender}".encode(), text, message.poses.astype("<f4").tobytes(), token])


def _text_of(header: Mapping[str, Any]) -> bytes:
    return json.dumps(header, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def sealed(parts: Sequence[bytes]) -> list[bytes]:
    """Parts with their checksum: CRC-32 of each part after its length, as four bytes, little-endian."""
    sum32 = 0
    for part in parts:
        sum32 = zlib.crc32(part, zlib.crc32(struct.pack("<I", len(part)), sum32))
    return [*parts, struct.pack("<I", sum32)]


def unpack(parts: Sequence[bytes]) -> Message:
    """A message of the right form; what its numbers say is not looked at (`magnet.agents.gate`).

    Raises:
        RefusedMessage: anything else.
    """
    if len(parts) != PARTS or sum(map(len, parts)) > LARGEST or len(parts[1]) > HEADER:
        raise RefusedMessage("size")
    if sealed(parts[:4])[4] != parts[4]:
        raise RefusedMessage("checksum")
    header = _header(parts[1])
    count = _whole(header["count"], 0, TOKEN)
    kind = header["kind"]
    if kind not in ("frames", "hello") or (count == 0) != (kind == "hello"):
        raise RefusedMessage("kind")
    sender, agent, model = (_text(header[name]) for name in ("sender", "agent", "model"))
    if parts[0] != f"magnet/{sender}".encode():
        raise RefusedMessage("topic")
    if len(parts[2]) != 4 * POSE * count or len(parts[3]) % 4 or bool(parts[3]) != bool(model):
        raise RefusedMessage("shape")
    if model and (count != TOKEN or len(parts[3]) <= 4 * PLACED):
        raise RefusedMessage("shape")
    betas, heard, lags = header["betas"], header["heard"], header.get(LAGS, {})
    if not isinstance(betas, list) or len(betas) != 10 or not isinstance(heard, list) or len(heard) > 64:
        raise RefusedMessage("header")
    if not isinstance(lags, dict) or len(lags) > 64:
        raise RefusedMessage("header")
    return Message(
        kind, agent, sender, _whole(header["session"], 0, 2**63), _whole(header["frame"], -1, 2**40),
        _number(header["clock"]), tuple(_number(each) for each in betas),
        np.frombuffer(parts[2], "<f4").reshape(count, POSE), model,
        np.frombuffer(parts[3], "<f4") if model else None, tuple(_text(each) for each in heard),
        {_text(name): _number(each) for name, each in lags.items()},
    )  # fmt: skip


def _header(text: bytes) -> dict[str, Any]:
    try:
        header = json.loads(text.decode(), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise RefusedMessage("header") from error
    if isinstance(header, dict) and "v" in header and header["v"] != VERSION:  # whose other fields may be others
        raise RefusedMessage("version")
    if not isinstance(header, dict) or header.keys() - {LAGS} != KEYS:
        raise RefusedMessage("header")
    return header


def _refuse(word: str) -> NoReturn:
    raise RefusedMessage("header")


def _whole(value: object, least: int, most: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise RefusedMessage("header")
    return value


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:  # nor is NaN
        raise RefusedMessage("header")
    return float(value)


def _text(value: object) -> str:
    if not isinstance(value, str) or len(value) > LONGEST:
        raise RefusedMessage("header")
    try:
        value.encode()
    except UnicodeEncodeError as error:  # half of a surrogate pair: JSON may hold it, UTF-8 does not
        raise RefusedMessage("header") from error
    return value
