"""Small models and motions for tests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import roma
import torch
from torch import Tensor

from magnet.body import load_body
from magnet.motion.frames import rigid
from magnet.motion.scene import FPS, Scene

if TYPE_CHECKING:
    from magnet.denoiser.module import Denoiser
    from magnet.tokenizer.module import Tokenizer


def random_scene(
    scenes: int, frames: int, agents: int, generator: torch.Generator, present: Tensor | None = None
) -> Scene:
    """Smooth random motion: upright bodies that wander and turn, with all joints moving a little."""

    def smooth(*shape: int, scale: float) -> Tensor:
        """A few slow sine waves along the second axis."""
        time = torch.linspace(0, frames / FPS, frames).view(1, -1, *[1] * (len(shape) - 2))
        wave = torch.zeros(shape)
        for frequency in (0.3, 0.7, 1.3):
            size = torch.randn(shape[0], 1, *shape[2:], generator=generator)
            phase = 6.28 * torch.rand(shape[0], 1, *shape[2:], generator=generator)
            wave = wave + size * (6.28 * frequency * time + phase).sin()
        return scale * wave

    body_rot = roma.rotvec_to_rotmat(smooth(scenes, frames, agents, 21, 3, scale=0.2))
    tilt = roma.rotvec_to_rotmat(smooth(scenes, frames, agents, 3, scale=0.1))
    yaw = 6.28 * torch.rand(scenes, 1, agents, generator=generator) + smooth(scenes, frames, agents, scale=0.4)
    heading = roma.rotvec_to_rotmat(torch.stack([0 * yaw, yaw, 0 * yaw], dim=-1))
    start = torch.randn(scenes, 1, agents, 3, generator=generator)
    position = start + smooth(scenes, frames, agents, 3, scale=0.3)
    position[..., 1] = 0.9 + 0.05 * smooth(scenes, frames, agents, scale=1.0)
    scene = Scene(
        body_rot=body_rot,
        T_world_root=rigid(heading @ tilt, position),
        betas=0.5 * torch.randn(scenes, agents, 10, generator=generator),
        present=torch.ones(scenes, agents, dtype=torch.bool),
    )
    return scene if present is None else without_absent(scene.replace(present=present))


def standing_people(frames: int = 60, agents: int = 2, apart: float = 1.0) -> Tensor:
    """Joints of people of average shape who stand still in the T pose, in a row. -> (1, T, P, 22, 3) metres"""
    body = load_body("open")
    rest = body.rest_joints(torch.zeros(10))
    rest = rest - torch.tensor([0.0, float(body.v_template[:, 1].min()), 0.0])
    aside = apart * torch.arange(agents)[:, None, None] * torch.tensor([0.0, 0.0, 1.0])
    return (rest + aside).expand(1, frames, agents, -1, 3)


def without_absent(scene: Scene) -> Scene:
    """Empty the slots of agents that are not present, as every reader does."""
    there = scene.present[:, None, :, None, None]
    eye = torch.eye(4, device=scene.device)
    return scene.replace(
        body_rot=torch.where(there[..., None], scene.body_rot, eye[:3, :3]),
        T_world_root=torch.where(there, scene.T_world_root, eye),
        betas=torch.where(scene.present[..., None], scene.betas, 0.0),
    )


TINY_TOKENIZER = {"network": {"width": 16, "depth": 1}, "quantizer": {"codebook_dim": 16, "codebook_size": 32}}
TINY_DENOISER = {"network": {"width": 32, "layers": 2, "heads": 2, "mlp_ratio": 2, "dropout": 0.0}}


def tiny_tokenizer(seed: int = 0, **options: Any) -> Tokenizer:
    """A tokenizer of a few thousand weights, whose codebook is set; groups of options as dictionaries."""
    from magnet.tokenizer.module import Tokenizer

    with torch.random.fork_rng():
        torch.manual_seed(seed)
        tokenizer = Tokenizer(**_grouped(TINY_TOKENIZER, options))
        tokenizer.init_codebook([random_scene(4, 32, 2, torch.Generator().manual_seed(seed))])
    return tokenizer


def tiny_denoiser(max_agents: int = 3, window: int = 8, seed: int = 0, **options: Any) -> Denoiser:
    """An untrained denoiser of a few thousand weights, with a tokenizer whose codebook is set.

    Options are those of `Denoiser`, groups as dictionaries: `network={"layers": 1}`.
    """
    from magnet.denoiser.module import Denoiser
    from magnet.tokenizer.module import Tokenizer

    with torch.random.fork_rng():
        torch.manual_seed(seed)
        tokenizer = Tokenizer(**_grouped(TINY_TOKENIZER, {}))
        generator = torch.Generator().manual_seed(seed)
        tokenizer.init_codebook([random_scene(4, 32, 2, generator)])
        model = Denoiser(max_agents=max_agents, window=window, **_grouped(TINY_DENOISER, options))
        model.build(tokenizer)
        model.fit_normalizer(*model.tokenize(random_scene(4, 32, max_agents, generator)))
    return model.eval()


def _grouped(small: dict[str, dict[str, Any]], options: dict[str, Any]) -> dict[str, Any]:
    """Options over small sizes, group by group."""
    return {**small, **{k: {**small[k], **v} if k in small else v for k, v in options.items()}}
