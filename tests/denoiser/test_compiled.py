"""What cannot be compiled runs as it is written, and says so once."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._dynamo.exc import TorchDynamoException

from magnet import packing
from magnet.denoiser import lean
from magnet.denoiser.compiled import Compiled
from magnet.denoiser.lean import LeanTransformer, Precision
from tests.cases import some_quick
from tests.denoiser.test_lean import network, question

QUICK = ("int8", "eager")
"""Traced, and run without what else becomes of a trace, which takes five times as long."""


def doubled(x: Tensor) -> Tensor:
    return 2 * x


def test_what_is_refused_is_not_tried_and_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "compile", lambda *_, **__: pytest.fail("it was tried"))
    run = Compiled(doubled, "sampler.compile", refused="it is packed")
    with pytest.warns(UserWarning, match="sampler.compile: goes on without, it is packed"):
        assert run(torch.ones(1)).tolist() == [2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run(torch.ones(1)).tolist() == [2]


def test_what_fails_runs_as_it_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def failing(*given: Any) -> Any:
        tried.append(given)
        raise TorchDynamoException("no C++ compiler\nand how to get one")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: failing)
    run = Compiled(doubled, "sampler.compile")
    with pytest.warns(UserWarning, match="goes on without, no C.. compiler$"):
        assert run(torch.ones(1)).tolist() == [2]
    assert run(torch.ones(1)).tolist() == [2] and len(tried) == 1


@torch.no_grad()
def test_packed_weights_of_float32_are_not_compiled() -> None:
    made = network(rope="heads")
    asked = question(made, 2, 4)
    packed = LeanTransformer(made)
    plain = packed(*asked)
    with pytest.warns(UserWarning, match="float32"):
        assert torch.equal(packed(*asked, compiled=True), plain)


@pytest.mark.parametrize(
    ("precision", "backend"), some_quick([("float32", "aot_eager"), ("int8", "aot_eager"), QUICK], QUICK)
)
@torch.no_grad()
def test_compiled_blocks_give_the_same(precision: Precision, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Traced as on any machine: without a C++ compiler, and without what is packed for a processor."""
    for module in (packing, lean):
        monkeypatch.setattr(module, "packs", lambda: False)
        monkeypatch.setattr(module, "quick_int8", lambda _: True)
    compiled, traced = torch.compile, []

    def tracing(run: Any, **how: Any) -> Any:
        traced.append(run)
        return compiled(run, backend=backend, **how)

    monkeypatch.setattr(torch, "compile", tracing)
    made = network(rope="heads")
    packed = LeanTransformer(made, precision)
    for scenes, steps in ((1, 4), (1, 5), (3, 4)):
        asked = question(made, scenes, steps)
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "sampler.compile")  # what it says where it goes on without
            torch.testing.assert_close(packed(*asked, compiled=True), packed(*asked), rtol=1e-4, atol=1e-4)
    assert len(traced) == 1
    monkeypatch.setattr(lean, "records", lambda tensor: True)  # a GPU, which records whole evaluations
    again = LeanTransformer(made, precision)
    torch.testing.assert_close(again(*asked, compiled=True), packed(*asked), rtol=1e-4, atol=1e-4)
    assert len(traced) == 1
