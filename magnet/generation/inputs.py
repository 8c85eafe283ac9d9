"""What a model is to continue: checked before anything is sampled, with what to do, and filled up to whole tokens."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from magnet.body.base import MOST_SHAPE
from magnet.body.floor import MOMENTS, lowest, off_floor, open_body
from magnet.checks import require_whole
from magnet.denoiser.core import DenoiserCore
from magnet.denoiser.token_core import TokenModelCore
from magnet.errors import warn_user
from magnet.export.misread import misread, steps_of
from magnet.generation.conditioning import label
from magnet.motion.required import require_rate
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES

ROUNDED = 0.05
"""What a rotation's columns may be off: half precision and careless interpolation are not refused, scales are."""

ANY_FLOOR = (
    "give magnet.load(name, sampler=SamplerOptions(any_floor=True)), of magnet.sampling.options, or "
    "--sampler.any_floor true"
)


def check_request(
    model: DenoiserCore, scene: Scene, context: int, frames: int | None, samples: int, task: object = None
) -> None:
    """Refuse what cannot be sampled whatever the task, and a task's name or class in its place.

    Raises:
        ValueError: a model that was not trained, no scenes, people or frames that fit the model, another frame rate,
            or counts that are none.
    """
    if isinstance(task, type) or not (task is None or hasattr(task, "schedule")):
        raise ValueError(f'task: got {task!r}, expected a task, such as magnet.tasks.registry.get("joint_future")()')
    model.require_tokenizer()
    model.require_statistics()
    require_whole("context", context, 0)
    if context % TOKEN_FRAMES:
        raise ValueError(
            f"context of {context} frames is not a multiple of {TOKEN_FRAMES}: cut the scene to whole tokens"
        )
    if frames is not None:
        require_whole("frames", frames, 0)
    require_whole("samples", samples, 1)
    if not scene.scenes:
        raise ValueError("got an empty batch of 0 scenes, expected at least one")
    if scene.agents > model.layout.agents:
        raise ValueError(f"the scene has {scene.agents} agents, the model was built for {model.layout.agents}")
    require_rate(scene)


def other_body(model: TokenModelCore, body: str, people: Literal["files", "data", "fixed"] = "files") -> str | None:
    """Says that people have another body than those whom a model learned from; None: they have the same.

    Args:
        model: which may not know its body, and then nothing is said.
        body: the people's, its id.
        people: are of files, of a data set, or of what always has this body.
    """
    trained = model.trained_body
    if trained in (None, body):
        return None
    if people == "fixed":
        advice = "take a model that was trained with theirs"
    else:
        file, none = {
            "files": ("body=FILE, or --body FILE", "the body"),
            "data": ("--data.body_model FILE", "--data.body_model"),
        }[people]
        advice = f"leave {none} out" if trained == open_body().id else f"give its file: {file}"
    return (
        f"the model was trained with body {trained!r}, but these people have {body!r}, whose shape numbers mean "
        f"something else; {advice}"
    )


def warn_of_body(model: DenoiserCore, scene: Scene) -> None:
    """Warns whoever uses a model where `other_body` says something."""
    if (said := other_body(model, scene.body)) is not None:
        warn_user(said)


def check_condition(cond: Tensor | None, scenes: int, weight: float) -> None:
    """Refuse conditions of another number of scenes, and a weight of guidance by none.

    Raises:
        ValueError: what was got and expected.
    """
    if cond is not None and not (isinstance(cond, Tensor) and cond.dim()):
        raise ValueError(f"cond: got {type(cond).__name__}, expected a tensor, a condition for each scene")
    if cond is not None and len(cond) != scenes:
        raise ValueError(f"cond: got {len(cond)} conditions, expected one for each of {scenes} scenes")
    if cond is None and weight:
        raise ValueError(
            f"guidance.cond_weight: got {weight:g} and no condition to guide by; give `cond`, or leave it at 0"
        )


