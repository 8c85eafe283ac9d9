"""Where a crowd begins: small groups put side by side on a floor plan."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from magnet.checks import require_number, require_whole
from magnet.denoiser.core import DenoiserCore
from magnet.generation.loaded import Loaded, denoiser_of
from magnet.generation.rollout import generate
from magnet.motion.frames import from_planar
from magnet.motion.scene import Scene, cat_agents, empty_scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.precision import cpu_by_default
from magnet.sampling.options import LEAST_SPACING, MOST_SPACING, SamplerOptions
from magnet.tasks.joint import Generation

MOST = 200
"""People of a crowd: more were not tried."""

SPACING = SamplerOptions.crowd_spacing
"""Metres from the middle of a group to that of the next, where nothing is said."""

START = 32
"""Frames of a start that the model makes: a second."""

SHAPES = 0.7
"""Standard deviation of the shape numbers of people who are made from nothing."""


@cpu_by_default
def start_crowd(
    model: DenoiserCore | Loaded,
    people: int,
    options: SamplerOptions | None = None,
    generator: torch.Generator | None = None,
    groups: Scene | Sequence[Scene] = (),
    spacing: float = SPACING,
    betas: Tensor | None = None,
) -> Scene:
    """How a crowd begins: given groups again and again, or couples of different shapes that the model makes.

    Args:
        model: which makes couples where there are no groups.
        people: how many in all.
        options: how couples are sampled.
        generator: source of randomness, on the model's device.
        groups, spacing: as for `compose`; couples that the model makes need `LEAST_SPACING` metres.
        betas: (people, 10) shapes of people whom the model makes; None: by chance.

    Returns:
        One scene of `people`; of `START` frames where the model makes it.

    Raises:
        ValueError: nobody, more people than `MOST`, or couples so near that people begin in each other's bodies.
    """
    require_whole("people", people, 1, MOST)
    model = denoiser_of(model)
    groups = [groups] if isinstance(groups, Scene) else groups
    turns = torch.Generator()
    turns.manual_seed(int(torch.randint(2**62, (), generator=generator, device=model.device)))
    if not groups:
        require_number("spacing", spacing, least=LEAST_SPACING, most=MOST_SPACING)
        couples = -(-people // 2)
        empty = empty_scene(couples, TOKEN_FRAMES, 2, torch.zeros((), dtype=torch.float32))
        shapes = shapes_by_chance(2 * couples, turns)
        if betas is not None:
            shapes[:people] = betas.cpu()
        scene = empty.replace(present=torch.ones(couples, 2, dtype=torch.bool), betas=shapes.view(couples, 2, 10))
        made = generate(model, scene, Generation(), 0, START, 1, options, generator).to("cpu")
        groups = [made.select([number]) for number in range(couples)]
    return compose(groups, people, turns, spacing)


def shapes_by_chance(people: int, generator: torch.Generator | None = None) -> Tensor:
    """Shapes of people who differ. (people, 10); generator: on the CPU"""
    return (SHAPES * torch.randn(people, 10, generator=generator, dtype=torch.float32)).clamp(-2, 2)


def crowd_from_nothing(people: int, generator: torch.Generator | None = None) -> Scene:
    """A scene of people who differ in shape and of whom nothing else is known, for the task `generation`.

    generator: of the shapes, on the CPU.

    Raises:
        ValueError: nobody, or more people than `MOST`.
    """
    require_whole("people", people, 1, MOST)
    empty = empty_scene(1, TOKEN_FRAMES, people, torch.zeros((), dtype=torch.float32))
    there = torch.ones(1, people, dtype=torch.bool)
    return empty.replace(present=there, betas=shapes_by_chance(people, generator)[None])


def start_from_nothing(
    model: DenoiserCore, scene: Scene, options: SamplerOptions | None, generator: torch.Generator | None
) -> Scene:
    """The start of a crowd that has no motion yet: couples that the model makes, in the slots and shapes of its people.

    scene (1, T, P) -> (1, START, P)
    """
    there = scene.present[0].cpu()
    count = int(there.sum())
    spacing, betas = (options or SamplerOptions()).crowd_spacing, scene.betas[0, there.to(scene.device)]
    made = start_crowd(model, count, options, generator, (), spacing, betas)
    slots = torch.where(there, there.cumsum(0) - 1, count + (~there).cumsum(0) - 1)
    made = made.pad_agents(scene.agents).permute_agents(slots).to(scene.device)
    return made.replace(body=scene.body, betas=scene.betas, names=scene.names)


def compose(groups: Sequence[Scene], people: int, generator: torch.Generator, spacing: float = SPACING) -> Scene:
    """Groups on one floor: in the cells of a grid that is as square as possible, turned by chance.

    Args:
        groups: single scenes of the same length, frame rate and body; taken in turns, again and again. What is not
            present is left out.
        people: how many in all; of the last group no more than are needed.
        generator: of the turns, on the CPU.
        spacing: metres between the middles of neighbouring cells.

    Returns:
        One scene of `people`, all present, in the middle of the floor.

    Raises:
        ValueError: there are no groups or nobody in them, they differ, or counts that are none.
    """
    require_whole("people", people, 1)
    require_number("spacing", spacing, over=0)
    if not groups or any(one.scenes != 1 or not bool(one.present.any()) for one in groups):
        raise ValueError(
            "groups: got none, several in one, or an empty one; expected single scenes with people in them"
        )
    for field in ("frames", "fps", "body"):
        if len(several := {getattr(one, field) for one in groups}) > 1:
            raise ValueError(
                f"groups: {field} differ, got {', '.join(map(str, sorted(several)))}; expected one for all"
            )
    parts: list[Scene] = []
    count = 0
    while count < people:
        one = groups[len(parts) % len(groups)]
        there = one.present[0].nonzero()[:, 0][: people - count]
        parts.append(one.permute_agents(there).replace(given=None, valid=None, names=()))
        count += len(there)
    columns = math.ceil(math.sqrt(len(parts)))
    rows = math.ceil(len(parts) / columns)
    placed = []
    for number, part in enumerate(parts):
        row, column = divmod(number, columns)
        cell = spacing * torch.tensor([column - (columns - 1) / 2, row - (rows - 1) / 2], dtype=torch.float32)
        middle = part.T_world_root[0, :, :, [0, 2], 3].mean(dim=(0, 1)).cpu()
        turn = 2 * math.pi * torch.rand((), generator=generator, dtype=torch.float32)
        T_cell_middle = from_planar(torch.zeros_like(turn), -middle.float())
        T_floor_cell = from_planar(turn, cell)
        placed.append(part.transformed((T_floor_cell @ T_cell_middle).to(part.T_world_root)))
    return cat_agents(placed)


def require_crowd(model: DenoiserCore, scene: Scene, context: int, options: SamplerOptions) -> None:
    """Check that a crowd can go on from a scene so.

    Raises:
        ValueError: too many people, no context, or a model or options that are not for crowds.
    """
    if scene.agents > MOST:
        raise ValueError(f"got {scene.agents} people, expected at most {MOST}")
    if model.layout.agents < 2 or not model.layout.slots:
        raise ValueError("crowds need a model with pairwise transforms of two people or more")
    if context < TOKEN_FRAMES or context > scene.frames:
        raise ValueError(
            f"context: got {context} of {scene.frames} frames; a crowd goes on from where everybody stands: give at "
            f"least {TOKEN_FRAMES} frames of everybody, for example by `compose`"
        )
    for name, off in (("body_guidance", "off"), ("settle_blocks", False)):
        if getattr(options, name) != off:
            raise ValueError(f"{name}: got {getattr(options, name)}, expected {off} in a crowd; apart works there")
    if options.placement == "anchor":
        raise ValueError("placement: got anchor, expected fuse or integrate in a crowd: nobody knows everybody")
