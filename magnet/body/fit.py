"""Fitting a body to joint positions: one shape a person, one pose a frame.

A closed-form start, from known rotations or only from the directions between joints, is refined by a short optimisation
over all frames at once. Motion of other bodies and skeletons is converted this way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from magnet.body.base import Body

from magnet.body.joints import (  # isort: skip
    COLLARS, FEET, HIPS, JOINT_NAMES, L_HIP, L_SHOULDER, NECK, PARENTS, PELVIS, R_HIP, R_SHOULDER, SHOULDERS, SPINE,
    SPINE1, SPINE2, SPINE3,
)  # fmt: skip
from magnet.motion.frames import rigid
from magnet.motion.rotations import from_6d, to_6d
from magnet.motion.scene import BODY_JOINTS, FPS, Scene

CENTIMETRE = 0.01
JUMP = 0.15
"""Metres by which joints are, on average, off where they would be if they went on, at 30 frames a second; at fewer it
grows with the square of a frame's time. In CMU's 72 takes it is 0.10 at most, in a leap of 05_17."""
NEARLY_RIGID = (HIPS, SHOULDERS, (L_HIP, L_SHOULDER), (R_HIP, R_SHOULDER))
"""Distances that tell the shape although they change a little with the pose: hips, shoulders, flanks."""
TORSO = (PELVIS, *HIPS, SPINE1, SPINE2, SPINE3, NECK, *SHOULDERS)
UPPER, LOWER = (SPINE3, NECK, *COLLARS, *SHOULDERS), (PELVIS, *HIPS, SPINE1, SPINE2)
"""Joints that turn with the chest, and with the pelvis."""


@dataclass(frozen=True)
class BodyFit:
    """A fitted scene (B = 1) and how far its joints are from the targets."""

    scene: Scene
    residual: Tensor  # (T, P, M) metres


@dataclass(frozen=True)
class FitSettings:
    """Weights, relative to a squared error of 1 cm of one joint in one frame."""

    steps: int = 80
    shape_steps: int = 160
    shape_frames: int = 96  # evenly spaced frames that refine the shape
    learning_rate: float = 0.03
    hint: float = 6.0  # of the squared chordal distance to the start, of joints whose rotation is known
    rest: float = 0.5  # the same of the other joints
    smooth: float = 20.0  # of squared second differences of rotations, between frames that are 1/30 s apart
    shape: float = 2.0  # of a squared shape number, in the refinement of shapes
    floor: float = 2.0  # of a squared centimetre of a sole under the floor
    shape_prior: float = 0.5  # of a squared shape number, against a square centimetre of a length's error


# -- small rotations ---------------------------------------------------------------------------


def swing(a: Tensor, b: Tensor) -> Tensor:
    """Smallest rotation that takes direction a to direction b. (..., 3) x 2 -> (..., 3, 3)

    For opposite directions, some half turn is returned.
    """
    a, b = torch.nn.functional.normalize(a, dim=-1), torch.nn.functional.normalize(b, dim=-1)
    cross, cos = torch.linalg.cross(a, b, dim=-1), (a * b).sum(-1)[..., None, None]
    K = torch.zeros(*cross.shape, 3, dtype=cross.dtype, device=cross.device)
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -cross[..., 2], cross[..., 1], -cross[..., 0]
    K = K - K.transpose(-1, -2)
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    turned = eye + K + K @ K / (1 + cos).clamp_min(1e-6)
    side = torch.zeros_like(a)
    side.scatter_(-1, a.abs().argmin(dim=-1, keepdim=True), 1.0)
    axis = torch.nn.functional.normalize(torch.linalg.cross(a, side, dim=-1), dim=-1)
    half = 2 * axis[..., :, None] * axis[..., None, :] - eye
    return torch.where(cos > -1 + 1e-6, turned, half)


def kabsch(rest: Tensor, posed: Tensor) -> Tensor:
    """Rotation that best maps points to points, both centred. (..., N, 3) x 2 -> (..., 3, 3)"""
    rest = rest - rest.mean(dim=-2, keepdim=True)
    posed = posed - posed.mean(dim=-2, keepdim=True)
    U, _, Vh = torch.linalg.svd(posed.transpose(-1, -2) @ rest)
    flip = torch.ones_like(U[..., 0])
    flip[..., 2] = torch.linalg.det(U @ Vh).sign()
    return (U * flip[..., None, :]) @ Vh


# -- the fit -----------------------------------------------------------------------------------


@torch.inference_mode(False)
@torch.enable_grad()
def fit_body(
    targets: Tensor,
    joints: Sequence[int],
    body: Body,
    *,
    rotations: Tensor | None = None,
    weights: Tensor | None = None,
    valid: Tensor | None = None,
    betas: Tensor | None = None,
    grounded: bool = False,
    fps: float = FPS,
    refuse_above: float = 0.04,
    settings: FitSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BodyFit:
    """Poses and shapes of `body` whose joints lie at the targets; a descent, also where the caller wants no gradients.

    Args:
        targets: (T, P, M, 3) world positions of M of the 22 joints, metres, y up.
        joints: which M, both hips and both shoulders among them.
        rotations: (T, P, 22, 3, 3) known world rotations from the body's rest pose, NaN where unknown.
        weights: (M,) or (T, P, M) of the targets, 0: not known; None: equal.
        valid: (T, P) bool; other frames are filled in but do not count.
        betas: (P, 10) known shapes; None: fitted, one a person.
        grounded: find the height of one level floor and keep soles above it.
        fps: of the targets.
        refuse_above: largest mean error in metres, over targets that count, that is accepted.
        progress: called with (steps done, steps in all).

    Raises:
        ValueError: shapes do not match, joints are missing, no valid frame, NaN, or the fit is too bad.
    """
    settings = settings or FitSettings()
    valid = _checked(targets, joints, rotations, valid)
    T, P, M = targets.shape[:3]
    targets = targets.float().clone()  # no gradient may pass a tensor that was made in inference mode
    weights = torch.ones(M, device=targets.device) if weights is None else weights.to(targets)
    weights = weights.expand(T, P, M) * valid[..., None]
    hints = None if rotations is None else rotations.to(targets).clone()
    fit_shape = betas is None
    total = settings.steps + (settings.shape_steps if fit_shape or grounded else 0)
    tell = progress or (lambda done, total: None)
    if betas is None:
        betas = shape_from_lengths(targets, joints, body, weights > 0, settings.shape_prior)
    floor = soles = None
    if fit_shape or grounded:
        # Evenly spaced frames suffice for ten numbers and a height, and cost far less than all.
        good = valid.all(dim=1).nonzero()[:, 0] if valid.all(dim=1).any() else torch.arange(T)
        some = good[torch.linspace(0, len(good) - 1, min(settings.shape_frames, len(good))).long()]
        near = None if hints is None else hints[some]
        few = _Problem(body, targets[some], joints, weights[some], near, settings, (0.0, 1))
        R, t, betas = few.solve(betas, settings.shape_steps, fit_shape, lambda done: tell(done, total))
        if grounded:
            found = body.forward_kinematics(R[:, :, 1:], rigid(R[:, :, 0], t), betas)
            floor, soles = float(floor_height(found, body, betas).median()), clearance(body, betas)
    smooth = _smoothness(settings, fps)
    problem = _Problem(body, targets, joints, weights, hints, settings, smooth, floor, soles, _steady(targets, fps))
    R, t, betas = problem.solve(betas, settings.steps, False, lambda done: tell(total - settings.steps + done, total))
    scene = Scene(
        body_rot=R[None, :, :, 1:],
        T_world_root=rigid(R[:, :, 0], t)[None],
        betas=betas[None],
        present=torch.ones(1, P, dtype=torch.bool, device=targets.device),
        fps=fps,
        body=body.id,
        valid=valid.all(dim=1)[None],
    )
    residual = (body.joints(scene)[0][:, :, list(joints)] - targets).norm(dim=-1)
    _refuse_bad(residual, weights > 0, joints, refuse_above)
    return BodyFit(scene, residual)


def jumps_in(targets: Tensor, fps: float = FPS) -> Tensor:
    """Beside which frames somebody jumps to another place or pose, as after a rest pose in frame 0, or at a cut.

    targets (T, P, M, 3) m -> (T - 2, P) bool, of the frames 1 to T - 2: the step out of such a frame does not go on as
    the step into it. A marker that is lost for a frame is no jump: the mean of all joints counts.
    """
    return (targets[2:] - 2 * targets[1:-1] + targets[:-2]).norm(dim=-1).mean(dim=-1) > JUMP * max(FPS / fps, 1.0) ** 2


def _smoothness(settings: FitSettings, fps: float) -> tuple[float, int]:
    """The weight of second differences, and how many frames lie between those that they are taken of.

    Of neighbours at many frames a second it would be thousands, and the descent would not end in its steps.
    """
    apart = max(1, round(fps / FPS))
    return settings.smooth * (fps / apart / FPS) ** 4, apart


def _steady(targets: Tensor, fps: float) -> Tensor | None:
    """Frames (T - 2 apart, P) from which nobody jumps to those `apart` before and after, as `jumps_in`; None: all."""
    jumps, apart = jumps_in(targets, fps), max(1, round(fps / FPS))
    if not bool(jumps.any()) or len(targets) <= 2 * apart:
        return None
    return ~jumps.unfold(0, 2 * apart - 1, 1).any(dim=-1)


def _refuse_bad(residual: Tensor, counts: Tensor, joints: Sequence[int], refuse_above: float) -> None:
    mean = float(residual[counts].mean())
    if not mean <= refuse_above:
        worst = JOINT_NAMES[joints[int((residual * counts).sum(dim=(0, 1)).argmax())]]
        raise ValueError(
            f"the body fits with a mean error of {100 * mean:.1f} cm, expected at most {100 * refuse_above:.1f} cm; "
            f"worst is {worst}: check units (metres), the up axis (y) and which target is which joint"
        )


def _checked(targets: Tensor, joints: Sequence[int], rotations: Tensor | None, valid: Tensor | None) -> Tensor:
    if targets.dim() != 4 or targets.shape[2:] != (len(joints), 3):
        raise ValueError(f"targets: got {tuple(targets.shape)}, expected (T, P, {len(joints)}, 3) for these joints")
    T, P = targets.shape[:2]
    lacking = [JOINT_NAMES[j] for j in (*HIPS, *SHOULDERS) if j not in joints]
    if lacking:
        raise ValueError(f"targets lack {', '.join(lacking)}; both hips and both shoulders are needed")
    if rotations is not None and tuple(rotations.shape) != (T, P, BODY_JOINTS, 3, 3):
        raise ValueError(f"rotations: got {tuple(rotations.shape)}, expected {(T, P, BODY_JOINTS, 3, 3)}")
    if valid is None:
        valid = torch.ones(T, P, dtype=torch.bool, device=targets.device)
    if tuple(valid.shape) != (T, P) or not bool(valid.any(dim=0).all()):
        raise ValueError(f"valid: got {tuple(valid.shape)}, expected {(T, P)} with a valid frame for everybody")
    if not bool(targets.isfinite().all()):
        raise ValueError("targets hold NaN or infinity; fill such frames in and mask them with `valid`")
    return valid


def shape_from_lengths(targets: Tensor, joints: Sequence[int], body: Body, sure: Tensor, prior: float) -> Tensor:
    """Shapes with the bone lengths of the targets, medians over the frames that count.

    targets (T, P, M, 3), sure (T, P, M) bool -> (P, 10)
    """
    place = {joint: i for i, joint in enumerate(joints)}
    bones = [(PARENTS[j], j) for j in joints if PARENTS[j] in place]
    pairs = [*bones, *((a, b) for a, b in NEARLY_RIGID if a in place and b in place)]
    here, there = zip(*((place[a], place[b]) for a, b in pairs), strict=True)
    a, b = zip(*pairs, strict=True)
    lengths = (targets[:, :, list(here)] - targets[:, :, list(there)]).norm(dim=-1)
    lengths = torch.where(sure[:, :, list(here)] & sure[:, :, list(there)], lengths, torch.nan)
    shapes = []
    for p in range(targets.shape[1]):
        want = lengths[:, p].double().nanmedian(dim=0).values
        there_is = want.isfinite()

        def measure(beta: Tensor) -> Tensor:
            rest = body.rest_joints(beta)
            return (rest[list(a)] - rest[list(b)]).norm(dim=-1)[there_is]  # noqa: B023

        beta = torch.zeros(10, dtype=torch.float64, device=targets.device)
        for _ in range(8):  # Gauss-Newton: lengths are all but linear in the shape
            J = torch.func.jacfwd(measure)(beta) / CENTIMETRE
            off = (want[there_is] - measure(beta)) / CENTIMETRE
            eye = torch.eye(10, dtype=beta.dtype, device=beta.device)
            beta = torch.linalg.solve(J.T @ J + prior * eye, J.T @ (off + J @ beta))
        shapes.append(beta.float())
    return torch.stack(shapes)


def clearance(body: Body, betas: Tensor) -> Tensor:
    """Height of the feet's joints above the sole of a body at rest. (P, 10) -> (P, 4) metres

    Ankles count at most as high as the balls of the feet: a kneeling person's are lower than at rest.
    """
    low = body.v_template[:, 1] < body.v_template[:, 1].min() + 0.15
    soles = body.v_template[low, 1] + betas @ body.shapedirs[low, 1].T  # (P, V)
    above = body.rest_joints(betas)[:, list(FEET), 1] - soles.amin(dim=-1, keepdim=True)
    return torch.minimum(above, above[:, [2, 3, 2, 3]])


def floor_height(found: Tensor, body: Body, betas: Tensor) -> Tensor:
    """Height of the lowest sole of each person and frame. found (T, P, 22, 3), betas (P, 10) -> (T, P) metres"""
    return (found[:, :, list(FEET), 1] - clearance(body, betas)).amin(dim=-1)


@dataclass(frozen=True)
class _Problem:
    """What the optimisation needs, of T frames of P people and M joints."""

    body: Body
    targets: Tensor  # (T, P, M, 3)
    joints: Sequence[int]
    weights: Tensor  # (T, P, M)
    hints: Tensor | None  # (T, P, 22, 3, 3)
    settings: FitSettings
    smooth: tuple[float, int]  # as `_smoothness`
    floor: float | None = None  # height in metres, for shapes that are known
    soles: Tensor | None = None  # their `clearance`
    steady: Tensor | None = None  # (T - 2 apart, P) bool, frames that are to be smooth; None: all

    def solve(
        self, betas: Tensor, steps: int, shape: bool, tell: Callable[[int], None]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Local rotations (T, P, 22, 3, 3), the pelvis's in the world, pelvis positions (T, P, 3), shapes (P, 10)."""
        R, t, known = start(self.targets, self.joints, self.body.rest_joints(betas), self.hints, self.weights > 0)
        trust = torch.where(known, self.settings.hint, self.settings.rest)
        prior = R
        six = to_6d(R).clone().requires_grad_()
        t = t.clone().requires_grad_()
        betas = betas.clone().requires_grad_(shape)
        rate = self.settings.learning_rate
        groups: list[dict[str, Any]] = [{"params": [six], "lr": rate}, {"params": [t], "lr": rate / 3}]
        if shape:
            groups.append({"params": [betas], "lr": 2 * rate})
        optimiser = torch.optim.Adam(groups, betas=(0.9, 0.98))
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, [g["lr"] for g in groups], total_steps=steps, pct_start=0.1, div_factor=5
        )
        for step in range(steps):
            optimiser.zero_grad()
            loss = self._loss(from_6d(six), t, betas, prior, trust)
            loss.backward()
            optimiser.step()
            schedule.step()
            tell(step + 1)
        return from_6d(six.detach()), t.detach(), betas.detach()

    def _loss(self, R: Tensor, t: Tensor, betas: Tensor, prior: Tensor, trust: Tensor) -> Tensor:
        found = self.body.forward_kinematics(R[:, :, 1:], rigid(R[:, :, 0], t), betas)
        off = (found[:, :, list(self.joints)] - self.targets) / CENTIMETRE
        loss = (self.weights * off.square().sum(-1)).sum()
        loss = loss + (trust * (R - prior).square().sum((-1, -2))).sum()
        loss = loss + self.settings.shape * len(self.targets) * betas.square().sum()
        if self.floor is not None and self.soles is not None:
            height = found[:, :, list(FEET), 1] - self.floor
            deep = (self.soles - height).clamp_min(0.0) / CENTIMETRE
            loss = loss + self.settings.floor * deep.square().sum()
        smooth, s = self.smooth
        if smooth and len(R) > 2 * s:
            turn = R[2 * s :] - 2 * R[s:-s] + R[: -2 * s]
            bend = (t[2 * s :] - 2 * t[s:-s] + t[: -2 * s]) / CENTIMETRE
            if self.steady is not None:
                turn, bend = turn[self.steady], bend[self.steady]
            loss = loss + smooth * turn.square().sum()
            loss = loss + smooth / 20 * bend.square().sum()
        return loss