def check_given(scene: Scene, known: Tensor, any_floor: bool = False) -> None:
    """Refuse given motion that is not valid; what is not given may hold anything. known (N, P) bool

    Args:
        scene: B recordings; of frames beyond them nothing is known.
        known: token steps that are read.
        any_floor: accept people who stand far from y = 0, and whatever looks like another unit or up axis.

    Raises:
        ValueError: NaN, infinities or what is no rotation, another unit than metres or axis than y, or everybody
            stands far from the floor; names scene, agent and frame, and what to do.
    """
    unshaped = ~(scene.betas.abs() <= MOST_SHAPE).all(dim=-1) & scene.present  # also of NaN
    if bool(unshaped.any()):
        b, agent = unshaped.nonzero()[0].tolist()
        most = float(scene.betas[b, agent].abs().max())
        said = f"go up to {most:.3g}, expected at most {MOST_SHAPE:g}" if math.isfinite(most) else "are not finite"
        raise ValueError(f"{label(scene, b)}, agent {agent}: betas {said}; zeros are an average body")
    keep = known.repeat_interleave(TOKEN_FRAMES, dim=0)[: scene.frames].to(scene.device)
    frames = keep.any(dim=1).nonzero()[:, 0]
    if not len(frames):
        return
    part = scene.frames_at(frames)
    counts = keep[frames] & scene.present[:, None]  # (B, F, P)
    if not bool(counts.any()):
        return
    finite = part.body_rot.flatten(3).isfinite().all(-1) & part.T_world_root.flatten(3).isfinite().all(-1)  # (B, F, P)
    _refuse(~finite & counts, frames, scene, "is not finite: fill such frames in, as with the last finite pose")
    _refuse(
        ~_rigid(part) & counts,
        frames,
        scene,
        "is no rotation, or no rigid transform: expected body_rot of orthonormal columns, T_world_root with these and "
        "0 0 0 1 below them",
    )
    if any_floor:
        return
    few = torch.linspace(0, len(frames) - 1, min(len(frames), MOMENTS), device=scene.device).long()
    moments = part.frames_at(few)
    low = lowest(moments)
    if strange := misread(moments, counts[:, few], low, steps_of(part, counts, frames, MOMENTS)):
        raise ValueError(f"{label(scene, strange[0])}: {strange[1]}; if it is really so, {ANY_FLOOR}")
    off = off_floor(low, counts[:, few], counts.sum(dim=1))
    if bool((off != 0).any()):
        b = int(off.abs().argmax())
        metres = float(off[b])
        raise ValueError(
            f"{label(scene, b)}: everybody stands {abs(metres):.2f} m {'over' if metres > 0 else 'under'} y = 0, the "
            "model's floor: move them there with magnet.on_floor(scene) or magnet export --on_floor; if they really "
            f"are off the floor, {ANY_FLOOR}"
        )


def _rigid(scene: Scene) -> Tensor:
    """Whether all rotations are rotations, and transforms have a fourth row of transforms. (B, T, P) bool"""
    rotations = torch.cat([scene.body_rot, scene.T_world_root[..., None, :3, :3]], dim=3)
    x, y, z = rotations.unbind(dim=-1)
    mirrored = (torch.linalg.cross(x, y, dim=-1) - z).flatten(3)
    lengths = torch.cat([x.square().sum(-1), y.square().sum(-1)], dim=-1) - 1
    below = scene.T_world_root[..., 3, :] - torch.eye(4, dtype=rotations.dtype, device=scene.device)[3]
    off = torch.cat([mirrored, lengths, (x * y).sum(-1), below], dim=-1)
    return off.abs().amax(dim=-1) < ROUNDED


def _refuse(bad: Tensor, frames: Tensor, scene: Scene, what: str) -> None:
    """bad (B, F, P) bool of some `frames`"""
    if bool(bad.any()):
        b, frame, agent = bad.nonzero()[0].tolist()
        count = int(bad[b].any(dim=-1).sum())
        also = f" (and {count - 1} more frames of that scene)" if count > 1 else ""
        raise ValueError(f"{label(scene, b)}, agent {agent}: frame {int(frames[frame])}{also} {what}")


def whole_tokens(scene: Scene, frames: int) -> Scene:
    """The first frames of a scene, filled up to a whole token; its last pose is repeated if it has no more frames."""
    wanted = -(-frames // TOKEN_FRAMES) * TOKEN_FRAMES
    if scene.frames >= wanted:
        return scene
    frame = torch.arange(wanted, device=scene.device).clamp(max=scene.frames - 1)
    valid = None if scene.valid is None else scene.valid[:, frame]
    return scene.replace(body_rot=scene.body_rot[:, frame], T_world_root=scene.T_world_root[:, frame], valid=valid)
