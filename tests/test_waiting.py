"""Off a CPU nothing looks at numbers."""

from __future__ import annotations

import pytest
import torch

from magnet.waiting import as_off_cpu, constant, may_look
from tests.counting import Counting

CPU = torch.device("cpu")


def test_only_a_cpus_numbers_are_looked_at() -> None:
    assert may_look(CPU)
    assert not may_look(torch.device("cuda"))
    assert not may_look(torch.device("meta"))


def test_within_as_off_cpu_a_cpu_is_as_a_gpu_and_afterwards_itself() -> None:
    with as_off_cpu():
        assert not may_look(CPU)
        with as_off_cpu():
            assert not may_look(CPU)
        assert not may_look(CPU)
    assert may_look(CPU)
    with pytest.raises(KeyError), as_off_cpu():
        raise KeyError
    assert may_look(CPU)


def test_a_constant_is_sent_once() -> None:
    like = torch.zeros(2, dtype=torch.float64)
    first = constant((1, 2.5, 7), like)
    assert first.dtype == torch.float64 and first.tolist() == [1, 2.5, 7]
    with Counting() as counted:
        assert constant((1, 2.5, 7), like) is first
    assert counted.sent == 0
    with torch.inference_mode():
        made = constant((3, 1, 4, 1, 5, 9.25), like)
    assert not made.is_inference()
