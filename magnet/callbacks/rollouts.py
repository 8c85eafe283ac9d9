"""Trains on pasts that the model has generated, followed by recorded continuations."""

from __future__ import annotations

import copy
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from magnet.baselines.nearest_neighbour import NearestNeighbour
from magnet.body import Body
from magnet.body.other_shapes import with_shapes
from magnet.checks import require_number, require_whole
from magnet.denoiser.compiled import records
from magnet.denoiser.module import Denoiser
from magnet.denoiser.self_forcing import MadePasts
from magnet.generation.rollout import generate
from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.resample import slerp, smoothstep
from magnet.motion.scene import Scene, cat_time, concatenate
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.grid import Grid
from magnet.sampling.options import SamplerOptions
from magnet.seeding import derive
from magnet.tasks import registry
from magnet.tasks.base import Task, schedule_of
from magnet.tasks.joint import JointFuture

COMPARED = 16
"""Frames at the end of a generated past by which the recorded continuation is chosen."""

GOING_ON = Grid(tokens=8, agents=2, context=4)
"""On which it is found out what a task reads and finishes."""

BLEND = 8
"""Frames over which poses change from the generated past to the recorded continuation."""


class RollOuts(Callback):
    """Rolls the model out from time to time and trains on what it made (ours).

    A model that has seen only recorded pasts does not know how to continue its own. So the sampler continues some
    scenes of the batch over several windows. The training clip of the same data whose beginning is nearest to the end
    of this past is moved there, put on the same bodies and appended, and the remaining difference fades out. Such
    scenes replace a share of the batch. The generated past is shown clean and does not count in the loss. (The idea is
    that of BAgger, arXiv 2512.12080.) A training that is gone on with rolls out at the steps at which it would have;
    until then it has no generated pasts, for clips and roll-outs are not in its checkpoint. With `cuda_graph` the
    model's evaluations are replayed, too. A training may have several of other tasks, such as long ones of some; each
    takes the place of what the other made.

    Args:
        share: share of the batch's scenes that are replaced.
        every: training steps from one roll-out to the next.
        start: training steps before the first roll-out; an untrained model makes no useful past.
        scenes: scenes rolled out at a time.
        frames: fewest and most frames that are rolled out.
        steps: denoising steps of the sampler.
        return_frames: frames over which people return to their recorded places.
        stretches: training clips that are kept to choose from.
        tasks: the tasks of which each roll-out draws one. A task that reads what is to come, as `motion_control` does
            of those whom it answers, reads a joint future that the model has made before.
    """

    def __init__(
        self,
        share: float = 0.25,
        every: int = 200,
        scenes: int = 24,
        frames: tuple[int, int] = (32, 128),
        steps: int = 8,
        return_frames: int = 32,
        stretches: int = 2000,
        start: int = 0,
        tasks: tuple[str, ...] = ("joint_future",),
    ) -> None:
        require_number("share", share, 0, 1)
        require_whole("start", start, 0)
        counts = {"every": every, "scenes": scenes, "steps": steps, "stretches": stretches}
        for name, value in {**counts, "return_frames": return_frames, "frames": frames[0]}.items():
            require_whole(name, value, 1)
        if frames[1] < frames[0]:
            raise ValueError(f"frames: got {frames}, expected the fewest first")
        self.share, self.every, self.scenes, self.frames, self.stretches = share, every, scenes, frames, stretches
        # What it makes, neither corrected nor livelier, in turns of one token.
        plain = {"settle": "off", "smooth_path": False, "noise_scale": 1.0, "turn": 1, "any_floor": True}
        self.sampler = SamplerOptions(steps=steps, **plain)  # type: ignore[arg-type]
        self.return_frames = return_frames
        if not tasks:
            raise ValueError("tasks: got none, expected at least one")
        self.names, self.tasks = tuple(tasks), [registry.get(task)() for task in tasks]
        for name, task in zip(tasks, self.tasks, strict=True):
            plan = schedule_of(task, GOING_ON)
            if not bool(plan.known[GOING_ON.past()].all()) or not bool(plan.finished.all()):
                raise ValueError(f"tasks: got {name}, expected tasks that go on from a past and leave nobody unknown")
        self.kept: list[Scene] = []
        self.filled, self.start = -1, start

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if not isinstance(pl_module, Denoiser) or not isinstance(batch, Scene):
            raise ValueError("RollOuts: only a Denoiser can be rolled out; leave the callback out of this training")
        batch = batch.replace(names=kinds_of(trainer, batch))
        self.keep(batch)
        step = trainer.global_step
        due = step >= self.start and (self.filled < 0 or step - self.filled >= self.every)
        if not due or sum(each.scenes for each in self.kept) < min(4 * self.scenes, self.stretches):
            return
        self.filled = step
        seed = derive(pl_module.hparams["seed"], "roll-outs", step, pl_module.global_rank)
        generator = torch.Generator(device=pl_module.device).manual_seed(seed)
        precision = trainer.precision_plugin.forward_context()
        pl_module.made_pasts = self.rolled_out(pl_module, batch, generator, precision)

    @property
    def state_key(self) -> str:
        """By which checkpoints tell several apart."""
        key: str = super().state_key
        return key if self.names == ("joint_future",) else self._generate_state_key(tasks=self.names)

    def state_dict(self) -> dict[str, Any]:
        return {"filled": self.filled}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.filled = state_dict["filled"]

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.kept, self.filled = [], -1
        if isinstance(pl_module, Denoiser):
            pl_module.made_pasts = None

    def keep(self, batch: Scene) -> None:
        """Keep a batch's clips, and drop the oldest; where they are, for a GPU would be waited for at every step."""
        self.kept.append(batch)
        while sum(each.scenes for each in self.kept[1:]) >= self.stretches:
            self.kept.pop(0)

    @torch.no_grad()
    def rolled_out(
        self,
        model: Denoiser,
        batch: Scene,
        generator: torch.Generator,
        precision: AbstractContextManager[None] | None = None,
    ) -> MadePasts | None:
        """Scenes as long as the batch's whose first half the model has generated; None if none can be continued.

        The names of scenes are their kinds, see `kinds_of`; without names all are of one kind. `precision` is the
        context in which the model runs; None: the current one.
        """
        frames = batch.frames
        past = frames // 2 // TOKEN_FRAMES * TOKEN_FRAMES
        if past < COMPARED:
            raise ValueError(f"RollOuts: got windows of {frames} frames, expected at least {2 * COMPARED}")
        clips = concatenate([each.slice(0, COMPARED + frames - past) for each in self.kept])
        clips = clips.to("cpu")
        sizes = NearestNeighbour(clips).stretches
        count = len(self.tasks)
        which = int(torch.randint(count, (), generator=generator, device=generator.device)) if count > 1 else 0
        task = self.tasks[which]
        people = torch.tensor([n in sizes for n in batch.present.sum(dim=1).tolist()])
        if reads_ahead(task):  # the first slot answers others, who must be there
            people &= (batch.present[:, 0] & batch.present[:, 1:].any(dim=1)).cpu()
        whole = people if batch.valid is None else people & batch.valid.flatten(1).all(dim=1).cpu()
        chosen = whole.nonzero()[: self.scenes, 0]
        if not len(chosen):
            return None
        low, high = (-(-count // TOKEN_FRAMES) * TOKEN_FRAMES for count in self.frames)
        draw = torch.rand((), generator=generator, device=generator.device)
        more = low + int(draw * ((high - low) // TOKEN_FRAMES + 1)) * TOKEN_FRAMES
        start = batch.select(chosen).slice(0, past)
        training = model.training
        model.eval()
        with precision or nullcontext():
            made = self._continued(model, start, task, more, generator)
        model.train(training)
        made = made.slice(made.frames - past)
        behind = recorded_behind(made.slice(past - COMPARED).to("cpu"), clips, frames - past)
        behind = on_bodies(behind, made.betas.cpu(), model.require_body()).to(made.device)
        return MadePasts(cat_time([made, eased(made, behind, self.return_frames)]), past // TOKEN_FRAMES, self.share)

    def _continued(self, model: Denoiser, start: Scene, task: Task, more: int, generator: torch.Generator) -> Scene:
        """A past and so many frames more, made by a task."""
        replays = bool(model.hparams["cuda_graph"]) and records(start.T_world_root)
        rest = start.frames, more, 1, replace(self.sampler, compile=replays), generator
        if reads_ahead(task):  # who is given comes first
            start = generate(model, start, JointFuture(), *rest)
        return generate(model, start, task, *rest)


def reads_ahead(task: Task) -> bool:
    """Whether a task reads what comes after the past: of somebody who is given, or at keyframes."""
    return not torch.equal(schedule_of(task, GOING_ON).known, GOING_ON.past())


def kinds_of(trainer: Trainer, batch: Scene) -> tuple[str, ...]:
    """Of which kind each scene is, where the trainer's data tell."""
    tell = getattr(getattr(trainer, "datamodule", None), "kinds_of", None)
    return tell(batch.names) if tell is not None and batch.names else ()


def recorded_behind(past: Scene, clips: Scene, frames: int) -> Scene:
    """The clip of the same kind that begins most like the end of a past, moved there.

    Were it of any kind, couples who drift would learn to go over to another kind of motion and stay with it: no
    recording leads back.

    Args:
        past: (B, T, P) ends of generated pasts. Names are kinds.
        clips: (M, T + frames, P) recorded. Those of all kinds are looked at where a kind has none of so many people.
        frames: of the continuation.

    Returns:
        (B, frames, P), on the bodies of those recorded.
    """
    ours, theirs = past.names or ("",) * past.scenes, clips.names or ("",) * clips.scenes
    where = {kind: [k for k, of in enumerate(theirs) if of == kind] for kind in set(ours) & set(theirs)}
    nearest = {kind: NearestNeighbour(clips.select(mine)) for kind, mine in where.items()}
    everybody = NearestNeighbour(clips)
    found = []
    for b, kind in enumerate(ours):
        one = past.select([b])
        same = nearest.get(kind, everybody)
        found.append((same if int(one.present.sum()) in same.stretches else everybody)(one, frames))
    return concatenate(found)


def on_bodies(behind: Scene, betas: Tensor, body: Body) -> Scene:
    """A recorded continuation by people of other shapes, whose feet stand and whose hands hold as recorded.

    Without a body that knows the shapes, the same poses. behind on the CPU, betas (B, P, 10), body anywhere.
    """
    if behind.body != body.id:
        return behind.replace(betas=betas)
    return with_shapes(behind, betas, copy.deepcopy(body).cpu())


def eased(made: Scene, behind: Scene, frames: int) -> Scene:
    """A recorded continuation changed so that it begins with the places and poses in which a generated past ends.

    The change of places fades out over `frames`, that of poses over `BLEND` frames.

    Args:
        made: (B, T, P) the past.
        behind: (B, T', P) the continuation, at about the right place.
        frames: frames over which people return to their recorded places.
    """
    T_world_last = canonical_frame(made.T_world_root[:, -1:])
    T_world_can = canonical_frame(behind.T_world_root)
    # Where each person is expected at the continuation's first frame, if it goes on as the continuation does there.
    T_now_next = inverse(T_world_can[:, :1]) @ T_world_can[:, 1:2]
    yaw, ground = to_planar(T_world_can)
    begin_yaw, begin = to_planar(T_world_last @ T_now_next)
    left = 1 - smoothstep((_count(behind.frames, ground) / frames).clamp(max=1))[:, None]
    turn = torch.atan2((begin_yaw - yaw[:, :1]).sin(), (begin_yaw - yaw[:, :1]).cos())
    T_world_new = from_planar(yaw + turn * left, ground + (begin - ground[:, :1]) * left[..., None])
    T_world_root = T_world_new.to(behind.T_world_root) @ inverse(T_world_can) @ behind.T_world_root
    share = smoothstep(((_count(behind.frames, ground) + 1) / (BLEND + 1)).clamp(max=1))
    T_can_last = (inverse(T_world_last) @ made.T_world_root[:, -1:]).expand_as(T_world_root)
    T_can_root = inverse(T_world_new.to(T_world_root)) @ T_world_root
    tilt = slerp(T_can_last[..., :3, :3], T_can_root[..., :3, :3], share[:, None])
    height = torch.lerp(T_can_last[..., 1, 3], T_can_root[..., 1, 3], share[:, None].to(T_can_root))
    T_can_root = T_can_root.clone()
    T_can_root[..., :3, :3], T_can_root[..., 1, 3] = tilt, height
    last = made.body_rot[:, -1:].expand_as(behind.body_rot)
    body_rot = slerp(last, behind.body_rot, share[:, None, None])
    return behind.replace(body_rot=body_rot, T_world_root=T_world_new.to(T_can_root) @ T_can_root)


def _count(frames: int, like: Tensor) -> Tensor:
    return torch.arange(frames, device=like.device, dtype=like.dtype)
