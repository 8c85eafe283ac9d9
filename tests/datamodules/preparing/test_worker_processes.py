"""Processes that convert takes do not hear Ctrl+C, and end with the work."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from magnet.datamodules.preparing.worker_processes import ended_at_once, unheard_ctrl_c

pytestmark = pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="Windows has no masks of signals")


def told() -> str:
    os.kill(os.getpid(), signal.SIGINT)
    return "goes on"


def long(begun: str) -> None:
    Path(begun).touch()
    time.sleep(600)


def pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


def test_a_worker_does_not_hear_ctrl_c_and_who_started_it_does_behind_that() -> None:
    others = pool()
    with ended_at_once(others):
        with unheard_ctrl_c():
            answer = others.submit(told)
        assert answer.result() == "goes on"
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), unheard_ctrl_c():
            signal.raise_signal(signal.SIGINT)  # at this thread: another one, as of a test runner, may hear it at once
            reached = True  # and not in it
        assert reached
    finally:
        signal.signal(signal.SIGINT, before)


def test_workers_end_at_once_where_work_is_broken_off(tmp_path: Path) -> None:
    before, others = set(multiprocessing.active_children()), pool()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt), ended_at_once(others):
        others.submit(long, str(tmp_path / "begun"))
        while not (tmp_path / "begun").exists():
            assert time.monotonic() - began < 300
            time.sleep(0.05)
        raise KeyboardInterrupt
    assert time.monotonic() - began < 500
    assert set(multiprocessing.active_children()) <= before
