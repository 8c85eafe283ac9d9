"""RS: any stretch of training motion (paper 4.1)."""

from __future__ import annotations

import torch

from magnet.baselines.retrieval import Retrieval
from magnet.motion.scene import Scene


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
