"""Ridge regression: the future as a linear function of everybody's last half second."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from magnet.baselines.windows import Windows, moved_points
from magnet.motion.frames import inverse
from magnet.motion.scene import Scene

BACK = (1, 3, 7, 15)
"""Frames before the last one that are read, in all 16 frames."""

OFFSET_SCALE = 3.0
"""Offsets from the last frame are this much larger than positions, so that one penalty suits both."""

PARTNERS = 3
"""So many partners are read, the nearest first, which bounds the size of the regression."""

PENALTIES = tuple(10.0**k for k in range(-5, 3))
"""Tried, as multiples of the features' mean variance."""

FOLDS = 5
EVERY = 10
"""The penalty is chosen at every tenth future frame and used for the frames around it."""

CHUNK = 64
"""Windows whose joints are held together, to bound memory."""


class RidgeFit(NamedTuple):
    """A linear function of features x (D,): offset + (x - mean) @ weights."""

    mean: Tensor  # (D,)
    offset: Tensor  # (E,)
    weights: Tensor  # (D, E)
    penalty: Tensor  # (T,) chosen for each future frame


class RidgeRegression:
    """Future joints of each person as a linear function of everybody's last 16 context frames, in closed form.

    Features and targets are in the person's own canonical frame at the last context frame, so the answer moves with the
    world. Each person of a training window is an example, with partners in the order of their distance, so slots make
    no difference. The target is the offset from the last pose; an infinite penalty predicts the mean offset. There is
    one regression for each number of people, fitted at first use. The penalty of each future frame is the one with the
    least error on training recordings left out of the fit, in five folds.

    Joints are independent of each other, so bones may change their length: this is a bar for position errors, not
    motion.

    Args:
        train: windows to fit, with at least one frame on either side of their context's end.
    """

    def __init__(self, train: Windows) -> None:
        if train.context < 1 or train.horizon < 1:
            raise ValueError(
                f"training windows have {train.context} frames of context and {train.horizon} after it; "
                "expected at least 1 each"
            )
        self.train = train
        self._fits: dict[int, RidgeFit] = {}

    def __call__(self, context: Scene, horizon: int) -> Tensor:
        """Joints in the context's world, 0 where nobody is. -> (B, horizon, P, 22, 3)

        Raises:
            ValueError: no training window has as many people, or the context does not fit the training windows.
        """
        train = self.train
        for field, got, expected in (
            ("fps", context.fps, train.fps),
            ("body", context.body, train.body.id),
            ("context frames", context.frames, train.context),
        ):
            if got != expected:
                raise ValueError(f"{field}: the context has {got}, training windows {expected}; they must agree")
        if horizon > train.horizon:
            raise ValueError(f"horizon: got {horizon} frames, training windows have {train.horizon}")
        joints = train.body.joints(context)
        answer = joints.new_zeros(context.scenes, horizon, *joints.shape[2:])
        people = context.present.sum(dim=1)
        for n in sorted(set(people.tolist()) - {0}):
            scenes = (people == n).nonzero()[:, 0]
            fit = self.fit(n)
            few = Windows.of([context.select(scenes).replace(valid=None)], train.body, train.context)
            examples = Examples.of(few, torch.arange(len(scenes), device=scenes.device), n)
            values = fit.offset + (examples.features - fit.mean) @ fit.weights
            seen = values.unflatten(-1, (train.horizon, -1, 3))[:, :horizon] + examples.last[:, None]
            slots = context.present[scenes].nonzero()[:, 1].view(-1, n)
            made = moved_points(examples.T_world_self, seen).unflatten(0, (len(scenes), n))
            answer[scenes[:, None], :, slots] = made.to(answer)
        return answer

    def fit(self, people: int) -> RidgeFit:
        """The regression for so many people.

        Raises:
            ValueError: no training window has that many.
        """
        if people not in self._fits:
            self._fits[people] = self._fitted(people)
        return self._fits[people]

    # -- fitting -------------------------------------------------------------------------------

    def _fitted(self, people: int) -> RidgeFit:
        windows, horizon = self.train.of_people(people), self.train.horizon
        if not len(windows):
            have = sorted(set(self.train.present.sum(dim=1).tolist()) - {0})
            raise ValueError(
                f"the context has {people} people, training windows have {have}; "
                "use data that has such groups too (composed scenes will do)"
            )
        folds = self.fold_numbers(windows)
        asked = torch.arange(min(EVERY // 2, horizon - 1), horizon, EVERY)
        parts = [self._sums(windows[folds == f], people, asked) for f in range(int(folds.max()) + 1)]
        best = torch.full((len(asked),), len(PENALTIES) - 1)
        if len(parts) > 1:
            total = Sums.added(parts)
            errors = [
                self._error(total.plus(part, -1), windows[folds == f], people, asked) for f, part in enumerate(parts)
            ]
            best = torch.stack(errors).sum(dim=0).argmin(dim=0).cpu()
        nearest = (torch.arange(horizon) // EVERY).clamp(max=len(asked) - 1)
        penalty = torch.tensor(PENALTIES, dtype=torch.float64)[best[nearest]].to(windows.device)
        everything = self._sums(windows, people, torch.arange(horizon))
        weights = everything.spectrum().weights(penalty.repeat_interleave(everything.xy.shape[1] // horizon))
        return RidgeFit(everything.mean_x, everything.mean_y, weights, penalty)

    def fold_numbers(self, windows: Tensor) -> Tensor:
        """Which fold each window is left out in: by recording, or runs of windows of the only one. (m,) int"""
        names = [self.train.recordings[k] for k in windows.tolist()]
        order = {name: number for number, name in enumerate(dict.fromkeys(names))}
        if len(order) > 1:
            return torch.tensor([order[name] % FOLDS for name in names], device=windows.device)
        return torch.arange(len(windows), device=windows.device) * min(FOLDS, len(windows)) // len(windows)

    def _examples(self, windows: Tensor, people: int, frames: Tensor) -> Iterator[tuple[Examples, Tensor]]:
        """Some windows at a time: features, and offsets from the last pose (m * n, F, 22, 3)."""
        at = self.train.context + frames.to(windows.device)
        for part in windows.split(CHUNK):
            examples = Examples.of(self.train, part, people)
            future = self.train.joints_of(part, people, at).flatten(0, 1).double()
            yield examples, moved_points(inverse(examples.T_world_self), future) - examples.last[:, None]

    def _sums(self, windows: Tensor, people: int, frames: Tensor) -> Sums:
        """Sums over windows, of some of the future frames."""
        found = self._examples(windows, people, frames)
        return Sums.added(Sums.of(examples.features, future.flatten(1)) for examples, future in found)

    def _error(self, sums: Sums, left_out: Tensor, people: int, frames: Tensor) -> Tensor:
        """Summed joint error of windows left out, by penalty and future frame. -> (penalties, F)"""
        spectrum = sums.spectrum()
        weights = [spectrum.own_weights(torch.tensor(penalty, dtype=torch.float64)) for penalty in PENALTIES]
        error = torch.zeros(len(weights), len(frames), dtype=torch.float64, device=left_out.device)
        for examples, truth in self._examples(left_out, people, frames):
            features = (examples.features - sums.mean_x) @ spectrum.vectors
            for k, weight in enumerate(weights):
                made = sums.mean_y + features @ weight
                error[k] += (made.view_as(truth) - truth).norm(dim=-1).sum(dim=(0, 2))
        return error


class Examples(NamedTuple):
    """What is read of m scenes of n people: one example for each person."""

    features: Tensor  # (m * n, D) float64
    last: Tensor  # (m * n, 22, 3) own joints at the last context frame, in one's own frame
    T_world_self: Tensor  # (m * n, 4, 4)

    @staticmethod
    def of(windows: Windows, chosen: Tensor, people: int) -> Examples:
        """Of chosen windows (m,) with so many people each."""
        now = windows.context - 1
        frames = torch.tensor([now, *(now - back for back in BACK if back <= now)], device=chosen.device)
        past = windows.joints_of(chosen, people, frames).double()  # (m, n, F, 22, 3)
        T_world_self = windows.frames_of(chosen, people).double()  # (m, n, 4, 4)
        ground = T_world_self[..., [0, 2], 3]
        away = (ground[:, :, None] - ground[:, None]).norm(dim=-1)  # (m, n, n)
        away.diagonal(dim1=1, dim2=2).fill_(-1.0)  # oneself first
        read = away.argsort(dim=-1, stable=True)[..., : PARTNERS + 1]  # (m, n, k)
        row = torch.arange(len(chosen), device=chosen.device)[:, None, None]
        T_self_world = inverse(T_world_self).flatten(0, 1)
        seen = moved_points(T_self_world, past[row, read].flatten(0, 1))  # (m * n, k, F, 22, 3)
        last = seen[:, :, :1]
        features = torch.cat([last, OFFSET_SCALE * (seen[:, :, 1:] - last)], dim=2)
        return Examples(features.flatten(1), last[:, 0, 0], T_world_self.flatten(0, 1))


class Sums(NamedTuple):
    """What a least-squares fit needs of features x and targets y; adds up over batches."""

    size: int  # how many examples
    x: Tensor  # (D,)
    y: Tensor  # (E,)
    xx: Tensor  # (D, D)
    xy: Tensor  # (D, E)

    @staticmethod
    def of(x: Tensor, y: Tensor) -> Sums:
        """x (m, D), y (m, E) float64"""
        return Sums(len(x), x.sum(dim=0), y.sum(dim=0), x.T @ x, x.T @ y)

    @staticmethod
    def added(parts: Iterable[Sums]) -> Sums:
        return functools.reduce(lambda a, b: a.plus(b, 1), parts)

    def plus(self, part: Sums, sign: int) -> Sums:
        """With a part added, or with sign -1 taken away."""
        return Sums(
            self.size + sign * part.size,
            self.x + sign * part.x,
            self.y + sign * part.y,
            self.xx + sign * part.xx,
            self.xy + sign * part.xy,
        )

    @property
    def mean_x(self) -> Tensor:
        return self.x / self.size

    @property
    def mean_y(self) -> Tensor:
        return self.y / self.size

    def spectrum(self) -> Spectrum:
        """The fit of the centred features, ready for any penalty."""
        xx = self.xx - self.size * torch.outer(self.mean_x, self.mean_x)
        xy = self.xy - self.size * torch.outer(self.mean_x, self.mean_y)
        values, vectors = torch.linalg.eigh(xx)
        return Spectrum(values.clamp_min(0), vectors, vectors.T @ xy, (xx.trace() / len(xx)).clamp_min(1e-12))


class Spectrum(NamedTuple):
    """A least-squares problem in the basis in which its features do not correlate."""

    values: Tensor  # (D,)
    vectors: Tensor  # (D, D)
    xy: Tensor  # (D, E)
    scale: Tensor  # () the features' mean variance, times their number

    def weights(self, penalty: Tensor) -> Tensor:
        """With a penalty for all targets or one for each, as a multiple of `scale`. () or (E,) -> (D, E)"""
        return self.vectors @ self.own_weights(penalty)

    def own_weights(self, penalty: Tensor) -> Tensor:
        """The same for features in this basis. () or (E,) -> (D, E)"""
        return self.xy / (self.values[:, None] + self.scale * penalty.to(self.values))
