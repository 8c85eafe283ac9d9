"""A model that plays on and on: motion generated piece by piece from the last second, while its settings change.

Nothing here knows of a browser. `Live` is the engine; `Worker` runs it in a thread, a little ahead of who watches.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from magnet.denoiser.generation import SamplerOptions
from magnet.denoiser.module import Denoiser
from magnet.motion.frames import canonical_frame, inverse
from magnet.motion.scene import Scene, absent
from magnet.motion.tokens import STRIDE
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import LEVELS
from magnet.sampling.schedule import Grid, MaskSchedule, Stage
from magnet.tasks import registry
from magnet.tasks.base import Task
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.joint import Generation, JointFuture

CONTEXT = 32
"""Frames that each piece goes on from."""
FPS = 30.0
"""The rate that models are trained at."""
FIRST = 64
"""Frames of a scene from nothing."""
REACH = 32
"""Frames ahead at which a keyframe is set."""
FASTEST = 1.6
"""Metres a second that a keyframe may ask of somebody."""


@dataclass(frozen=True)
class Goal:
    """Where somebody is to be `REACH` frames on: a place on the floor and a heading (0 looks along +z)."""

    x: float
    z: float
    heading: float


@dataclass(frozen=True)
class Among:
    """A task planned for the first `people` slots alone: nobody waits for the turn of somebody who is not there."""

    formula: ClassVar[str] = "P(as the task among those present)"
    task: Task
    people: int

    def schedule(self, grid: Grid) -> MaskSchedule:
        plan = self.task.schedule(dataclasses.replace(grid, agents=self.people))
        free = grid.agents - self.people
        stages = []
        for stage in plan.stages:
            hidden = stage.hidden
            if hidden is not None:  # a free slot shares the view of the first
                views = torch.cat([hidden, hidden[:1].expand(free, -1, -1)])
                hidden = torch.nn.functional.pad(views, (0, free))
            levels = torch.nn.functional.pad(stage.levels, (0, free), value=LEVELS)
            stages.append(Stage(stage.start, levels, hidden))
        known = torch.nn.functional.pad(plan.known, (0, free))
        return MaskSchedule(plan.tokens, grid.agents, tuple(stages), known)


@dataclass
class Settings:
    """What the next piece is generated with.

    Attributes:
        task: a name in the registry.
        fields: the task's own options, where they differ from its defaults.
        piece: frames of a piece, whole tokens.
        goals: where agents (slots) are steered to; see `Live`.
    """

    task: str = "joint_future"
    fields: dict[str, Any] = field(default_factory=lambda: {"block": 2})
    steps: int = 10
    guidance: Guidance = field(default_factory=Guidance)
    piece: int = 16
    goals: dict[int, Goal] = field(default_factory=dict)


@dataclass(frozen=True)
class Piece:
    """What one call of `Live.advance` has made."""

    start: int  # first new frame
    frames: int
    seconds: float  # that it took


class Live:
    """A scene that grows.

    Each piece is a sample of the chosen task that continues the last `CONTEXT` frames. Where a task is given
    somebody's future (as `motion_control` is), that future comes first: from `partner`, if there is one; from
    in-betweening towards that agent's goal, if it is steered; else from a joint prediction.

    Args:
        model: a trained denoiser.
        people: how many there are when a scene begins from nothing.
        start: a scene (B = 1) to go on from instead; whoever is present moves up to the first slots.
        partner: recorded motion of whoever is given, in the same frames as the scene that grows.
        generator: source of all randomness.

    Raises:
        ValueError: more people than the model has slots, or `start` is shorter than `CONTEXT`.
    """

    def __init__(
        self,
        model: Denoiser,
        people: int = 2,
        start: Scene | None = None,
        partner: Scene | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        self.model = model
        self.generator = generator or torch.Generator(device=model.device).manual_seed(1)
        self.partner = partner
        self.settings = Settings()
        self.lock = threading.RLock()
        self.version = 0  # grows when frames that were there have changed
        self.made, self.spent = 0, 0.0
        self.scene: Scene
        self.begin(people, start)

    # -- starting ------------------------------------------------------------------------------

    def begin(self, people: int = 2, start: Scene | None = None) -> Piece:
        """Start anew: from a scene, or from nothing with so many people."""
        slots = self.model.layout.agents
        if start is None:
            if not 1 <= people <= slots:
                raise ValueError(f"people: got {people}, expected 1 to {slots}, the slots that the model has")
            nobody = absent(1, 0, people, torch.zeros(1))
            empty = nobody.replace(present=torch.ones(1, people, dtype=torch.bool))
            begun = time.perf_counter()
            start = self._sample(empty, Generation(), 0, FIRST)
            piece = Piece(0, FIRST, time.perf_counter() - begun)
        elif start.scenes != 1 or start.frames < CONTEXT or start.agents > slots:
            raise ValueError(
                f"start: {start.scenes} scenes, {start.frames} frames, {start.agents} agents; expected 1, at least "
                f"{CONTEXT}, at most {slots}"
            )
        elif abs(start.fps - FPS) > 1e-3:
            raise ValueError(
                f"start: {start.fps:g} frames a second, the model makes {FPS:g}; convert it: magnet export"
            )
        else:
            piece = Piece(0, start.frames, 0.0)
            start = start.order(start.present[0].nonzero()[:, 0])
            start = start.cut(0, start.frames // STRIDE * STRIDE).replace(valid=None)
        with self.lock:
            self.scene = start
            self.version += 1
        return piece

    def restart(self, frame: int) -> int:
        """Forget what comes after a frame. -> frames that are left, whole tokens and at least `CONTEXT`"""
        with self.lock:
            keep = max(min(frame // STRIDE * STRIDE, self.scene.frames), CONTEXT)
            self.scene = self.scene.cut(0, keep)
            self.version += 1
            return keep

    @property
    def fps(self) -> float:
        """Frames made for each second of computing, so far."""
        return self.made / self.spent if self.spent > 0 else 0.0

    # -- going on ------------------------------------------------------------------------------

    def task(self) -> Task:
        """The task of the settings; fields that it does not have are left out.

        Raises:
            ValueError: no such task, or it does not go on from a past and so cannot be played live.
        """
        kind = registry.get(self.settings.task)
        if kind is Generation:  # after its first window it only goes on
            return JointFuture()
        own = {each.name for each in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else set()
        fields = {name: value for name, value in self.settings.fields.items() if name in own}
        if "pairs" in own and "pairs" not in fields:
            agents = self._steered() or range(self.scene.agents)
            last = (CONTEXT + self._length(kind)) // STRIDE - 1
            fields["pairs"] = tuple((agent, last) for agent in agents)
        return kind(**fields)

    def advance(self) -> Piece:
        """Generate the next piece and append it.

        Raises:
            ValueError: the task cannot go on here; says why.
        """
        begun = time.perf_counter()
        with self.lock:
            scene, version = self.scene, self.version
            task = self.task()
            frames = self._length(type(task))
        past = scene.cut(scene.frames - CONTEXT)
        grid = Grid((CONTEXT + frames) // STRIDE, scene.agents, CONTEXT // STRIDE, self.settings.steps)
        known = task.schedule(grid).known
        if not bool(known[: grid.context].all()):
            raise ValueError(
                f"{self.settings.task} does not go on from everybody's past, so it cannot be played live; "
                "try joint_future, motion_control or inbetweening"
            )
        given = self._future(past, scene.frames, known, frames)
        longer = self._sample(given, task, CONTEXT, frames)
        piece = longer.cut(CONTEXT)
        with self.lock:
            if version != self.version:  # restarted meanwhile: this piece continues what is no longer there
                return Piece(self.scene.frames, 0, time.perf_counter() - begun)
            self.scene = joined(scene, piece)
            took = time.perf_counter() - begun
            self.made, self.spent = self.made + frames, self.spent + took
            return Piece(scene.frames, frames, took)

    def _sample(self, scene: Scene, task: Task, context: int, frames: int) -> Scene:
        options = SamplerOptions(steps=self.settings.steps, guidance=self.settings.guidance)
        plan = Among(task, scene.agents)
        longer = self.model.generate(scene, plan, context, frames, options=options, generator=self.generator)
        return longer.order(torch.arange(scene.agents)).to("cpu").replace(names=())

    def _length(self, kind: type) -> int:
        return REACH if kind is Inbetweening else max(self.settings.piece // STRIDE, 1) * STRIDE

    def _steered(self) -> list[int]:
        return sorted(agent for agent in self.settings.goals if agent < self.scene.agents)

    # -- the given future ----------------------------------------------------------------------

    def _future(self, past: Scene, now: int, known: Tensor, frames: int) -> Scene:
        """The past and what the task is given of what comes after. known (N, P)"""
        coming = known[CONTEXT // STRIDE :]
        scene = past.held(frames).cut(frames)
        if not bool(coming.any()):
            return scene
        whole = coming.all(dim=0)
        for agent in (coming.any(dim=0) & ~whole).nonzero()[:, 0].tolist():
            for step in coming[:, agent].nonzero()[:, 0].tolist():
                scene = self._with_keyframe(scene, past, agent, CONTEXT + step * STRIDE)
        if bool(whole.any()):
            scene = self._lead(scene, past, now, whole, frames)
        return scene

    def _lead(self, scene: Scene, past: Scene, now: int, agents: Tensor, frames: int) -> Scene:
        """Fill in the whole future of some agents before the task runs. agents (P,) bool"""
        if self.partner is not None and self.partner.frames >= now + frames:
            source = self.partner.cut(now - CONTEXT, now + frames)
        else:
            steered = [agent for agent in self._steered() if bool(agents[agent])]
            task: Task = JointFuture()
            length, goals = frames, scene
            if steered:
                length, last = REACH, (CONTEXT + REACH) // STRIDE - 1
                task = Inbetweening(pairs=tuple((agent, last) for agent in steered))
                goals = past.held(length).cut(length)
                for agent in steered:
                    goals = self._with_keyframe(goals, past, agent, last * STRIDE)
            source = self._sample(goals, task, CONTEXT, length).cut(0, CONTEXT + frames)
        chosen = agents[None, None, :, None, None]
        return scene.replace(
            body_rot=torch.where(chosen[..., None], source.body_rot, scene.body_rot),
            T_world_root=torch.where(chosen, source.T_world_root, scene.T_world_root),
        )

    def _with_keyframe(self, scene: Scene, past: Scene, agent: int, frame: int) -> Scene:
        """A keyframe of one agent: the most upright of its last poses, moved towards its goal as far as it may get."""
        T_world_can = canonical_frame(past.T_world_root)[0, :, agent]
        pose = int(past.T_world_root[0, :, agent, 1, 3].argmax())
        goal = self.settings.goals.get(agent)
        T_world_key = T_world_can[-1]
        if goal is not None:
            T_world_key = reached(T_world_key, goal, (frame - CONTEXT) / past.fps)
        roots, body_rot = scene.T_world_root.clone(), scene.body_rot.clone()
        moved = T_world_key @ inverse(T_world_can[pose]) @ past.T_world_root[0, pose, agent]
        roots[:, frame : frame + STRIDE, agent] = moved
        body_rot[:, frame : frame + STRIDE, agent] = past.body_rot[:, pose, agent][:, None]
        return scene.replace(T_world_root=roots, body_rot=body_rot)


def reached(T_world_can: Tensor, goal: Goal, seconds: float) -> Tensor:
    """A canonical frame on the way to a goal, no further than somebody gets in that time. (4, 4) -> (4, 4)"""
    way = torch.tensor([goal.x, 0.0, goal.z]) - T_world_can[:3, 3] * torch.tensor([1.0, 0.0, 1.0])
    length = float(way.norm())
    share = min(1.0, FASTEST * seconds / length) if length > 0 else 1.0
    target = T_world_can.clone()
    target[:3, 3] += share * way
    angle = torch.tensor(goal.heading)
    c, s = angle.cos(), angle.sin()
    zero, one = torch.zeros(()), torch.ones(())
    target[:3, :3] = torch.stack([c, zero, s, zero, one, zero, -s, zero, c]).view(3, 3)
    return target


def joined(scene: Scene, piece: Scene) -> Scene:
    """A scene and what comes after it."""
    return scene.replace(
        body_rot=torch.cat([scene.body_rot, piece.body_rot], dim=1),
        T_world_root=torch.cat([scene.T_world_root, piece.T_world_root], dim=1),
        valid=None,
    )


class Worker:
    """Runs `Live.advance` in a thread, never more than `ahead` frames in front of what is watched.

    Args:
        live: the engine.
        ahead: fewer answer sooner to steering, more outlast a slow moment.
        failed: told a message when the task refuses; the worker then waits for `wake`.
    """

    def __init__(self, live: Live, ahead: int = 32, failed: Callable[[str], None] | None = None) -> None:
        self.live, self.ahead, self.failed = live, ahead, failed
        self.watched = 0
        self.paused = False
        self.last: Piece | None = None
        self._wake, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="magnet-live", daemon=True)

    def start(self) -> Worker:
        self._thread.start()
        return self

    def watch(self, frame: int) -> None:
        """Say which frame is shown now."""
        self.watched = frame
        self._wake.set()

    def wake(self) -> None:
        """Try again after settings have changed."""
        self._wake.set()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10)

    def _run(self) -> None:
        while not self._stop.is_set():
            if self.paused or self.live.scene.frames - self.watched > self.ahead:
                self._wake.wait(timeout=0.5)
                self._wake.clear()
                continue
            try:
                self.last = self.live.advance()
            except Exception as error:  # whatever a task or its options raise: the page says so, and goes on
                if self.failed is not None:
                    self.failed(str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}")
                self._wake.clear()
                self._wake.wait(timeout=2.0)
