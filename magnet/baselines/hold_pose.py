"""Hold the last pose: hard to beat on position error for half a second, with no motion at all."""

import torch

from magnet.motion.scene import Scene


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
        )
