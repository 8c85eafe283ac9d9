"""What Python users need: `magnet.load("duet").generate(people=2)`, and scenes that show and save themselves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from magnet.body import Body, load_body
from magnet.body.floor import open_body
from magnet.checks import require_whole, slots_of
from magnet.denoiser.core import DenoiserCore
from magnet.errors import counted, warn_user
from magnet.export import reading
from magnet.export.motion import Motion, NotebookView
from magnet.generation.crowd import generate_crowd
from magnet.generation.crowd_start import SPACING, crowd_from_nothing, start_crowd
from magnet.generation.inputs import warn_of_body
from magnet.generation.partner import Partner
from magnet.generation.plan import plan_of_scene
from magnet.generation.rollout import generate
from magnet.generation.unmade import completed, given_invalid
from magnet.motion.required import require_rate
from magnet.motion.scene import FPS, Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.precision import cpu_by_default, device_of
from magnet.sampling.options import SamplerOptions
from magnet.tasks.base import Task, task_of
from magnet.tasks.inbetweening import Inbetweening

__all__ = ["Model", "Motion", "NotebookView", "load", "read"]


@cpu_by_default
def load(
    name_or_path: str | Path | None = None,
    *,
    device: str | torch.device = "cpu",
    steps: int | None = None,
    sampler: str | Mapping[str, Any] | SamplerOptions = "default",
) -> Model:
    """Load a trained model: a shipped one by name ("duet"), one of a hub ("hub:owner/name"), or a checkpoint's path.

    A run's folder will do, too: its best checkpoint is loaded, or the last one where there is no best.

    Args:
        device: device to run on.
        steps: denoising steps; fewer are faster and coarser. None: the sampler's.
        sampler: preset of the sampler: `default`, the best for the model, `plain`, or another of
            `magnet.sampling.presets`, such as `paper` for the paper's sampling; or options of your own, as a mapping,
            `{"settle": "hold"}`, or as `SamplerOptions(settle="hold")`.

    Raises:
        ValueError: no such model or sampler (the message says what there is), or no such device.
        ImportError: a hub's model without huggingface_hub, `pip install "magnet-motion[hub]"`.

    >>> model = load("duet", steps=2)
    >>> scene = model.generate(people=3, frames=60, seed=0)
    >>> scene.agents, scene.frames, scene.joints().shape[-2:]
    (3, 60, torch.Size([22, 3]))
    """
    place = device_of(device)
    said: dict[str, Any] = {} if steps is None else {"steps": steps}
    options = SamplerOptions.of(sampler, **said)
    return Model(DenoiserCore.load(name_or_path).to(place), options)


@cpu_by_default
def read(
    *paths: str | Path | Iterable[str | Path],
    body: str | Path | Body | None = None,
    fps: float | None = FPS,
    trim: bool = False,
    unit: str | None = None,
    up: str | None = None,
    joints: dict[str, str] | None = None,
    keep_floor: bool = False,
    in_fps: float | None = None,
    start: int = 0,
    end: int | None = None,
    clip: str | None = None,
) -> Motion:
    """Read our npz, SMPL-X npz, BVH, glTF, VRM or FBX of any skeleton, or CSV, as a scene; several are several people.

    Args:
        paths: the files, or lists of them.
        body: the scene's body model, or its file; None: the open one.
        fps: resample to this rate, by default the models'; None: as recorded.
        trim, unit, up, joints, keep_floor, in_fps, start, end, clip: as in `magnet.export.reading.Reading`. A unit or
            axis that nobody can have is taken as it is said, with a warning that names what the files look like.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: an FBX, and no Blender.
        ValueError: a file that cannot be read, or files that do not go together; says what to do.
    """
    options = reading.Reading(fps, trim, unit, up, joints or {}, keep_floor, in_fps, start, end, clip)
    one = (str, Path)
    lists = [[each] if isinstance(each, one) or not isinstance(each, Iterable) else each for each in paths]
    files = [file for each in lists for file in each]
    if strange := [file for file in files if not isinstance(file, one)]:
        raise ValueError(f"paths: got {type(strange[0]).__name__}, expected files' names, or lists of them")
    got = reading.read(files, body, options)
    for warning in reading.warned(got.notes):
        warn_user(warning)
    return Motion.of(got.scene, got.body, got.notes)


# -- a model -----------------------------------------------------------------------------------


@dataclass(frozen=True, repr=False)
class Model:
    """A trained model with its sampler, for which a preset's name or a mapping of its options will do.

    What samples whole scenes takes `seed` (None: another result each time) and `samples`: sample s of scene b is scene
    b * samples + s of the result, which includes the given frames. `cond` is the condition of each scene, for models
    with conditions, as in `magnet.generation.rollout.generate`; `sampler.guidance.cond_weight` is its weight.
    """

    denoiser: DenoiserCore
    sampler: SamplerOptions = field(default_factory=SamplerOptions)

    def __post_init__(self) -> None:
        if isinstance(self.sampler, Mapping | str):
            object.__setattr__(self, "sampler", SamplerOptions.of(self.sampler))
        for name, kind in (("denoiser", DenoiserCore), ("sampler", SamplerOptions)):
            if not isinstance(getattr(self, name), kind):
                got = type(getattr(self, name)).__name__
                raise ValueError(f"{name}: got {got}, expected {kind.__name__}; magnet.load() makes both")

    def __repr__(self) -> str:
        return f"Model of up to {self.most_people} people, sampled in {self.sampler.steps} steps"

    @property
    def most_people(self) -> int:
        return self.denoiser.layout.agents

    @cpu_by_default
    def generate(
        self,
        people: int = 2,
        frames: int = 300,
        *,
        body: str | Path | Body | None = None,
        seed: int | None = None,
        samples: int = 1,
        cond: Tensor | None = None,
    ) -> Motion:
        """Generate a scene of people of average shape, or a crowd of more than `most_people`, who differ.

        Args:
            body: their body model, or its file, as of the people the model was trained on; None: the open one.

        Raises:
            ValueError: more than 200 people.
        """
        require_whole("frames", frames, 1)  # `predict` would take None for the frames of the scene
        said: dict[str, Any] = {"seed": seed, "samples": samples, "cond": cond}
        scene = crowd_from_nothing(people, torch.Generator().manual_seed(self._generator(seed).initial_seed()))
        if people <= self.most_people:
            scene = scene.replace(betas=torch.zeros_like(scene.betas))
        if body is not None:
            given = body if isinstance(body, Body) else load_body(body)
            scene = Motion.of(scene.replace(body=given.id), given)
        return self.predict(scene, "generation", context=0, frames=frames, **said)

    @cpu_by_default
    def start_crowd(
        self, people: int, groups: Scene | Sequence[Scene] = (), spacing: float = SPACING, *, seed: int | None = None
    ) -> Motion:
        """The first frames of a crowd, for `predict` to continue; see `magnet.generation.crowd_start.start_crowd`."""
        return Motion.of(start_crowd(self.denoiser, people, self.sampler, self._generator(seed), groups, spacing))

    def continue_(
        self,
        scene: Scene,
        frames: int = 150,
        *,
        context: int | None = None,
        seed: int | None = None,
        samples: int = 1,
        cond: Tensor | None = None,
    ) -> Motion:
        """Continue a scene for everybody in it.

        Args:
            context: number of its last frames to start from; None: all of them. Rounded down to a multiple of 4, so
                that up to three of the first frames are left out. The result begins with them.

        Raises:
            ValueError: fewer than 4 frames.
        """
        require_rate(scene)
        if context is not None:
            require_whole("context", context)
        given = scene.frames if context is None else min(scene.frames, context)
        if given < TOKEN_FRAMES:
            raise ValueError(f"to go on, the model needs {TOKEN_FRAMES} frames or more; got {max(given, 0)}")
        given = given // TOKEN_FRAMES * TOKEN_FRAMES
        scene = scene.slice(scene.frames - given)
        said: dict[str, Any] = {"seed": seed, "samples": samples, "cond": cond}
        return self.predict(scene, "joint_future", context=given, frames=frames, **said)

    @cpu_by_default
    def inpaint(
        self,
        scene: Scene,
        agent: int | Sequence[int] = 0,
        *,
        shape: Tensor | Sequence[float] | None = None,
        seed: int | None = None,
        samples: int = 1,
    ) -> Motion:
        """Generate the whole motion of some agents, given all of the others'; their own motion in `scene` is not read.

        An agent who is not in the scene is added: `inpaint(solo, agent=1)` gives a person a partner.

        Args:
            shape: (10,) shape numbers of their bodies, zeros for an average one. None: agents of the scene keep their
                shape; added agents have the average shape.

        Raises:
            ValueError: no such agent, nobody else in the scene, or a shape of the wrong size.
        """
        require_rate(scene)
        targets = slots_of("agent", agent, self.most_people, "the model takes agents")
        if not targets:
            raise ValueError("agent: got none; name who is to be filled in")
        scene = scene.pad_agents(max(*targets, scene.agents - 1) + 1)
        slots = list(targets)
        present, betas = scene.present.clone(), torch.where(scene.present[..., None], scene.betas, 0.0)
        if shape is not None:
            numbers = torch.as_tensor(shape).to(betas)
            if numbers.shape != betas.shape[-1:]:
                raise ValueError(f"shape: got {tuple(numbers.shape)}, expected ({betas.shape[-1]},) shape numbers")
            betas[:, slots] = numbers
        present[:, slots] = True
        scene = scene.replace(present=present, betas=betas)
        return self.predict(scene, "partner_inpainting", context=0, seed=seed, samples=samples, target=targets)

    def react(
        self,
        scene: Scene,
        agent: int = 0,
        *,
        context: int = 32,
        block: int = 1,
        seed: int | None = None,
        samples: int = 1,
    ) -> Motion:
        """Generate an agent's reaction, from frame `context` on, to the others' motion up to each moment.

        Args:
            block: token steps (of 4 frames) that are generated at a time; the others are seen up to their end.
        """
        require_rate(scene)
        fields: dict[str, Any] = {"target": slots_of("agent", agent, scene.agents), "block": block}
        return self.predict(scene, "motion_control", context=context, seed=seed, samples=samples, **fields)

    @cpu_by_default
    def partner(
        self, past: Scene, agents: int | Sequence[int] = 0, *, block: int = 1, seed: int | None = None
    ) -> LivePartner:
        """Agents who react live: pass the others' newest frames, at least 4, to `partner(past).answer(frames)`.

        Answers are `Motion`s, with the body of `past`.

        Args:
            past: recent motion of everybody; a second is enough.
            agents: slots of the agents who react.
            block: token steps (of 4 frames) that are answered at a time; `answer` takes a whole number of these.

        Raises:
            ValueError: as `magnet.generation.partner.Partner`.
        """
        plain, body = _with_its_body(past, "past")
        warn_of_body(self.denoiser, plain)
        how = (slots_of("agents", agents, plain.agents, "past has people"), self.sampler, self._generator(seed), block)
        partner = LivePartner(self.denoiser, plain, *how)
        partner.model = body
        return partner

    @cpu_by_default
    def predict(
        self,
        scene: Scene,
        task: str = "joint_future",
        *,
        context: int = 32,
        frames: int | None = None,
        seed: int | None = None,
        samples: int = 1,
        cond: Tensor | None = None,
        **fields: Any,
    ) -> Motion:
        """Sample any task with its options `fields`; `magnet tasks` lists both.

        Whoever the task does not make is as recorded where the scene goes on, and else stands still. Given frames that
        are marked as not valid are read as they are, with a warning, and stay marked.

        Args:
            context: frames given of everybody at the start, a multiple of 4.
            frames: frames after the context; None: to the end of the scene.

        Raises:
            ValueError: no such task, or a scene it makes no sense on; says what to do.
        """
        chosen = task_of(task, fields)
        plain, body = _with_its_body(scene)
        warn_of_body(self.denoiser, plain)
        slots = scene.agents
        require_whole("context", context, 0)
        require_whole("samples", samples, 1)
        if frames is not None:
            require_whole("frames", frames, 1)
        else:
            frames = scene.frames - context
        if frames < 1:
            raise ValueError(f"the scene's {scene.frames} frames leave none to sample after {context} of context")
        plan = plan_of_scene(self.denoiser, chosen, slots, context, frames, self.sampler)
        if bool((bad := given_invalid(plain, plan.known).any(dim=0)).any()):
            first, count = int(bad.nonzero()[0]), int(bad.sum())
            which = f"frame {first}, is" if count == 1 else f"frame {first} first, are"
            warn_user(f"the scene: {counted(count, 'given frame')}, {which} not valid")
        named = chosen.named(len(plan.known)) if isinstance(chosen, Inbetweening) else []
        if within := [step for step in named if 0 <= step * TOKEN_FRAMES < context]:
            warn_user(f"context={context}: in it lie the keyframes at token steps {within}")
        made = self.sample(scene, chosen, context, frames, seed=seed, samples=samples, cond=cond)
        return Motion.of(completed(made.plain(), plain.to("cpu"), plan.known, ~plan.finished), body)

    @cpu_by_default
    def sample(
        self,
        scene: Scene,
        task: Task,
        context: int,
        frames: int,
        *,
        seed: int | None = None,
        samples: int = 1,
        cond: Tensor | None = None,
    ) -> Motion:
        """What the model makes for a task, and nothing else: whoever the task does not make stands still.

        Arguments and errors as of `predict`, which asks the task by name and shows these people as recorded.
        """
        plain, body = _with_its_body(scene)
        how = (context, frames, samples, self.sampler, self._generator(seed))
        sample = generate if scene.agents <= self.most_people else generate_crowd
        made = sample(self.denoiser, plain, task, *how, cond=cond).to("cpu")
        return Motion.of(made.permute_agents(torch.arange(scene.agents)), body)

    def _generator(self, seed: int | None) -> torch.Generator:
        generator = torch.Generator(self.denoiser.device)
        if seed is not None:
            require_whole("seed", seed, -(2**63), 2**63 - 1)
        generator.manual_seed(int(seed)) if seed is not None else generator.seed()  # NumPy's numbers are no int
        return generator


class LivePartner(Partner):
    """A `Partner` whose answers and past are `Motion`s, which show and save themselves."""

    model: Body | None = None
    """The body model of the past; None: the open one."""

    @property
    def past(self) -> Motion:
        return Motion.of(super().past, self.model)

    def answer(self, frames: Scene) -> Motion:
        """As `Partner.answer`."""
        return Motion.of(super().answer(frames), self.model)


def _with_its_body(scene: Scene, label: str = "the scene") -> tuple[Scene, Body | None]:
    """The plain scene and the body of its shapes, None for the open one.

    Raises:
        ValueError: no scene, another frame rate than the models', or shapes of a body that was not given.
    """
    require_rate(scene, label)
    plain, body = (scene.plain(), scene.model) if isinstance(scene, Motion) else (scene, None)
    given = open_body().id if body is None else body.id
    if scene.body != given:
        raise ValueError(
            f"{label}: its shapes belong to body {scene.body!r}, not {given!r}; give its file, "
            "magnet.read(..., body=FILE) or Motion.of(scene, magnet.load_body(FILE))"
        )
    return plain, body
