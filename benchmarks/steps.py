"""Quality against denoising steps on recorded test takes, of some tasks or all.

    MAGNET_CMU=... python benchmarks/steps.py --scenes 6 --samples 2 --out runs/results/steps

A row that is there already is not measured again. Rows of a task sample the same scenes with the same noise.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import lightning as L

from magnet.cli.provenance import machine, provenance
from magnet.cli.quiet import quiet
from magnet.datamodules.cmu import CMU
from magnet.datamodules.options import HeldOutScenes
from magnet.denoiser.module import Denoiser
from magnet.evaluation.evaluator import TRUTH, Evaluator
from magnet.evaluation.results import Results
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry

METRICS = ["fd_pair", "fd", "div", "fs", "ip_ratio", "mpjpe@1s", "mpjpe@5s"]
TASKS = ["joint_future", "motion_control", "agentic_async"]


def main() -> None:
    """Measure what has not been measured, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ckpt_path", default=None)
    parser.add_argument("--out", type=Path, default=Path("runs/results/steps"))
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--samples", type=int, default=2)
    parser.add_argument("--frames", type=int, default=150, help="after the context")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 2, 4, 8, 16, 30])
    parser.add_argument("--precision", default="float32", choices=["reference", "float32", "bf16", "int8"])
    parser.add_argument("--task", nargs="+", default=TASKS, choices=registry.names())
    given = parser.parse_args()
    quiet()
    warnings.filterwarnings("ignore", ".*inference tensor.*")
    file = given.out / "results.json"
    given.out.mkdir(parents=True, exist_ok=True)
    found = Results.load_json(file) if file.exists() else Results({}, {})
    model = Denoiser.load(given.ckpt_path)
    held = HeldOutScenes(limit=given.scenes, batch_size=given.scenes, horizon_frames=given.frames)
    data = CMU(singles=False, test=held, max_agents=model.layout.agents)
    for task in given.task:
        for steps in given.steps:
            name = f"{task}, {steps} steps" + (f", {given.precision}" if given.precision != "float32" else "")
            if name in found.rows:
                continue
            options = SamplerOptions(steps=steps, precision=given.precision)
            evaluator = Evaluator(model, registry.get(task)(), options, given.samples, baselines=False)
            silent = {"logger": False, "enable_checkpointing": False, "enable_model_summary": False}
            trainer = L.Trainer(accelerator="cpu", enable_progress_bar=False, **silent)  # type: ignore[arg-type]
            trainer.test(evaluator, datamodule=data, verbose=False)
            assert evaluator.results is not None
            found.rows[name] = evaluator.results.rows["magnet"]
            found.rows.setdefault(f"{task}, {TRUTH}", evaluator.results.rows[TRUTH])
            found.meta[name] = evaluator.results.meta
            found.meta.update(provenance() | {"machine": machine()})
            found.save_json(file)
            print(
                name, {metric: round(found.rows[name].get(metric, float("nan")), 4) for metric in METRICS}, flush=True
            )
    shown = [metric for metric in METRICS if metric in found.metrics]
    (given.out / "table.md").write_text(found.to_markdown(shown))
    print(found.to_markdown(shown))


if __name__ == "__main__":
    main()
