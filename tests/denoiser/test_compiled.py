"""What cannot be compiled runs as it is written, and says so once."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._dynamo.exc import TorchDynamoException

from magnet.denoiser.compiled import Compiled
from magnet.denoiser.lean import LeanTransformer
from magnet.precision import quick_int8
from tests.denoiser.test_lean import network, question


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


@pytest.mark.slow
@pytest.mark.skipif(not quick_int8(torch.device("cpu")), reason="only int8 is compiled on a CPU, and this one has none")
@torch.no_grad()
def test_compiled_blocks_give_the_same_to_the_rounding_of_int8() -> None:
    made = network(rope="heads")
    packed = LeanTransformer(made, "int8")
    for scenes, steps in ((1, 4), (1, 5), (3, 4)):
        asked = question(made, scenes, steps)
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "sampler.compile")
            compiled = packed(*asked, compiled=True)
        torch.testing.assert_close(compiled, packed(*asked), rtol=0.02, atol=0.02 * float(compiled.std()))