def start(
    targets: Tensor, joints: Sequence[int], rest: Tensor, hints: Tensor | None, sure: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Closed-form local rotations (T, P, 22, 3, 3), pelvis positions (T, P, 3), known rotations (T, P, 22) bool.

    targets (T, P, M, 3), rest (P, 22, 3), hints (T, P, 22, 3, 3) or None, sure (T, P, M) bool: the target counts
    """
    T, P = targets.shape[:2]
    place = {joint: i for i, joint in enumerate(joints)}

    def rigid_part(of: Sequence[int]) -> Tensor | None:
        there = [j for j in of if j in place]
        if len(there) < 3:
            return None
        return kabsch(rest[:, there].expand(T, P, len(there), 3), targets[:, :, [place[j] for j in there]])

    torso = rigid_part(TORSO)
    pelvis, chest = rigid_part(LOWER), rigid_part(UPPER)
    if torso is None:
        raise ValueError("the torso's targets do not say how it is turned")
    pelvis = torso if pelvis is None else pelvis
    chest = torso if chest is None else chest
    world = torch.empty(T, P, BODY_JOINTS, 3, 3, dtype=targets.dtype, device=targets.device)
    known = torch.zeros(T, P, BODY_JOINTS, dtype=torch.bool, device=targets.device)
    if hints is not None:
        known = hints.isfinite().all(dim=-1).all(dim=-1)
    for j in range(BODY_JOINTS):
        guess = {
            PELVIS: pelvis,
            SPINE1: _between(pelvis, chest, 1 / 3),
            SPINE2: _between(pelvis, chest, 2 / 3),
            SPINE3: chest,
        }.get(j)
        guess = world[:, :, PARENTS[j]] if guess is None else guess
        world[:, :, j] = guess if hints is None else torch.where(known[:, :, j, None, None], hints[:, :, j], guess)
        child = [c for c in range(BODY_JOINTS) if PARENTS[c] == j]
        if j not in SPINE and len(child) == 1 and child[0] in place and j in place:
            bone = (world[:, :, j] @ (rest[:, child[0]] - rest[:, j])[..., None])[..., 0]
            want = targets[:, :, place[child[0]]] - targets[:, :, place[j]]
            swings = sure[:, :, place[j]] & sure[:, :, place[child[0]]]
            if j in HIPS:  # hips lie elsewhere in other bodies, so a known thigh tells more than the way to the knee
                swings = swings & ~known[:, :, j]
            swung = swing(bone, want) @ world[:, :, j]
            world[:, :, j] = torch.where(swings[..., None, None], swung, world[:, :, j])
    local = world.clone()
    local[:, :, 1:] = world[:, :, list(PARENTS[1:])].transpose(-1, -2) @ world[:, :, 1:]
    hips = [place[j] for j in HIPS]
    t = (targets[:, :, hips] - (world[:, :, :1] @ (rest[:, list(HIPS)] - rest[:, :1])[..., None])[..., 0]).mean(dim=2)
    return local, t, known


def _between(a: Tensor, b: Tensor, share: float) -> Tensor:
    """A rotation between a and b, which must not be opposite. (..., 3, 3) x 2 -> (..., 3, 3)"""
    return from_6d(to_6d(a) * (1 - share) + to_6d(b) * share)
