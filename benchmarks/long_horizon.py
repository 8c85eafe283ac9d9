"""Sixty seconds and more from four frames: does the motion stay real?

    MAGNET_CMU=... python benchmarks/long_horizon.py --ckpt_path duet --out runs/results/long

Continues recorded test takes from 4 context frames for `--frames` frames. Every 5 seconds of what is generated are
placed like recorded 5 seconds (one world a window, at its first frame) and compared with all recorded test windows:
FD of each window, and of all windows so far (cumulative, as paper Fig. 7). Beside it: distance of the partners, speed
of the joints, height of head and feet, which tell frozen, folded and floating bodies. Who bows, lunges or is dipped is
low, too, and recorded dancers do all three: so each pose is compared with the nearest recorded one of the training
takes, and low ones by themselves. Couples may leave the dance for another kind of scene that the model was trained on:
so each frame of both is compared with all kinds. Written: curve.png, strips, results.json, two scenes as npz, and
low.png, the lowest moments of all scenes.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import matplotlib
import torch
from torch import Tensor

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from magnet.body import Body, load_body
from magnet.body.contact import deepest
from magnet.cli.provenance import machine, provenance
from magnet.datamodules.cmu import CMU
from magnet.denoiser.module import Denoiser
from magnet.evaluation.evaluator import aligned
from magnet.export.picture import contact_sheet
from magnet.generation.rollout import generate
from magnet.metrics import FrechetDistance, frechet_distance, partner_distance
from magnet.metrics.frechet import Features, moments
from magnet.metrics.own_frame import joint_canonical_frame, seen_from
from magnet.motion.scene import Scene, concatenate
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.synthesis import synthesize
from magnet.tasks.joint import JointFuture

CONTEXT, WINDOW = 4, 150
HEAD, FEET = 15, (10, 11)
COUPLINGS = ("mirror", "follow", "handshake", "circle", "patty_cake")
STRIDE = 48
"""Frames of a stride of `duet`, twelve tokens."""
PARTED = 3.0
"""Metres between two pelvises over the ground over which couples have left each other: recorded ones come to 2.6."""
LOW = 1.1
"""A head under this height, in metres, is low: a bow, a lunge, a dip, or somebody who has folded up."""


def windows(data: CMU, split: str, stride: int = 30) -> Scene:
    """All recorded windows of a split, placed at their first frame."""
    scenes = [
        clip.scene.slice(start, start + WINDOW).replace(valid=None, names=())
        for clip in data.clips(split)  # type: ignore[arg-type]
        for start in range(0, clip.frames - WINDOW + 1, stride)
    ]
    return aligned(concatenate(scenes), 0)


def pooled(joints: Tensor, present: Tensor, features: Features = "world_joints") -> FrechetDistance:
    metric = FrechetDistance(features)
    metric.update(joints[None], joints, present)
    return metric


def distance(a: FrechetDistance, b: FrechetDistance) -> float:
    return float(
        frechet_distance(*moments(a.count[1], a.sum[1], a.outer[1]), *moments(b.count[1], b.sum[1], b.outer[1]))
    )


def drawn(joints: Tensor, present: Tensor, reference: FrechetDistance, features: Features, count: int) -> list[float]:
    """5, 50 and 95 % of the distances of `count` recorded windows, drawn 60 times: what chance gives so few.

    joints (M, T, P, 22, 3)
    """
    generator = torch.Generator().manual_seed(1)
    draws = (torch.randperm(len(joints), generator=generator)[:count] for _ in range(60))
    distances = torch.tensor([distance(pooled(joints[rows], present[rows], features), reference) for rows in draws])
    return [float(part) for part in distances.quantile(torch.tensor([0.05, 0.5, 0.95]))]


def describe(joints: Tensor, present: Tensor) -> dict[str, float]:
    """What a window looks like. joints (B, T, P, 22, 3)"""
    there = joints.transpose(1, 2)[present]
    speed = 30 * there.diff(dim=1).norm(dim=-1).mean()
    feet = there[:, :, list(FEET), 1].amin(dim=-1)
    apart = partner_distance(joints[:, :, 0], joints[:, :, 1])  # a median says nothing of one couple that has parted
    return {
        "partner distance m": float(apart.median()),
        "partner distance m, most": float(apart.max()),
        "over 3 m apart": float((apart > PARTED).float().mean()),
        "joint speed m/s": float(speed),
        "head height m, lowest": float(there[:, :, HEAD, 1].min()),
        "lower foot m, median": float(feet.median()),
        "lower foot m, highest": float(feet.max()),
        "slowest second m/s": float(slowest(there)),
        "over 10 cm deep": float((deepest(*joints.flatten(0, 1)[:, :2].unbind(dim=1)) > 0.1).float().mean()),
    }


def nearest(joints: Tensor, recorded: Tensor) -> Tensor:
    """How far each pose is from the nearest recorded one in its own frame, root mean square of the joints, in metres.

    (..., 22, 3), (M, 22, 3) -> (...,)
    """
    own, known = (seen_from(joint_canonical_frame(poses), poses).flatten(-2) for poses in (joints, recorded))
    flat = own.flatten(0, -2).split(2048)
    near = torch.cat([torch.cdist(part, known).amin(dim=1) for part in flat])
    return (near / joints.shape[-2] ** 0.5).view(own.shape[:-1])


def couples(joints: Tensor) -> Tensor:
    """Both bodies as the first sees them, and as the second does. (M, 2, 22, 3) -> (2 M, 132)"""
    both = [seen_from(joint_canonical_frame(joints[:, own])[:, None], joints).flatten(1) for own in (0, 1)]
    return torch.cat([both[0], torch.cat(both[1].chunk(2, dim=1)[::-1], dim=1)])


def kinds(joints: Tensor, known: dict[str, Tensor]) -> dict[str, float]:
    """Share of frames whose two bodies together are nearest to each kind of training scene. joints (B, T, P, 22, 3)"""
    frames = joints[:, ::5, :2].flatten(0, 1)
    shown = couples(frames)[: len(frames)]  # as the first sees both: `known` has each couple both ways
    near = torch.stack([torch.cdist(shown, each).amin(dim=1) for each in known.values()])
    return {f"like {name}": float((near.argmin(dim=0) == i).float().mean()) for i, name in enumerate(known)}


def training_kinds(data: CMU, body: Body) -> dict[str, Tensor]:
    """`couples` of the recorded takes, and of synthetic scenes of two by coupling, 30 of 5 s each."""
    found = {"salsa": torch.cat([couples(body.joints(clip.scene)[0, ::2, :2]) for clip in data.clips("train")])}
    for coupling in COUPLINGS:
        scenes = [synthesize(coupling, 2, 150, torch.Generator().manual_seed(k), body).scene for k in range(30)]
        found[coupling] = torch.cat([couples(body.joints(scene)[0, ::3, :2]) for scene in scenes])
    return found


def lows(joints: Tensor, present: Tensor, recorded: Tensor) -> dict[str, float]:
    """How often a head is low, and how far poses are from recorded ones. joints (B, T, P, 22, 3)"""
    there = joints.transpose(1, 2)[present]
    low, far = there[..., HEAD, 1] < LOW, nearest(there, recorded)
    return {
        "head low, share": float(low.float().mean()),
        "from a recorded pose m, median": float(far.median()),
        "from a recorded pose m, 99 %": float(far.flatten().quantile(0.99)),
        "low poses from one m, median": float(far[low].median()) if low.any() else 0.0,
        "low poses from one m, most": float(far[low].max()) if low.any() else 0.0,
    }


def pulse(joints: Tensor) -> float:
    """Acceleration of the joints in the worst of a stride's frames, over the mean of all: 1 where strides do not show.

    (B, T, P, 22, 3)
    """
    size = joints.diff(n=2, dim=1).norm(dim=-1).mean(dim=(0, 2, 3))
    phases = torch.stack([size[phase::STRIDE].mean() for phase in range(STRIDE)])
    return float(phases.max() / phases.mean())


def slowest(people: Tensor) -> Tensor:
    """Mean speed of the joints in the stillest second of anybody: near 0 is frozen. (M, T, 22, 3)"""
    speed = 30 * people.diff(dim=1).norm(dim=-1).mean(dim=-1)
    return speed.unfold(1, 29, 15).mean(dim=-1).min()


def measured(
    long: Scene,
    body: Body,
    reference: FrechetDistance,
    pairs: FrechetDistance,
    recorded: Tensor,
    known: dict[str, Tensor],
) -> list[dict[str, Any]]:
    """What each 5 seconds after the context are like, beside the recorded ones (placed, as pairs, pose by pose)."""
    curve: list[dict[str, Any]] = []
    so_far: list[Tensor] = []
    for start in range(CONTEXT, long.frames - WINDOW + 1, WINDOW):
        window = aligned(long.slice(start, start + WINDOW), 0)
        joints = body.joints(window)
        so_far.append(joints)
        cumulative = torch.cat(so_far)
        there = window.present.repeat(len(so_far), 1)
        curve.append(
            {
                "second": (start - CONTEXT + WINDOW) / 30,
                "fd": distance(pooled(joints, window.present), reference),
                "fd pair": distance(pooled(joints, window.present, "pair"), pairs),
                "cumulative fd": distance(pooled(cumulative, there), reference),
                "cumulative fd pair": distance(pooled(cumulative, there, "pair"), pairs),
                **describe(joints, window.present),
                **lows(joints, window.present, recorded),
                **kinds(joints, known),
            }
        )
    return curve


def options() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ckpt_path", default=None)
    parser.add_argument("--out", type=Path, default=Path("runs/results/long"))
    parser.add_argument("--frames", type=int, default=1800)
    parser.add_argument("--scenes", type=int, default=6, help="starts, evenly spaced over the test takes")
    parser.add_argument("--steps", type=int, default=SamplerOptions().steps)
    parser.add_argument(
        "--pyramid_offset", type=int, default=None, help="0: in strides; default: as tasks do by themselves"
    )
    parser.add_argument("--guidance", type=float, default=0.0, help="weight of history guidance")
    parser.add_argument(
        "--stabilization_level", type=int, help="noise level at which made tokens are shown; default: the model's"
    )
    parser.add_argument("--noise_scale", type=float, help="of new noise in denoising; default: the model's")
    parser.add_argument("--precision", choices=("bf16", "fp32"), default="fp32")
    given = parser.parse_args()
    if given.frames < WINDOW:
        parser.error(f"--frames {given.frames}: expected {WINDOW} or more, the five seconds that each number is of")
    return given


def main() -> None:
    """Generate, measure, draw."""
    given = options()
    body, model = load_body(), Denoiser.load(given.ckpt_path)
    data = CMU(singles=False, max_agents=model.layout.agents)
    starts = [
        clip.scene.slice(k * WINDOW, k * WINDOW + CONTEXT).replace(names=(f"{clip.name} [{k * WINDOW}]",), valid=None)
        for clip in data.clips("test")
        for k in range(clip.frames // WINDOW)
    ]
    chosen = [starts[i * len(starts) // given.scenes] for i in range(given.scenes)]
    guidance = Guidance(
        "history" if given.guidance else "none", given.guidance, stabilization_level=given.stabilization_level
    )
    sampler = SamplerOptions(given.steps, None, given.pyramid_offset, noise_scale=given.noise_scale, guidance=guidance)
    generator = torch.Generator().manual_seed(1111)
    began = time.perf_counter()
    with torch.autocast("cpu", torch.bfloat16, given.precision == "bf16"):
        long = generate(model, concatenate(chosen), JointFuture(), CONTEXT, given.frames, 1, sampler, generator)
    seconds = time.perf_counter() - began

    real, training = windows(data, "test"), windows(data, "train")
    real_joints = body.joints(real)
    reference = pooled(real_joints, real.present)
    pairs, others = pooled(real_joints, real.present, "pair"), body.joints(training)
    floor = distance(pooled(others, training.present), reference)
    poses = others.transpose(1, 2)[training.present].flatten(0, 1)
    curve = measured(long, body, reference, pairs, poses, training_kinds(data, body))
    facts = {
        "floor: training windows against test windows": floor,
        "floor of FD pair": distance(pooled(others, training.present, "pair"), pairs),
        "FD of as many training windows": drawn(others, training.present, reference, "world_joints", len(chosen)),
        "FD pair of as many training windows": drawn(others, training.present, pairs, "pair", len(chosen)),
        "recorded": describe(real_joints, real.present) | lows(real_joints, real.present, poses),
        "recorded, training takes": describe(others, training.present),
        "head low in training takes, share": float((poses[:, HEAD, 1] < LOW).float().mean()),
        "pulse of strides after 5 s": pulse(body.joints(long.slice(CONTEXT + WINDOW, long.frames))),
        "pulse of recordings": pulse(real_joints),
        "finite": all(bool(value.isfinite().all()) for value in long.tensors().values()),
        "seconds": round(seconds, 1),
        "frames a second": round(given.frames * len(chosen) / seconds, 1),
        "options": {key: str(value) for key, value in vars(given).items()},
    }
    given.out.mkdir(parents=True, exist_ok=True)
    content = {"facts": facts, "curve": curve, "meta": provenance() | {"machine": machine()}}
    (given.out / "results.json").write_text(json.dumps(content, indent=1, default=str))
    draw(curve, floor, given.out / "curve.png")
    for b in range(min(2, long.scenes)):
        moments_shown = [CONTEXT + round(i * (given.frames - 1) / 8) for i in range(9)]
        one = long.select([b])
        contact_sheet(
            [("", one)], given.out / f"strip_{b}.png", frames=moments_shown, context_frames=CONTEXT, body=body
        )
        one.save(given.out / f"scene_{b}.npz")
    draw_lows(long, body, given.out / "low.png")
    print(json.dumps(facts, indent=1))
    for row in curve:
        print({key: round(value, 3) for key, value in row.items()})


def draw_lows(long: Scene, body: Body, path: Path) -> None:
    """The scenes in which a head is lowest, a second and a half before and after."""
    heads = body.joints(long)[..., HEAD, 1].masked_fill(~long.present[:, None], torch.inf).amin(dim=-1)
    rows = []
    for b in heads.amin(dim=1).argsort()[:6].tolist():
        begins = max(0, min(int(heads[b].argmin()) - 45, long.frames - 91))
        rows.append((f"{(begins - CONTEXT) / 30:.0f} s", long.select([b]).slice(begins, begins + 91)))
    contact_sheet(rows, path, frames=list(range(0, 91, 10)), context_frames=0, body=body)


def draw(curve: list[dict[str, Any]], floor: float, path: Path) -> None:
    """FD over time, each window's and cumulative."""
    figure, axes = plt.subplots(figsize=(6, 3.2), dpi=150)
    seconds = [row["second"] for row in curve]
    axes.plot(seconds, [row["cumulative fd"] for row in curve], color="#377fdd", label="all so far")
    axes.plot(seconds, [row["fd"] for row in curve], ".", color="#f0911d", label="each 5 s")
    axes.axhline(floor, color="#888888", lw=1, ls="--", label="recorded training takes")
    axes.set(xlabel="seconds generated from 4 frames", ylabel="FD, m²", ylim=(0, None))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    main()
