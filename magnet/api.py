"""What Python users need: `magnet.load("duet").generate(people=2)`, and scenes that show and save themselves."""

from __future__ import annotations

import base64
import html
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from magnet.body import Body, load_body, on_floor
from magnet.denoiser.generation import SamplerOptions
from magnet.denoiser.module import Denoiser
from magnet.export import formats
from magnet.motion.scene import FPS, Scene, absent, require_rate
from magnet.motion.tokens import STRIDE
from magnet.partner import Partner
from magnet.tasks import registry

if TYPE_CHECKING:
    from magnet.tasks.base import Task

Player = Literal["page", "film"]


def load(
    name_or_path: str | Path | None = None,
    *,
    device: str | torch.device = "cpu",
    steps: int | None = None,
    sampler: str = "default",
) -> Model:
    """A trained model: one that comes with the package by its name ("duet"), or a checkpoint's path.

    Args:
        device: where it runs.
        steps: denoising steps; fewer are faster and coarser. None: the sampler's.
        sampler: how it samples: `default`, or `paper` for the paper's way; see `SamplerOptions.preset`.

    Raises:
        ValueError: no such model or sampler; names those there are.
    """
    options = SamplerOptions.preset(sampler, **({} if steps is None else {"steps": steps}))
    return Model(Denoiser.load(name_or_path).to(device), options)


def read(
    *paths: str | Path,
    body: str | Path | Body | None = None,
    fps: float | None = FPS,
    trim: bool = False,
    unit: str | None = None,
    up: str | None = None,
    joints: dict[str, str] | None = None,
    keep_floor: bool = False,
) -> Motion:
    """A scene from a file of ours, SMPL-X npz files or BVH files of any skeleton; several files are several people.

    Args:
        body: the scene's body model, or its file; None: the open one.
        fps: brought to this rate, the models'; None: as recorded.
        trim, unit, up, joints, keep_floor: as in `magnet.export.load_bvh`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a file that cannot be read, or files that do not go together; says what to do.
    """
    options = formats.Reading(fps, trim, unit, up, joints or {}, keep_floor)
    got = formats.read(list(paths), body, options)
    return Motion.of(got.scene, got.body, got.notes)


# -- scenes that show themselves ---------------------------------------------------------------


@dataclass(frozen=True)
class Motion(Scene):
    """A scene that knows its body, and how to show and save itself; it can stand wherever a `Scene` can."""

    model: Body | None = None  # the body model `betas` belong to; None: the open one
    notes: tuple[str, ...] = ()  # what is worth knowing about how it was read

    @classmethod
    def of(cls, scene: Scene, model: Body | None = None, notes: Sequence[str] = ()) -> Motion:
        """The same motion with what this class adds."""
        fields = {**scene.tensors(), "fps": scene.fps, "body": scene.body, "names": scene.names}
        return cls(**fields, model=model, notes=tuple(notes))  # type: ignore[arg-type]

    def plain(self) -> Scene:
        """The scene without what this class adds."""
        tensors = self.tensors()
        return Scene(**tensors, fps=self.fps, body=self.body, names=self.names)

    def joints(self) -> Tensor:
        """World joints of everybody. -> (B, T, P, 22, 3) metres"""
        return self._body().joints(self)

    def vertices(self) -> Tensor:
        """World vertices of everybody. -> (B, T, P, V, 3) metres"""
        return self._body().vertices(self)

    def on_floor(self) -> Motion:
        """The same motion with whoever stands lowest on y = 0, where models have their floor; each scene by itself."""
        return Motion.of(on_floor(self.plain(), self._body()), self.model, self.notes)

    def save(self, path: str | Path, **options: Any) -> Path:
        """Write the format of the path's suffix: .npz .bvh .glb .csv .html .mp4 .gif .webp .png.

        Options are those of `magnet.export.formats.write`: fps, unit, smplx, style, title.

        Returns:
            The path written; the first of them where a format needs several files (a BVH a person).

        Raises:
            ValueError: a suffix that nothing writes, or a scene that the format cannot hold.
        """
        path = Path(path)
        if path.suffix == ".npz" and not options:
            return super().save(path)
        return formats.write(self.plain(), path, self._body(), **{"context_frames": self.context, **options})[0]

    @property
    def context(self) -> int:
        """How many first frames were given of everybody."""
        if self.given is None:
            return 0
        whole = (self.given | ~self.present[:, None]).all(dim=0).all(dim=1)
        return int(whole.long().cumprod(dim=0).sum())

    def show(self, scene: int | None = None, player: Player = "page", **options: Any) -> Shown:
        """Something a notebook plays inline.

        Args:
            scene: which of the B scenes; None: all, side by side.
            player: `page`, an interactive player that works without a server, or `film`, an animated picture.
            options: of `save` for that kind: style, title, fps.
        """
        shown = self if scene is None else Motion.of(self.pick([scene]), self.model)
        with tempfile.TemporaryDirectory() as folder:
            kind = {"page": ".html", "film": ".webp"}[player]
            if player == "film":
                options = {"style": "skeleton", "fps": 15.0, **options}
            path = shown.save(Path(folder) / f"scene{kind}", **options)
            return Shown(path.read_bytes(), kind)

    def _body(self) -> Body:
        return self.model or load_body("open")


