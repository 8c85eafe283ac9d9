"""Packed layers give what plain ones do, as far as their numbers are rounded."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from magnet import packing
from magnet.packing import int8_linear_of, linear_of


def layer(inputs: int = 24, outputs: int = 40) -> tuple[Tensor, Tensor, Tensor]:
    """Weights, bias, and what comes in: rows of very different size."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(2, 9, inputs, generator=generator) * torch.logspace(-3, 3, 9)[:, None]
    weight = torch.randn(outputs, inputs, generator=generator) * torch.logspace(-2, 1, outputs)[:, None]
    return weight, torch.randn(outputs, generator=generator), x


def expected(weight: Tensor, bias: Tensor, x: Tensor, gelu: bool, plus: Tensor | None) -> Tensor:
    made = F.linear(x, weight, bias)
    return F.gelu(made) if gelu else made if plus is None else plus + made


@pytest.mark.parametrize("form", ["plain", "gelu", "plus"])
@pytest.mark.parametrize("quick", [True, False])
@pytest.mark.parametrize("shape", [(24, 40), (7, 3), (64, 256)], ids=str)
def test_int8_is_off_by_rounding_alone(
    form: str, quick: bool, shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rounding to 127 steps of a row's and of an output's largest number, whatever their sizes are."""
    if not quick:
        monkeypatch.setattr(packing, "quick_int8", lambda device: False)
    weight, bias, x = layer(*shape)
    plus = torch.randn(2, 9, shape[1]) if form == "plus" else None
    made = int8_linear_of(weight, bias)(x, form == "gelu", plus)
    most = weight.abs().amax(1) * x.abs().amax(-1, keepdim=True) * (shape[0] / 127) * 1.01
    assert ((made - expected(weight, bias, x, form == "gelu", plus)).abs() <= 1.2 * most + 1e-5).all()
    exact = linear_of(weight, bias, torch.float32)(x, form == "gelu", plus)
    torch.testing.assert_close(exact, expected(weight, bias, x, form == "gelu", plus), rtol=1e-4, atol=1e-3)


def test_a_row_of_int8_does_not_depend_on_the_others() -> None:
    weight, bias, x = layer()
    run = int8_linear_of(weight, bias)
    whole = run(x)
    for scene in range(2):
        for row in range(9):
            assert torch.equal(run(x[scene : scene + 1, row : row + 1])[0, 0], whole[scene, row])


def test_int8_of_nothing_is_the_bias() -> None:
    weight, bias, x = layer()
    weight[3] = 0
    made = int8_linear_of(weight, bias)(torch.zeros_like(x))
    assert torch.equal(made, bias.expand_as(made))
    assert torch.equal(int8_linear_of(weight, bias)(x)[..., 3], bias[3].expand(2, 9))
