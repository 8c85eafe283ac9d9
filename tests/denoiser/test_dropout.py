"""Dropout by draws of sixteen bits: as often as it says, unbiased, and reproducible."""

import pytest
import torch

from magnet.denoiser.dropout import DRAWS, Dropout


@pytest.mark.parametrize("p", [0.05, 0.5, 0.9])
def test_as_many_are_dropped_as_it_says_and_the_rest_makes_up_for_them(p):
    torch.manual_seed(0)
    x = torch.ones(1000, 1001)
    out = Dropout(p).train()(x)
    deviation = (p * (1 - p) / x.numel()) ** 0.5
    assert abs(float((out == 0).double().mean()) - p) < 5 * deviation
    assert torch.allclose(out[out != 0], torch.tensor(1 / (1 - round(p * DRAWS) / DRAWS)))
    assert abs(float(out.double().mean()) - 1) < 5 * deviation / (1 - p)


def test_each_of_the_four_numbers_of_a_draw_is_dropped_by_itself():
    torch.manual_seed(0)
    gone = (Dropout(0.5).train()(torch.ones(200_000, 4)) == 0).double()
    assert torch.allclose(gone.mean(dim=0), torch.tensor(0.5).double(), atol=0.01)
    assert torch.allclose(torch.corrcoef(gone.T), torch.eye(4).double(), atol=0.01)


@pytest.mark.parametrize("shape", [(3,), (2, 5, 7), (0, 4)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_any_shape_and_precision(shape, dtype):
    x = torch.ones(shape, dtype=dtype)
    out = Dropout(0.3).train()(x)
    assert out.shape == x.shape and out.dtype == dtype


def test_gradients_are_those_of_what_was_kept():
    torch.manual_seed(0)
    x = torch.randn(50, 40, requires_grad=True)
    out = Dropout(0.3).train()(x)
    out.sum().backward()
    assert torch.allclose(x.grad * x.detach(), out.detach())


def test_the_same_seed_drops_the_same_and_nothing_is_dropped_out_of_training():
    x = torch.randn(40, 40)
    drop = Dropout(0.3).train()
    torch.manual_seed(1)
    first = drop(x)
    torch.manual_seed(1)
    assert torch.equal(drop(x), first)
    assert not torch.equal(drop(x), first)
    assert drop.eval()(x) is x
    assert Dropout(0.0).train()(x) is x
    assert torch.equal(Dropout(1.0).train()(x), torch.zeros_like(x))
