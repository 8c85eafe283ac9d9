"""Several processes as torchrun would start them, on this machine."""

from __future__ import annotations

import os
import socket

import torch


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def as_by_torchrun(rank: int, count: int, port: int) -> None:
    """Make this process one of `count`, with one thread and the variables that torchrun would give it."""
    torch.set_num_threads(1)
    told = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "LOCAL_WORLD_SIZE": count, "GROUP_RANK": 0}
    place = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "TORCHELASTIC_RUN_ID": "test"}
    os.environ.update({name: str(value) for name, value in {**told, **place}.items()})
