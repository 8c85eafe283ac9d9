"""A live scene: motion generated chunk by chunk from the last second, while the settings change.

It uses neither browser nor threads; `Worker` runs it a little ahead of the frame that is shown.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from magnet.body.floor import open_body
from magnet.denoiser.core import DenoiserCore
from magnet.generation.growing import GrowingScene
from magnet.generation.inputs import check_given
from magnet.generation.keyframes import Goal, Keyframe, keyframe, reached, require_soon, with_keyframes
from magnet.generation.loaded import Loaded, denoiser_of
from magnet.generation.partner import Partner
from magnet.generation.plan import plan_of_scene
from magnet.generation.rollout import generate
from magnet.motion.frames import canonical_frame
from magnet.motion.required import require_one, require_rate
from magnet.motion.scene import Scene, empty_scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.precision import cpu_by_default
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tasks.base import Task
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.joint import Generation, JointFuture
from magnet.tasks.partner import MotionControl

CONTEXT = 32
"""Frames that each chunk goes on from."""
FIRST = 64
"""Frames of a scene from nothing."""
REACH = 32
"""Frames ahead at which who is steered is to be at the goal; so many before a first keyframe are made anew."""


@dataclass
class LiveSettings:
    """What the next chunk is generated with.

    Attributes:
        task: a name in the registry.
        fields: the task's own options, where they differ from its defaults.
        steps: denoising steps.
        guidance: see `Guidance`; this and `steps` count, not those of `sampler`.
        chunk: frames of a chunk, whole tokens.
        goals: where agents (slots) are steered to; see `Live`.
        sampler: all other options of sampling.
    """

    task: str = "joint_future"
    fields: dict[str, Any] = field(default_factory=lambda: {"block": 2})
    steps: int = 10
    guidance: Guidance = field(default_factory=Guidance)
    chunk: int = 16
    goals: dict[int, Goal] = field(default_factory=dict)
    sampler: SamplerOptions = field(default_factory=SamplerOptions)


@dataclass(frozen=True)
class LiveChunk:
    """What one call of `Live.advance` has made."""

    start: int  # first new frame
    frames: int
    seconds: float  # that it took
    between: bool = False  # keyframes


class Live:
    """A scene that grows; `given` marks what the model did not generate.

    Each chunk is a sample of the chosen task that continues the last `CONTEXT` frames; in `motion_control` it is the
    answer of a `Partner`. Where a task is given somebody's future (as that one is), that future comes first: from
    `partner`, if there is one; from in-betweening towards that agent's goal, if it is steered; else from a joint
    prediction.

    Args:
        model: a trained denoiser, or what `magnet.load` returns.
        people: how many there are when a scene begins from nothing.
        start: a scene (B = 1) to go on from instead; whoever is present moves up to the first slots.
        partner: recorded motion (B = 1) of everybody, from which whoever is given is taken, in the same frames as the
            scene that grows; whoever is present moves up to the first slots, as in `start`.
        body: the body of people from nothing, its id; None: that of `start`, or the open one.
        generator: source of all randomness.

    Attributes:
        keys: keyframes that `between` goes through; `begin` drops them.
        asked: whether the next chunk is to be made `between` the keyframes.

    Raises:
        ValueError: more people than the model has slots, `start` is shorter than `CONTEXT`, or motion that the model
            cannot go on from.
    """

    @cpu_by_default
    def __init__(
        self,
        model: DenoiserCore | Loaded,
        people: int = 2,
        start: Scene | None = None,
        partner: Scene | None = None,
        generator: torch.Generator | None = None,
        body: str | None = None,
    ) -> None:
        self.model = denoiser_of(model)
        self.body = body or (open_body().id if start is None else start.body)
        self.generator = generator or torch.Generator(device=self.model.device).manual_seed(1)
        if partner is not None:
            require_rate(partner, "partner")
            require_one(partner)
            check_given(partner, torch.ones(partner.frames // TOKEN_FRAMES, partner.agents, dtype=torch.bool))
            partner = partner.to("cpu").to_float32()
            partner = partner.permute_agents(partner.present[0].nonzero()[:, 0])
        self.partner = partner
        self.settings = LiveSettings()
        self.keys: list[Keyframe] = []
        self.asked = False
        self.lock = threading.RLock()
        self.version = 0  # grows when frames that were there have changed
        self.made, self.spent = 0, 0.0
        self._partner: tuple[Any, Partner] | None = None  # who answers, and what for
        self._growing = GrowingScene()
        self.scene: Scene
        self.begin(people, start)

    # -- starting ------------------------------------------------------------------------------

    @cpu_by_default
    def begin(self, people: int = 2, start: Scene | None = None) -> LiveChunk:
        """Start anew: from a scene, or from nothing with so many people."""
        begun = time.perf_counter()
        if start is None:
            scene = self._from_nothing(people)
        else:
            self._check(start)
            scene = start.to("cpu").to_float32()  # as its chunks are
            scene = scene.permute_agents(scene.present[0].nonzero()[:, 0])
            scene = scene.slice(0, start.frames // TOKEN_FRAMES * TOKEN_FRAMES).replace(valid=None)
            if scene.given is None:
                scene = scene.replace(given=torch.ones(scene.T_world_root.shape[:3], dtype=torch.bool))
        with self.lock:
            self.scene = scene
            self.settings.goals = {a: goal for a, goal in self.settings.goals.items() if a < scene.agents}
            self.keys, self.asked = [], False
            self.version += 1
        return LiveChunk(0, scene.frames, time.perf_counter() - begun)

    def _from_nothing(self, people: int) -> Scene:
        slots = self.model.layout.agents
        if not 1 <= people <= slots:
            raise ValueError(f"people: got {people}, expected 1 to {slots}, the slots that the model has")
        there = torch.ones(1, people, dtype=torch.bool)
        empty = empty_scene(1, 0, people, torch.zeros(1)).replace(present=there, body=self.body)
        made = self.sample(empty, Generation(), 0, FIRST)
        return made.replace(given=torch.zeros(1, FIRST, people, dtype=torch.bool))

    def _check(self, start: Scene) -> None:
        slots = self.model.layout.agents
        if start.scenes != 1 or start.frames < CONTEXT or start.agents > slots:
            raise ValueError(
                f"start: {start.scenes} scenes, {start.frames} frames, {start.agents} agents; expected 1, at least "
                f"{CONTEXT}, at most {slots}"
            )
        if not bool(start.present.any()):
            raise ValueError("start: nobody is there to go on")
        require_rate(start, "start")
        check_given(start, torch.ones(start.frames // TOKEN_FRAMES, start.agents, dtype=torch.bool))

    def restart(self, frame: int) -> int:
        """Remove what comes after a frame. -> frames that are left, whole tokens and at least `CONTEXT`"""
        with self.lock:
            keep = max(min(frame // TOKEN_FRAMES * TOKEN_FRAMES, self.scene.frames), CONTEXT)
            self.scene = self.scene.slice(0, keep)
            self.version += 1
            return keep

    def now(self) -> tuple[Scene, int]:
        """The scene, and the version that it is of, together: another thread may begin or append meanwhile."""
        with self.lock:
            return self.scene, self.version

    @property
    def fps(self) -> float:
        """Frames made for each second of computing, so far."""
        return self.made / self.spent if self.spent > 0 else 0.0

    # -- going on ------------------------------------------------------------------------------

    def task(self) -> Task:
        """The task of the settings; fields that it does not have are left out.

        A task that generates somebody from the others is for all but whoever is steered, by default the last one.

        Raises:
            ValueError: no such task, or it does not go on from a past and so cannot be played live.
        """
        kind = registry.get(self.settings.task)
        if kind is Generation:  # after its first window it only goes on
            return JointFuture()
        own = {each.name for each in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else set()
        fields = {name: value for name, value in self.settings.fields.items() if name in own}
        people = range(self.scene.agents)
        if "pairs" in own and "pairs" not in fields:
            last = (CONTEXT + self._length(kind)) // TOKEN_FRAMES - 1
            fields["pairs"] = tuple((agent, last) for agent in self._steered() or people)
        if "target" in own and "target" not in fields:
            leads = self._steered() or people[-1:]
            fields["target"] = tuple(agent for agent in people if agent not in leads) or (0,)
        return kind(**fields)

    @cpu_by_default
    def advance(self) -> LiveChunk:
        """Generate the next chunk and append it; if it was `asked` for, the one between the keyframes instead.

        Raises:
            ValueError: the task cannot go on here; says why.
        """
        if self.asked:
            self.asked = False
            return self.between()
        begun = time.perf_counter()
        with self.lock:
            scene, version = self.scene, self.version
            task = self.task()
            frames = self._length(type(task))
        past = scene.slice(scene.frames - CONTEXT)
        known = plan_of_scene(self.model, task, scene.agents, CONTEXT, frames, self._options()).known
        if not bool(known[: CONTEXT // TOKEN_FRAMES].all()):
            raise ValueError(
                f"{self.settings.task} does not go on from everybody's past, so it cannot be played live; "
                "try joint_future, motion_control or inbetweening"
            )
        given = self._future(past, scene.frames, known, frames)
        if isinstance(task, MotionControl):
            chunk = self._answered(task, given, version, scene.frames)
        else:
            chunk = self.sample(given, task, CONTEXT, frames).replace(given=given.given).slice(CONTEXT)
        return self._append(scene, chunk, version, begun)

    def _answered(self, task: MotionControl, given: Scene, version: int, begins: int) -> Scene:
        """The answer to a given future from the frame `begins` on, by the partner who has answered so far.

        Who has not answered up to there, because another task was played, remembers another past: a new one answers.
        given (1, `CONTEXT` + T) -> (1, T)
        """
        options = self._options()
        key = (version, task, options, begins)
        if self._partner is None or self._partner[0] != key:
            past = given.slice(0, CONTEXT)
            partner = Partner(self.model, past, task.target, options, self.generator, task.block)
        else:
            partner = self._partner[1]
        self._partner = None
        answer = partner.answer(given.slice(CONTEXT)).to("cpu")
        self._partner = ((version, task, options, begins + answer.frames), partner)
        return answer.replace(names=(), given=None if given.given is None else given.given[:, CONTEXT:])

    @cpu_by_default
    def between(self) -> LiveChunk:
        """Generate anew, by in-betweening, from a second before the first keyframe to the last; the rest is forgotten.

        Raises:
            ValueError: there are no keyframes, or one lies where nothing comes before it, or over five minutes
                (`LATER`) after the end.
        """
        begun = time.perf_counter()
        with self.lock:
            keys, version = sorted(self.keys, key=lambda key: key.frame), self.version
            start = self.between_from()
            scene = self.scene.slice(0, start)
        frames = keys[-1].frame + TOKEN_FRAMES - start
        shifted = [dataclasses.replace(key, frame=key.frame - start + CONTEXT) for key in keys]
        given = with_keyframes(self._held(scene.slice(start - CONTEXT), frames), shifted)
        task = Inbetweening(pairs=tuple((key.agent, key.frame // TOKEN_FRAMES) for key in shifted))
        chunk = self.sample(given, task, CONTEXT, frames).replace(given=given.given).slice(CONTEXT)
        return dataclasses.replace(self._append(scene, chunk, version, begun, anew=True), between=True)

    def between_from(self) -> int:
        """The first frame that `between` makes anew.

        Raises:
            ValueError: as `between`.
        """
        if not self.keys:
            raise ValueError("no keyframes: add one first")
        first = min(key.frame for key in self.keys)
        if first < CONTEXT + TOKEN_FRAMES:
            raise ValueError(
                f"a keyframe at frame {first}: the model goes on from {CONTEXT} frames, so the first keyframe lies at "
                f"{CONTEXT + TOKEN_FRAMES} or later"
            )
        require_soon(max(key.frame for key in self.keys), self.scene.frames)
        return max(CONTEXT, min(self.scene.frames, first - REACH) // TOKEN_FRAMES * TOKEN_FRAMES)

    def _append(self, scene: Scene, chunk: Scene, version: int, begun: float, anew: bool = False) -> LiveChunk:
        """Append a chunk to the scene that it continues, unless that was restarted meanwhile."""
        with self.lock:
            took = time.perf_counter() - begun
            if version != self.version:  # what this chunk continues is no longer there
                return LiveChunk(self.scene.frames, 0, took)
            self.scene = self._growing.append(scene, chunk)
            self.version += anew
            self.made, self.spent = self.made + chunk.frames, self.spent + took
            return LiveChunk(scene.frames, chunk.frames, took)

    def sample(self, scene: Scene, task: Task, context: int, frames: int) -> Scene:
        options = self._options()
        longer = generate(self.model, scene, task, context, frames, options=options, generator=self.generator)
        return longer.permute_agents(torch.arange(scene.agents)).to("cpu").replace(names=())

    def _options(self) -> SamplerOptions:
        # A chunk fits into the window, so denoising it all at once costs the fewest steps.
        # What it has made itself is not asked where its floor is.
        settings = self.settings
        own: dict[str, Any] = {
            "steps": settings.steps,
            "guidance": settings.guidance,
            "pyramid_offset": 0,
            "any_floor": True,
        }
        return dataclasses.replace(settings.sampler, **own)

    def _length(self, kind: type) -> int:
        if kind is Inbetweening:
            return REACH
        block = TOKEN_FRAMES * (int(self.settings.fields.get("block", 1)) if kind is MotionControl else 1)
        return max(self.settings.chunk // block, 1) * block

    def _steered(self) -> list[int]:
        return sorted(agent for agent in self.settings.goals if agent < self.scene.agents)

    # -- the given future ----------------------------------------------------------------------

    def _held(self, past: Scene, frames: int) -> Scene:
        """The past, and its last frame for so many frames more, which nobody was given."""
        scene = past.pad_frames(frames).slice(frames)
        known = (torch.arange(scene.frames) < past.frames)[None, :, None]
        return scene.replace(given=known.expand(scene.T_world_root.shape[:3]))

    def _future(self, past: Scene, now: int, known: Tensor, frames: int) -> Scene:
        """The past and what the task is given of what comes after. -> `CONTEXT` + `frames` frames

        past: the last `CONTEXT` frames; now: the frame of the whole scene behind them; known: (N, P) bool, of both
        """
        coming = known[CONTEXT // TOKEN_FRAMES :]
        scene = self._held(past, frames)
        if not bool(coming.any()):
            return scene
        whole = coming.all(dim=0)
        moments = (coming & ~whole).nonzero().tolist()
        scene = with_keyframes(scene, [self._toward(past, p, CONTEXT + step * TOKEN_FRAMES) for step, p in moments])
        return self._lead(scene, past, now, whole, frames) if bool(whole.any()) else scene

    def _lead(self, scene: Scene, past: Scene, now: int, agents: Tensor, frames: int) -> Scene:
        """Fill in the whole future of some agents (P,) bool before the task runs; the rest as for `_future`.

        Raises:
            ValueError: the `partner` is a recording of another number of people.
        """
        if self.partner is not None and self.partner.frames >= now + frames:
            if self.partner.agents != scene.agents:
                raise ValueError(f"partner: got {self.partner.agents} people, expected the scene's {scene.agents}")
            source = self.partner.slice(now - CONTEXT, now + frames)
            source = source.replace(given=torch.ones(source.T_world_root.shape[:3], dtype=torch.bool))
        else:
            steered = [agent for agent in self._steered() if bool(agents[agent])]
            task: Task = JointFuture()
            length = REACH if steered else frames
            goals = self._held(past, length)
            if steered:
                last = CONTEXT + REACH - TOKEN_FRAMES
                task = Inbetweening(pairs=tuple((agent, last // TOKEN_FRAMES) for agent in steered))
                goals = with_keyframes(goals, [self._toward(past, agent, last) for agent in steered])
            made = self.sample(goals, task, CONTEXT, length).replace(given=goals.given)
            source = made.slice(0, CONTEXT + frames)
        assert scene.given is not None and source.given is not None
        made = scene.with_poses(agents, source.body_rot, source.T_world_root)
        return made.replace(given=torch.where(agents, source.given, scene.given))

    def _toward(self, past: Scene, agent: int, frame: int) -> Keyframe:
        """A keyframe of one agent: the most upright of its last poses, moved towards its goal as far as it may get."""
        pose = int(past.T_world_root[0, :, agent, 1, 3].argmax())
        key = dataclasses.replace(keyframe(past, agent, past.frames - 1, pose, held=True), frame=frame)
        T_world_can = canonical_frame(past.T_world_root)[0, -1, agent]
        goal = self.settings.goals.get(agent, Goal.of(T_world_can))
        return dataclasses.replace(key, goal=reached(T_world_can, goal, (frame - CONTEXT) / past.fps))
