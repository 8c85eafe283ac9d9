"""Guidance by bodies: what the model expects is pushed out of collisions while it is sampled."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.base import Body
from magnet.body.energy import CONTACT, limit_excess, pair_energy, slide, under_floor
from magnet.body.fit import clearance
from magnet.body.fitted_capsules import fit_capsules
from magnet.body.settle_wishes import standing
from magnet.generation.separation import open_body_on
from magnet.generation.world import WorldState
from magnet.motion.frames import from_9d, partners, posed, project_se2, to_planar
from magnet.motion.placement import place
from magnet.motion.planar import rotate_ground
from magnet.motion.tokens import TOKEN_FRAMES, by_frame, by_token, pairwise_by_frame, pairwise_by_token
from magnet.sampling.grid import Grid
from magnet.sampling.plans import token_levels

LAST = 3
"""Tokens are guided in the last third of their denoising steps."""

FARTHEST = {"light": 0.02, "firm": 0.04}
"""Metres that a place is moved in one denoising step at most."""

STEP = {"light": 0.5, "firm": 1.0}
"""Share of a step that would make the energy 0, were it quadratic."""

RAMP = 8
"""Frames over which a place's move grows."""

AVERAGED = 4
"""Frames before and after that a place's move is averaged over."""

BENT = 0.1
"""Of a latent's length: what a step changes of it at most."""

FEET, TURNS = 1.0, 0.01
"""Weights of squared metres of feet, and of squared radians beyond the range of joints, against squared depth."""


