"""A stranger's metric that fails while it measures has no numbers, says so once, and costs nobody else theirs."""

from __future__ import annotations

import copy
import pickle
import re
from typing import Any, ClassVar

import pytest
import torch
from torchmetrics import MetricCollection

from magnet.metrics import Column, MotionMetric
from magnet.metrics.guarded import Guarded, guarded, lost_numbers
from tests.metrics.batches import draw_batch
from tests.metrics.test_registry import Calls, Heads


class Divides(Heads):
    def measure(self, futures):
        return 1 / 0


class Exits(Heads):
    def measure(self, futures):
        raise SystemExit("bye")


class Bare(Heads):
    def measure(self, futures):
        return super().measure(futures)[0]


class Twice(Heads):
    def measure(self, futures):
        return super().measure(futures) * 2


class Half(Heads):
    """The first of its two names is as it should be."""

    columns: ClassVar = {"one": Column("one", "m", "low", "one"), "two": Column("two", "m", "low", "two")}

    def measure(self, futures):
        return [*super().measure(futures), None]


class Framewise(Heads):
    def measure(self, futures):
        return [(futures.generated[0, ..., 0, 15, 1], futures.scored[..., 0])]


class Sums(Calls):
    result: ClassVar[Any] = None

    def compute(self):
        return super().compute() if self.result is None else self.result


class Computes(Sums):
    result: ClassVar = {"calls": torch.zeros(2)}


class Number(Sums):
    result: ClassVar = torch.tensor(3.0)


class Taken(Sums):
    result: ClassVar = {"fs": torch.tensor(3.0)}


def made(kind: type[MotionMetric], name: str = "theirs") -> Guarded:
    metric = guarded(kind)(fps=30.0)
    metric.start_guard(name, f"their-package {kind.__name__}", {"fs"})
    return metric


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Divides, "ZeroDivisionError: division by zero"),
        (Exits, "SystemExit: bye"),
        (Bare, r"TypeError: Bare.measure gave \[a tensor \(3,\), a tensor \(3,\)\], expected a list of a pair"),
        (Twice, "TypeError: Twice.measure gave .* for each of head_height"),
        (Half, r"TypeError: Half.measure gave .*, expected a list of a pair .* for each of one, two"),
        (Framewise, r"expected a list of a pair .* tensors of shape \(3,\)"),
        (Computes, "RuntimeError: "),
        (Number, r"TypeError: compute\(\) gave Tensor, expected a dict of one number a name"),
        (Taken, r"ValueError: compute\(\) gave fs, which is measured already"),
    ],
)
def test_one_that_fails_has_no_numbers_and_is_named_once(kind: type[MotionMetric], said: str) -> None:
    generated, truth, present = draw_batch()
    collections = [MetricCollection({"theirs": made(kind), "heads": Heads()}, compute_groups=False) for _ in range(2)]
    with pytest.warns(UserWarning) as warned:
        for each in collections:
            for _ in range(2):
                each.update(generated, truth, present)
            assert set(each.compute()) == {"head_height"}
    (told,) = warned
    pattern = rf"metric theirs is left out, it fails: .*{said}.*\(of their-package {kind.__name__}\)"
    assert re.fullmatch(pattern, str(told.message), re.DOTALL)
    assert lost_numbers(collections) == set(kind.columns)


def test_one_that_works_measures_as_without_a_guard() -> None:
    generated, truth, present = draw_batch()
    plain, guard = Heads(confidence=0.9), guarded(Heads)(confidence=0.9)
    guard.start_guard("theirs", "their-package", ())
    assert guard(generated, truth, present).keys() == plain(generated, truth, present).keys()
    guard, again = pickle.loads(pickle.dumps(guard)), copy.deepcopy(guard)
    for metric in (plain, guard, again):
        metric.update(generated, truth, present)
        assert isinstance(metric, Heads)
    assert plain.compute() == guard.compute() == again.compute()
    assert lost_numbers([MetricCollection({"theirs": guard})]) == set()


def test_one_that_failed_in_another_process_is_left_out_here_too() -> None:
    metric = made(Sums)
    metric.distributed_available_fn = lambda: True
    metric.dist_sync_fn = lambda state, group=None: [state, state + 1]  # the other one's calls and failures
    metric.update(*draw_batch())
    assert metric.compute() == {} and metric.lost