@dataclass(frozen=True, repr=False)
class Shown:
    """A page or a film: notebooks play it inline, elsewhere `save` it."""

    data: bytes
    kind: str  # .html or .webp

    def _repr_html_(self) -> str:
        if self.kind == ".html":
            page = html.escape(self.data.decode(), quote=True)
            return f'<iframe srcdoc="{page}" style="width:100%;height:520px;border:0" allowfullscreen></iframe>'
        return f'<img alt="scene" src="data:image/webp;base64,{base64.b64encode(self.data).decode()}">'

    def save(self, path: str | Path) -> Path:
        """Write it to a file, for a browser. Returns the path written."""
        path = Path(path).with_suffix(self.kind)
        path.write_bytes(self.data)
        return path

    def __repr__(self) -> str:
        return f"a {len(self.data) / 1e6:.1f} MB {self.kind}, played in notebooks; elsewhere .save('scene{self.kind}')"


# -- a model -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Model:
    """A trained model and how it samples.

    Every method takes `seed` (None: another result each time) and `samples`: sample s of scene b is scene
    b * samples + s of the result, which includes the given frames.
    """

    denoiser: Denoiser
    sampler: SamplerOptions = field(default_factory=SamplerOptions)

    @property
    def most_people(self) -> int:
        return self.denoiser.layout.agents

    def generate(self, people: int = 2, frames: int = 300, *, seed: int | None = None, samples: int = 1) -> Motion:
        """A scene from nothing, of people of average shape.

        Raises:
            ValueError: more people than the model has room for.
        """
        if not 1 <= people <= self.most_people:
            raise ValueError(f"people: got {people}, the model takes 1 to {self.most_people}")
        empty = absent(1, STRIDE, people, torch.zeros(()))
        scene = empty.replace(present=torch.ones(1, people, dtype=torch.bool))
        return self.predict(scene, "generation", context=0, frames=frames, seed=seed, samples=samples)

    def continue_(
        self, scene: Scene, frames: int = 150, *, context: int | None = None, seed: int | None = None, samples: int = 1
    ) -> Motion:
        """How a scene goes on for everybody in it.

        Args:
            context: how many of its last frames the model starts from; None: all of them. Rounded down to a multiple
                of 4; the result begins with them.

        Raises:
            ValueError: fewer than 4 frames.
        """
        given = scene.frames if context is None else min(scene.frames, context)
        given = given // STRIDE * STRIDE
        if given < STRIDE:
            raise ValueError(f"to go on, the model needs {STRIDE} frames or more; got {max(given, 0)}")
        scene = scene.cut(scene.frames - given)
        return self.predict(scene, "joint_future", context=given, frames=frames, seed=seed, samples=samples)

    def inpaint(
        self, scene: Scene, agent: int | Sequence[int] = 0, *, seed: int | None = None, samples: int = 1
    ) -> Motion:
        """The whole motion of some agents, given all of the others'; nothing of theirs in `scene` is read.

        An agent beyond those in the scene is added: `inpaint(solo, agent=1)` gives a person a partner.
        """
        targets = (agent,) if isinstance(agent, int) else tuple(agent)
        if not targets:
            raise ValueError("agent: got none; name who is to be filled in")
        scene = self._with_room(scene, max(targets) + 1)
        present = scene.present.clone()
        present[:, list(targets)] = True
        scene = scene.replace(present=present)
        return self.predict(scene, "partner_inpainting", context=0, seed=seed, samples=samples, target=targets)

    def react(
        self, scene: Scene, agent: int = 0, *, context: int = 32, seed: int | None = None, samples: int = 1
    ) -> Motion:
        """An agent's answer, from its first `context` frames on, to what the others do up to each moment."""
        return self.predict(scene, "motion_control", context=context, seed=seed, samples=samples, target=(agent,))

    def partner(self, past: Scene, agents: int | Sequence[int] = 0, *, seed: int | None = None) -> Partner:
        """Agents who answer live: `partner(past).answer(frames)` with the others' newest frames, 4 or more at a time.

        Args:
            past: how it began, of everybody; a second is enough.
            agents: slots of those who answer.

        Raises:
            ValueError: as `magnet.partner.Partner`.
        """
        plain = past.plain() if isinstance(past, Motion) else past
        targets = (agents,) if isinstance(agents, int) else tuple(agents)
        return Partner(self.denoiser, plain, targets, self.sampler, self._generator(seed))

    def predict(
        self,
        scene: Scene,
        task: str = "joint_future",
        *,
        context: int = 32,
        frames: int | None = None,
        seed: int | None = None,
        samples: int = 1,
        **fields: Any,
    ) -> Motion:
        """Sample any task; see `magnet tasks`, and `fields` are its own.

        Args:
            context: frames given of everybody at the start, a multiple of 4.
            frames: frames after the context; None: to the end of the scene.

        Raises:
            ValueError: no such task, or a scene it makes no sense on; says what to do.
        """
        kind = registry.get(task)
        require_rate(scene)
        slots = scene.agents
        if slots > self.most_people:
            raise ValueError(f"the scene has {slots} agents, the model takes 1 to {self.most_people}")
        for name, number in (("frames", frames), ("samples", samples)):
            if number is not None and number < 1:
                raise ValueError(f"{name}: got {number}, expected 1 or more")
        if frames is None:
            frames = scene.frames // STRIDE * STRIDE - context
        if frames < 1:
            raise ValueError(f"the scene's {scene.frames} frames leave none to sample after {context} of context")
        chosen: Task = kind(**fields)
        generator = self._generator(seed)
        plain = scene.plain() if isinstance(scene, Motion) else scene
        sampled = self.denoiser.generate(plain, chosen, context, frames, samples, self.sampler, generator).to("cpu")
        shown = sampled.order(torch.arange(slots))
        return Motion.of(shown, scene.model if isinstance(scene, Motion) else None)

    def _generator(self, seed: int | None) -> torch.Generator:
        generator = torch.Generator(self.denoiser.device)
        generator.manual_seed(seed) if seed is not None else generator.seed()
        return generator

    def _with_room(self, scene: Scene, slots: int) -> Scene:
        if slots > self.most_people:
            raise ValueError(f"agent {slots - 1}: the model takes agents 0 to {self.most_people - 1}")
        return scene.pad_agents(max(slots, scene.agents))
