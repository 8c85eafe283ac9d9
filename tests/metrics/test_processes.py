"""Metrics over two real processes equal one pass over everything."""

from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor

from magnet.metrics import all_metrics


def draw_batches() -> list[tuple[Tensor, Tensor, Tensor]]:
    draw = torch.Generator().manual_seed(0)
    batches = []
    for scenes in (2, 3, 1):
        truth = torch.randn(scenes, 16, 3, 22, 3, generator=draw) * 0.4
        generated = truth + torch.randn(3, scenes, 16, 3, 22, 3, generator=draw) * 0.1
        batches.append((generated, truth, torch.tensor([True, True, False]).expand(scenes, 3)))
    return batches


def measure(rank: int, folder: str, shares: list[list[int]]) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=len(shares))
    metrics = all_metrics(confidence=0.9)
    batches = draw_batches()
    for index in shares[rank]:
        metrics.update(*batches[index])
    torch.save(metrics.compute(), f"{folder}/{rank}.pt")
    dist.barrier()
    dist.destroy_process_group()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The ``compute`` method")
@pytest.mark.parametrize("shares", [[[0, 1], [2]], [[0, 1, 2], []]], ids=["both have clips", "one has none"])
def test_two_processes_measure_what_one_does(tmp_path: Path, shares: list[list[int]]) -> None:
    mp.spawn(measure, args=(str(tmp_path), shares), nprocs=len(shares))
    alone = all_metrics(confidence=0.9)
    for batch in draw_batches():
        alone.update(*batch)
    expected = alone.compute()
    for rank in range(len(shares)):
        torch.testing.assert_close(torch.load(tmp_path / f"{rank}.pt"), expected, atol=1e-10, rtol=1e-12)
