"""What is measured: anything that answers test scenes with joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from magnet.baselines.retrieval import Retrieval
from magnet.body import Body
from magnet.motion.scene import Scene, concatenate

Generators = Sequence[torch.Generator]


class Predictor(Protocol):
    """A method under test.

    It is given whole test scenes and must read of them no more than its task gives.
    """

    def __call__(self, scene: Scene, samples: int, generators: Generators) -> Tensor:
        """Future joints in the world of the recording.

        Args:
            scene: (B, T, P) whole test scenes.
            samples: futures S wanted of each.
            generators: sources of randomness, that of sample s of scene b at b * samples + s.

        Returns:
            (S, B, horizon, P, 22, 3) metres; anything where an agent is absent.
        """
        ...


def joints_of(made: Scene, body: Body, samples: int) -> Tensor:
    """Joints of scenes in which sample s of scene b is at b * samples + s. (B * S, T, P) -> (S, B, T, P, 22, 3)"""
    return body.joints(made).unflatten(0, (-1, samples)).transpose(0, 1)


class SceneBaseline:
    """A baseline that continues a context by scenes, as a `Predictor`.

    Args:
        method: (context, horizon, samples, generator) -> scenes (B * samples, horizon, P).
        body: the body model of what it makes.
        context: frames of a test scene that it is shown.
        horizon: frames that it makes.
        draws: it reads the generator, so it is asked for each scene alone.
    """

    def __init__(
        self, method: Callable[..., Scene], body: Body, context: int, horizon: int, draws: bool = False
    ) -> None:
        self.method, self.body, self.draws = method, body, draws
        self.context, self.horizon = context, horizon

    def __call__(self, scene: Scene, samples: int, generators: Generators) -> Tensor:
        past, first = scene.slice(0, self.context), generators[::samples]
        with torch.autocast(scene.device.type, enabled=False):
            if self.draws:
                each = [self.method(past.select([b]), self.horizon, samples, first[b]) for b in range(past.scenes)]
                return joints_of(concatenate(each), self.body, samples)
            return joints_of(self.method(past, self.horizon, samples), self.body, samples)


class JointBaseline:
    """A baseline that continues a context by joints, always by the same, as a `Predictor`.

    Args:
        method: (context, horizon) -> joints (B, horizon, P, 22, 3) in the context's world.
        context: frames of a test scene that it is shown.
        horizon: frames that it makes.
    """

    def __init__(self, method: Callable[[Scene, int], Tensor], context: int, horizon: int) -> None:
        self.method, self.context, self.horizon = method, context, horizon

    def __call__(self, scene: Scene, samples: int, generators: Generators) -> Tensor:
        with torch.autocast(scene.device.type, enabled=False):
            made = self.method(scene.slice(0, self.context), self.horizon)
        return made.expand(samples, *made.shape)


class RandomSample(Retrieval):
    """Each sample continues as another random training stretch with as many people; see `Retrieval`."""

    def __call__(
        self, context: Scene, horizon: int, samples: int = 1, generator: torch.Generator | None = None
    ) -> Scene:
        """-> (B * samples, horizon, P), sample s of scene b at b * samples + s."""
        self.check(context, horizon)
        chosen = []
        for people in context.present.sum(dim=1).tolist():
            among = self.candidates(people)
            device = torch.device("cpu") if generator is None else generator.device
            drawn = torch.randint(len(among), (samples,), generator=generator, device=device)
            chosen.append(among[drawn.to(among.device)])
        return self.answer(context.repeat(samples), horizon, torch.cat(chosen))


class HoldPose:
    """Everybody stands still from the last context frame on."""

    def __call__(
        self, context: Scene, horizon: int, samples: int = 1, generator: torch.Generator | None = None
    ) -> Scene:
        """-> (B * samples, horizon, P), sample s of scene b at b * samples + s; draws nothing from `generator`."""
        last = context.slice(context.frames - 1).repeat(samples)
        return last.replace(
            body_rot=last.body_rot.expand(-1, horizon, -1, -1, -1, -1).clone(),
            T_world_root=last.T_world_root.expand(-1, horizon, -1, -1, -1).clone(),
            valid=None,
            given=None,
        )
