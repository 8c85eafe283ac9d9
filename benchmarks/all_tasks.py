"""Every task x every metric on recorded test takes, turn-taking at several offsets, guidance on and off.

    MAGNET_CMU=... python benchmarks/all_tasks.py --ckpt_path duet --out runs/results/all_tasks

One table in markdown and JSON. A run that was stopped goes on where it was; `--only` picks rows by part of a name.
Rows of one part of the table sample the same scenes with the same noise. Partner tasks score the person who is
generated, and have a ground truth of their own. "All else replaced" gives the sampler other motion wherever the task
gives nothing, which must not change a score; "pairs leak" shows what happens with the paper's literal noise levels.
"""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import lightning as L
import torch
from torch import Tensor

from magnet.baselines.predictor import Generators
from magnet.cli import run_progress
from magnet.cli.provenance import machine, provenance
from magnet.cli.quiet import quiet
from magnet.datamodules.cmu import CMU
from magnet.datamodules.options import HeldOutScenes
from magnet.denoiser.module import Denoiser
from magnet.evaluation.evaluator import TRUTH, Evaluator
from magnet.evaluation.results import Results
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.tasks.base import Task
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.joint import Generation, JointFuture
from magnet.tasks.partner import MotionControl, PartnerInpainting, PartnerPrediction

METRICS = ["fd", "div", "mi", "fs", "ip_ratio", "mpjpe@1s", "mpjpe@5s", "mpjpe_best", "mpjve", "jitter"]
PARTNER = "one person: "
REPLACED = ", all else replaced"
LEAK = ", pairs leak"


def rows(options: SamplerOptions) -> dict[str, tuple[Task, SamplerOptions]]:
    """What is measured, by the name of its row."""

    def guided(**fields: object) -> SamplerOptions:
        return replace(options, guidance=Guidance(**fields))  # type: ignore[arg-type]

    plain: dict[str, Task] = {
        "joint_future": JointFuture(),
        "generation": Generation(),
        "inbetweening, a key each 8 tokens": Inbetweening(),
        "agentic_sync": AgenticSync(),
        "agentic_async, offset 0 %": AgenticAsync(0.0),
        "agentic_async, offset 50 %": AgenticAsync(0.5),
        "agentic_async, offset 100 %": AgenticAsync(1.0),
        PARTNER + "partner_prediction": PartnerPrediction(),
        PARTNER + "motion_control": MotionControl(),
        PARTNER + "partner_inpainting": PartnerInpainting(),
    }
    guidance = {
        "joint_future, HG w = 1": guided(kind="history"),
        "joint_future, SHG w = 1": guided(kind="self"),
        "joint_future, PHG w = 1": guided(kind="partner"),
        "joint_future, SHG as printed": guided(kind="self", paper_average=True),
        "joint_future, HG w = 0.2": guided(kind="history", weight=0.2),
        "joint_future, smoothing 0.01": guided(smooth=0.01),
        "joint_future, context level 30": guided(stabilization_level=30),
        "joint_future, in strides": replace(options, pyramid_offset=0),
        "joint_future, sampled as in the paper": SamplerOptions.preset("paper", steps=options.steps),
    }
    return {name: (task, options) for name, task in plain.items()} | {
        name: (JointFuture(), changed) for name, changed in guidance.items()
    }


class Replaced(Evaluator):
    """The sampler sees other motion in place of all that the task does not give: scores must not notice."""

    def predict_joints(self, scene: Scene, samples: int, generators: Generators) -> Tensor:
        known = self.schedule(self.context, self.horizon).known.repeat_interleave(TOKEN_FRAMES, dim=0)
        keep = (
            known[: scene.frames, : scene.agents, None, None].to(scene.device) | ~scene.present[:, None, :, None, None]
        )
        other = scene.select(torch.arange(scene.scenes).roll(1))
        return super().predict_joints(
            scene.replace(
                body_rot=torch.where(keep[..., None], scene.body_rot, other.body_rot.flip(1)),
                T_world_root=torch.where(keep, scene.T_world_root, other.T_world_root.flip(1)),
            ),
            samples,
            generators,
        )


def measure(
    model: Denoiser,
    data: CMU,
    task: Task,
    options: SamplerOptions,
    samples: int,
    precision: str,
    replaced: bool = False,
) -> Results:
    """One row, with the ground truth's beside it."""
    evaluator = (Replaced if replaced else Evaluator)(model, task, options, samples, baselines=False)
    callbacks = [run_progress.progress_bar(sampling=True)]
    silent = {"logger": False, "enable_checkpointing": False, "enable_model_summary": False}
    trainer = L.Trainer(accelerator="auto", precision=precision, callbacks=callbacks, **silent)  # type: ignore[arg-type]
    trainer.test(evaluator, datamodule=data, verbose=False)
    assert evaluator.results is not None
    return evaluator.results


def leaking(model: Denoiser) -> Denoiser:
    """The same weights, with pairs as clean as their token, the paper read literally: not what they learnt."""
    layout = TokenLayout(model.layout.latent, model.layout.agents, model.layout.pairwise, "token")
    model.layout = model.transformer.layout = layout
    return model


def main() -> None:
    """Measure what has not been measured, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ckpt_path", default=None)
    parser.add_argument("--out", type=Path, default=Path("runs/results/all_tasks"))
    parser.add_argument("--samples", type=int, default=5)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--stride", type=int, default=121, help="frames between the starts of test scenes")
    parser.add_argument("--precision", default="bf16-mixed")
    parser.add_argument("--only", default="", help="rows whose name holds this")
    given = parser.parse_args()
    quiet()
    warnings.filterwarnings("ignore", ".*inference tensor.*")
    file = given.out / "results.json"
    found = Results.load_json(file) if file.exists() else Results({}, {})
    model = Denoiser.load(given.ckpt_path)
    data = CMU(singles=False, test=HeldOutScenes(stride=given.stride, batch_size=12), max_agents=model.layout.agents)
    wanted = rows(SamplerOptions(steps=given.steps))
    plain, inpainting = SamplerOptions(steps=given.steps), PARTNER + "partner_inpainting"
    wanted["joint_future" + REPLACED] = (JointFuture(), plain)
    for name in (inpainting + REPLACED, inpainting + LEAK, inpainting + LEAK + REPLACED):
        wanted[name] = (PartnerInpainting(), plain)
    for name, (task, options) in wanted.items():
        if given.only not in name or name in found.rows:
            continue
        print(name, flush=True)
        one = leaking(Denoiser.load(given.ckpt_path)) if LEAK in name else model
        results = measure(one, data, task, options, given.samples, given.precision, REPLACED in name)
        found.rows[name] = results.rows["magnet"]
        truth = f"{PARTNER if PARTNER in name else ''}{TRUTH}"
        found.rows.setdefault(truth, results.rows[TRUTH])
        found.meta[name] = results.meta
        found.meta.update(provenance() | {"machine": machine()})
        found.save_json(file)
    shown = [metric for metric in METRICS if metric in found.metrics]
    (given.out / "table.md").write_text(found.to_markdown(shown))
    print(found.to_markdown(shown))
    for name in found.rows:
        meta = found.meta.get(name, {})
        if "sampling" in meta:
            print(f"{name}: {meta['seconds']['magnet']:.0f} s, {meta['sampling']}")


if __name__ == "__main__":
    main()