class BodyGuidance:
    """Moves the clean estimate down the energy of bodies together, through the decoder alone.

    The energy is `magnet.body.energy` of the bodies that the estimate decodes to, placed as the world would place them.
    Its slope with respect to latents goes through the decoder; with respect to places it is that of moving people over
    the ground, and deltas and pairwise transforms are changed by as much as such a move changes them. Only numbers of
    tokens whose level is low are changed, so given and finished ones never are. What a view hides does not count in it.

    Args:
        world: where everybody is.
        how: `light` or `firm`.
        low: level up to which tokens are guided.
        every: denoising steps from one guided one to the next.
    """

    def __init__(self, world: WorldState, how: str, low: int, every: int) -> None:
        self.world, self.how, self.low, self.every = world, how, low, every
        self.steps = 0

    @classmethod
    def of(cls, world: WorldState, grid: Grid) -> BodyGuidance:
        """As the options of a world say; each token is guided at least once in the last third of its steps."""
        last = -(-grid.steps // LAST)
        low = int(token_levels(grid)[grid.steps - last].max())
        return cls(world, world.options.body_guidance, low, last)

    def __call__(self, clean: Tensor, now: Tensor, hidden: Tensor | None, first: int) -> Tensor:
        """The estimate with its bodies out of each other.

        Args:
            clean: (B V, W, P, D) normalized, of each view.
            now: (V, W, P) int, levels that it was made at.
            hidden: (V, W, P) bool, what each view hides; None: nothing.
            first: token step, of all, that the window begins with.
        """
        first -= self.world.released
        low = (now > 0) & (now <= self.low)
        if not bool(low.any()):
            return clean
        self.steps += 1
        if self.steps % self.every:
            return clean
        views = len(now)
        for view in range(views):
            unseen = torch.zeros_like(low[0]) if hidden is None else hidden[view]
            moves = low[view] & ~unseen
            if bool(moves.any()):
                clean[view::views] = self._guided(clean[view::views], now[view], moves, unseen, first)
        return clean

    def _guided(self, clean: Tensor, now: Tensor, moves: Tensor, unseen: Tensor, first: int) -> Tensor:
        """One view. clean (B, W, P, D), now (W, P) int, moves, unseen (W, P) bool -> (B, W, P, D)"""
        world = self.world
        model = world.model
        rows = moves.any(dim=1).nonzero()[:, 0]
        placed = world.placed[first : first + len(moves)].to(moves.device)
        there = world.given.present.any(dim=0)
        open_rows = (~placed & there).any(dim=1).nonzero()[:, 0]
        begin, stop = min(int(rows[0]), int(open_rows[0])) if len(open_rows) else int(rows[0]), int(rows[-1]) + 1
        gone = unseen[begin:stop].any(dim=0)
        if bool(gone.any()) and first + begin == 0:
            return clean  # nobody stands anywhere yet, and who is hidden may not say where
        low, high = max(begin - 1, 0), min(stop + 1, clean.shape[1])
        tokens = model.normalizer.denormalize(clean)
        latent, deltas, pairs = model.layout.unpack(tokens)
        seen = world.given.present & ~gone
        T_world_can = self._placed(deltas[:, begin:stop], pairs[:, begin:stop], first + begin, seen, gone)
        frames = slice((first + low) * TOKEN_FRAMES, (first + stop) * TOKEN_FRAMES)
        if low < begin:
            before = world.T_world_can[:, frames.start : frames.start + TOKEN_FRAMES]
            T_world_can = torch.cat([before, T_world_can], dim=1)
        decoded = latent[:, low:high], deltas[:, low:high]
        moved = moves[low:stop]
        bend, shift = self._moves(*decoded, T_world_can, frames, moved, seen)
        latent = latent.clone()
        latent[:, low:stop] += bend
        deltas, pairs = moved_along(deltas, pairs, T_world_can, shift, low, stop)
        group = model.layout.spread(model.layout.group_levels(torch.where(unseen, self.low + 1, now)))
        changed = (group > 0) & (group <= self.low)
        return torch.where(changed, model.tokens_of(latent, deltas, pairs), clean)

    def _placed(self, deltas: Tensor, pairs: Tensor, row: int, seen: Tensor, gone: Tensor) -> Tensor:
        """Where everybody would stand in some rows. seen (B, P), gone (P,) bool -> (B, 4 n, P, 4, 4)"""
        world, options, n = self.world, self.world.options, deltas.shape[1]
        known = world.placed[row].to(deltas.device) & ~gone
        true_deltas = from_9d(by_frame(world.placed_deltas(row, row + n)))
        T_prev_can = torch.where(known[:, None, None], true_deltas, project_se2(from_9d(by_frame(deltas))))
        T_self_partner = from_9d(pairwise_by_frame(pairs)) if world.model.layout.slots else None
        made = place(
            T_prev_can, T_self_partner, world.starts(T_prev_can, T_self_partner, row, ~known), options.placement,
            options.weight_of_pairs, present=seen, fixed=known, anchor=seen.int().argmax(dim=1),
        )  # fmt: skip
        frames = slice(row * TOKEN_FRAMES, (row + n) * TOKEN_FRAMES)
        stands = world.rows_by_frame(world.placed[row : row + n])[..., None, None] & ~gone[:, None, None]
        return torch.where(stands, world.T_world_can[:, frames], made)

    @torch.enable_grad()
    def _moves(
        self, latent: Tensor, deltas: Tensor, T_world_can: Tensor, frames: slice, moves: Tensor, seen: Tensor
    ) -> tuple[Tensor, Tensor]:
        """What to add to latents and to places, down the energy's slope. -> (B, n, P, C), (B, 4 n, P, 2) metres

        Args:
            latent, deltas: (B, n + 1 or n, P, ...) of the rows and, where there is one, of that behind them.
            T_world_can: (B, 4 n, P, 4, 4) where people stand.
            frames: of the world, in these rows.
            moves: (n, P) bool, who may be moved.
            seen: (B, P) bool, who counts.
        """
        with torch.inference_mode(False):  # Lightning tests in inference mode, whose tensors no gradient may pass
            world, body = self.world, open_body_on(latent.device)
            slots = world.given.present.any(dim=0).nonzero()[:, 0]
            n, T = len(moves), len(moves) * TOKEN_FRAMES
            bend, shift = torch.zeros_like(latent[:, :n]), torch.zeros_like(T_world_can[..., :2, 3])
            moves, seen, T_world_can = moves[:, slots].clone(), seen[:, slots].clone(), T_world_can[:, :, slots].clone()
            leaf = latent[:, :, slots].clone().requires_grad_()
            place_shift = shift[:, :, slots].clone().requires_grad_()
            given = world.given.slice(frames.start, frames.stop).permute_agents(slots)
            given = given.replace(**{name: value.clone() for name, value in given.tensors().items()})
            given.betas[~given.present] = 0.0  # of a slot that is free in this scene they may not even be finite
            features = world.model.tokenizer.decode(leaf, given.betas, deltas[:, :, slots].clone())[:, :T]
            made = posed(features, T_world_can, given)
            real = world.rows_by_frame(world.known[frames.start // TOKEN_FRAMES : frames.stop // TOKEN_FRAMES])[
                :, slots
            ]
            body_rot = torch.where(real[..., None, None, None], given.body_rot, made.body_rot)
            root = torch.where(real[..., None, None], given.T_world_root, made.T_world_root)
            x, z = place_shift.unbind(-1)
            lifted = torch.stack([x, torch.zeros_like(x), z], dim=-1)
            root = torch.cat([root[..., :3, :3], (root[..., :3, 3] + lifted)[..., None]], dim=-1)
            energy = self._energy(body, body_rot, root, lifted, given.betas, moves, seen)
            if not bool((energy > 0).any()):
                return bend, shift
            by_latent, by_place = torch.autograd.grad(energy.sum(), (leaf, place_shift))
            found = self._steps(leaf.detach()[:, :n], by_latent[:, :n], by_place, energy.detach(), moves)
            bend[:, :, slots], shift[:, :, slots] = found
        return bend, shift

    def _energy(
        self, body: Body, body_rot: Tensor, root: Tensor, lifted: Tensor, betas: Tensor, moves: Tensor, seen: Tensor
    ) -> Tensor:
        """(B, T) m^2, of frames in which somebody moves"""
        capsules = fit_capsules(body, betas)
        R_world, joints = body.bone_chain(body_rot, root, body.rest_joints(betas[:, None]))
        there = seen[:, None].expand(joints.shape[:3])
        total = pair_energy(capsules.posed(R_world, joints), capsules.radius, there, CONTACT[self.how])
        above = clearance(body, betas.flatten(0, 1)).unflatten(0, betas.shape[:2])
        feet = under_floor(joints, above[:, None]).square().sum(dim=-1)
        joints = joints - lifted[..., None, :]  # feet are mended by poses: moves by place would shake
        stands = standing(joints.detach(), above, self.world.given.fps)
        slid = F.pad(slide(joints, stands).square().sum(dim=-1), (0, 0, 1, 0))
        turned = limit_excess(body_rot).square().sum(dim=-1)
        own = torch.where(there, FEET * (feet + slid) + TURNS * turned, 0.0)
        moving = moves.any(dim=1).repeat_interleave(TOKEN_FRAMES)
        return torch.where(moving, total + own.sum(dim=-1), 0.0)

    def _steps(
        self, latent: Tensor, by_latent: Tensor, by_place: Tensor, energy: Tensor, moves: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Polyak steps, half of the energy to be taken out by latents and half by places. -> as `_moves`

        latent, by_latent (B, n, P, C) and by_place (B, 4 n, P, 2) the energy's slopes; energy (B, 4 n); moves (n, P)
        """
        who = moves.repeat_interleave(TOKEN_FRAMES, dim=0)
        by_place = torch.where(who[..., None], by_place, 0.0)
        by_latent = torch.where(moves[..., None], by_latent, 0.0)
        steep = by_place.square().sum(dim=(2, 3), keepdim=True).clamp_min(1e-8)
        shift = -STEP[self.how] * energy[..., None, None] / steep * by_place
        begun = who.int().cumsum(dim=0) * who  # it grows from where people stand
        shift = smoothed(shift) * (begun / RAMP).clamp(max=1.0)[..., None]
        length = shift.norm(dim=-1, keepdim=True)
        shift = shift * (FARTHEST[self.how] / length.clamp_min(FARTHEST[self.how]))
        of_tokens = energy.unflatten(1, (-1, TOKEN_FRAMES)).sum(dim=-1)
        steep = by_latent.square().sum(dim=(2, 3)).clamp_min(1e-8)
        bend = -STEP[self.how] * (of_tokens / steep)[..., None, None] * by_latent
        length, most = bend.norm(dim=-1, keepdim=True), BENT * latent.norm(dim=-1, keepdim=True)
        return bend * (most / torch.maximum(length, most).clamp_min(1e-8)), shift


def smoothed(shift: Tensor) -> Tensor:
    """Averaged over `AVERAGED` frames before and after. (B, T, P, 2) -> same"""
    flat = F.pad(shift.flatten(2).transpose(1, 2), (AVERAGED, AVERAGED), mode="replicate")
    return F.avg_pool1d(flat, 2 * AVERAGED + 1, stride=1).transpose(1, 2).view(shift.shape)


def moved_along(
    deltas: Tensor, pairs: Tensor, T_world_can: Tensor, shift: Tensor, low: int, stop: int
) -> tuple[Tensor, Tensor]:
    """Deltas and pairwise transforms of people who are moved over the ground.

    Args:
        deltas, pairs: (B, W, P, 4, 9), (B, W, P, P - 1, 4, 9) of a window.
        T_world_can: (B, 4 n, P, 4, 4) of its rows [low, stop).
        shift: (B, 4 n, P, 2) metres in the world.
        low, stop: rows of the window.
    """
    yaw, _ = to_planar(T_world_can)
    grown = F.pad(shift, (0, 0, 0, 0, 1, 0)).diff(dim=1)
    before = torch.cat([yaw[:, :1], yaw[:, :-1]], dim=1)
    local = rotate_ground(-before, grown)
    deltas = deltas.clone()
    deltas[:, low:stop, ..., [6, 8]] += by_token(local)
    if not pairs.shape[3]:
        return deltas, pairs
    away = shift[:, :, partners(shift.shape[2], shift.device)] - shift[:, :, :, None]  # (B, T, P, P - 1, 2)
    local = rotate_ground(-yaw[..., None].expand(away.shape[:-1]), away)
    pairs = pairs.clone()
    pairs[:, low:stop, ..., [6, 8]] += pairwise_by_token(local)
    return deltas, pairs
