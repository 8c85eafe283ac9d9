"""Trainings of one, two and four processes, for `test_scale`: `python -m tests.cli.scale_runs FOLDER`.

One process imports everything once and forks all others, each with the variables that torchrun would give it.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

import torch
import torch.distributed as dist

from magnet import cli
from magnet.cli import train  # noqa: F401  imported before the fork
from magnet.datamodules import synthetic  # noqa: F401
from magnet.denoiser.options import TransformerOptions
from magnet.denoiser.transformer import Transformer
from magnet.motion.tokens import TokenLayout
from tests.processes import as_by_torchrun, free_port

ROOT = Path(__file__).parents[2]
FIT = ("fit", "--config", str(ROOT / "configs" / "debug.yaml"), "--trainer.log_every_n_steps", "1")
QUIET = ("--trainer.enable_progress_bar", "false", "--data.epoch_size", "96")


DENOISER = ("fit", "--config", str(ROOT / "configs" / "fsdp_denoiser.yaml"), "--model.tokenizer", "raw")
SMALL = ("--model.network", "{width: 32, layers: 2, heads: 2, dropout: 0}", "--model.self_forcing.share", "0.5")
SWIFT = ("--model.optimizer", "{learning_rate: 0.003, warmup_steps: 1}")
FEW = ("--data.train_clips", "4", "--data.val_clips", "2", "--data.max_agents", "4", "--trainer.log_every_n_steps", "1")


def started(world: int, out: Path, *words: str) -> list[multiprocessing.Process]:
    """The processes of one training, a global batch of 16."""
    several = ("--trainer.devices", str(world), "--trainer.strategy", "ddp" if world > 1 else "auto")
    return begun(world, out, *FIT, *QUIET, *several, "--data.batch_size", str(16 // world), *words)


def cut(world: int, out: Path, *words: str) -> list[multiprocessing.Process]:
    """The processes of one training of a denoiser of two to four people, in shards where they are several."""
    alone = ("--trainer.devices", "1", "--trainer.strategy", "auto") if world == 1 else ()
    cpu = ("--trainer.accelerator", "cpu", "--trainer.precision", "32-true", "--data.batch_size", str(16 // world))
    return begun(world, out, *DENOISER, *SMALL, *SWIFT, *FEW, *QUIET, *cpu, *alone, *words)


def begun(world: int, out: Path, *words: str) -> list[multiprocessing.Process]:
    """Processes that run one command together, each with the variables that torchrun would give it."""
    port = free_port()
    every = [*words, "--out", str(out)]
    context = multiprocessing.get_context("fork")
    each = [context.Process(target=process, args=(r, world, port, every, f"{out}.{r}.log")) for r in range(world)]
    for one in each:
        one.start()
    return each  # type: ignore[return-value]


def process(rank: int, world: int, port: int, words: list[str], log: str) -> None:
    """One process of a training, its words in a file."""
    as_by_torchrun(rank, world, port)
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(file, 1)
    os.dup2(file, 2)
    sys.exit(cli.main(words))


def ended(processes: list[multiprocessing.Process], seconds: float = 120.0) -> list[int | None]:
    """Exit codes; whoever takes longer is ended."""
    until = time.monotonic() + seconds
    for one in processes:
        one.join(max(until - time.monotonic(), 0.1))
        if one.is_alive():
            one.kill()
    return [one.exitcode for one in processes]


def sharded(rank: int, world: int, folder: str) -> None:
    """Five steps of a denoiser's network whose blocks are sharded; losses and the share of weights held."""
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import fully_shard

    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet{world}", rank=rank, world_size=world)
    layout, mesh = TokenLayout(16, 2), init_device_mesh("cpu", (world,))
    torch.manual_seed(0)
    network = Transformer(layout, TransformerOptions(width=32, layers=2, heads=2)).eval()
    for block in (*network.blocks, network):
        fully_shard(block, mesh=mesh)
    optimizer, generator = torch.optim.AdamW(network.parameters(), 1e-2), torch.Generator().manual_seed(1)
    levels, present, losses = torch.full((4, 4, 2), 300), torch.ones(4, 2, dtype=torch.bool), []
    for _ in range(5):
        tokens = torch.randn(4, 4, 2, layout.width, generator=generator).chunk(world)[rank]
        rows = slice(len(tokens))
        loss = (network(tokens, levels[rows], present[rows]) - tokens).square().mean()
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        total = loss.detach().clone()
        dist.all_reduce(total)
        losses.append(float(total) / world)
    every = list(network.parameters())
    held = sum(weight.to_local().numel() for weight in every) / sum(weight.numel() for weight in every)
    Path(folder, f"sharded{world}.{rank}.json").write_text(
        json.dumps({"losses": losses, "held": held}), encoding="utf-8"
    )
    dist.destroy_process_group()


def main(folder: Path) -> None:
    """All runs; exit codes in codes.json."""
    codes = {}
    for world in (1, 2, 4):
        codes[f"of_{world}"] = ended(started(world, folder / f"of_{world}", "--trainer.max_epochs", "2"))
    for world in (4, 1):
        shutil.copytree(folder / "of_2", folder / f"on_{world}")
        words = ("--trainer.max_epochs", "3", "--ckpt_path", "last")
        codes[f"on_{world}"] = ended(started(world, folder / f"on_{world}", *words))
    long = folder / "killed"
    each = started(2, long, "--trainer.max_epochs", "1000", "--trainer.max_steps", "1000000")
    until = time.monotonic() + 100
    while not list(long.glob("checkpoints/last.ckpt.sha256")) and time.monotonic() < until:
        time.sleep(0.2)
    os.kill(each[1].pid or 0, signal.SIGKILL)
    codes["killed"] = ended(each, 60)
    shutil.copy(f"{long}.0.log", folder / "left.log")
    done = torch.load(long / "checkpoints" / "last.ckpt", weights_only=False)["epoch"]
    codes["resumed"] = ended(started(2, long, "--trainer.max_epochs", str(done + 3), "--ckpt_path", "last"))
    for world in (1, 2):
        with tempfile.TemporaryDirectory() as meet:
            context = multiprocessing.get_context("fork")
            both = [context.Process(target=sharded, args=(r, world, meet)) for r in range(world)]
            for one in both:
                one.start()
            codes[f"sharded_{world}"] = ended(both)  # type: ignore[arg-type]
            shutil.copy(Path(meet, f"sharded{world}.0.json"), folder)
    for world in (1, 2):
        codes[f"cut_{world}"] = ended(cut(world, folder / f"cut_{world}", "--trainer.max_steps", "12"))
    shutil.copytree(folder / "cut_2", folder / "cut_on")
    codes["cut_on"] = ended(cut(1, folder / "cut_on", "--trainer.max_steps", "18", "--ckpt_path", "last"))
    (folder / "codes.json").write_text(json.dumps(codes))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
