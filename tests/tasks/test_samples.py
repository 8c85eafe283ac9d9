"""The tasks sample what they claim: exactly, for models whose answer is known in closed form.

The Gaussian model: the numbers of all tokens are jointly Gaussian over (time, agent) with a known covariance, in
the first number of a token; the others play no part. Its best denoiser is affine, and so is then the whole sampler
(DDIM, eta 0): the sample is `mean + M noise` with noise ~ N(0, 1), hence its distribution N(mean, M M^T) is read
off by sampling with noise 0 and with each noise set to 1 alone. No statistics are involved; what remains is the
error of taking finitely many denoising steps, about 2 / steps of a variance. Being proportional to 1 / steps it
cancels between two runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import alpha_bar
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import AHEAD, Grid, MaskSchedule, Stage
from magnet.sampling.solvers import Solver
from magnet.tasks import Task, registry
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.joint import Generation, JointFuture
from magnet.tasks.partner import MotionControl, PartnerInpainting, PartnerPrediction
from tests.cases import few, some_slow

NEEDS_NOTHING = ("generation",)

# -- (a) an oracle gives the truth back --------------------------------------------------------


@pytest.mark.parametrize("people", few([2, 3, 4], 1))
@pytest.mark.parametrize("name", registry.names())
def test_with_an_oracle_every_task_reconstructs_the_scene(name: str, people: int, generator):
    """The oracle returns the true clean tokens of the window that it is shown."""
    grid = Grid(20, people, 0 if name in NEEDS_NOTHING else 4, steps=4, window=8, stride=3)
    schedule = registry.get(name)().schedule(grid)
    layout = TokenLayout(latent=3, agents=people)
    truth = torch.randn(2, grid.tokens, people, layout.width, generator=generator)
    position = iter([stage for stage in schedule.stages for _ in range(len(stage.levels) - 1)])

    def oracle(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        stage = next(position)
        views = len(noisy) // len(truth)
        return truth[:, stage.start : stage.stop].repeat_interleave(views, dim=0)

    def on_stage_end(tokens: Tensor, finished: Tensor, decentralized: bool) -> Tensor:
        """Relations between agents that did not see each other come from where they then stand, as in `WorldState`."""
        done = torch.zeros_like(tokens, dtype=torch.bool)
        done[:, finished] = True
        done[..., : layout.latent + 36] = False
        return torch.where(done, truth, tokens)

    decentralized = name == "agentic_sync"  # there nobody has seen what the others were about to do
    shown = torch.where(schedule.known[..., None], truth, torch.nan)
    present = torch.ones(2, people, dtype=torch.bool)
    out = sample(oracle, schedule, shown, present, layout, generator, on_stage_end if decentralized else None)
    assert next(position, None) is None
    # Relations to somebody who is never generated stay unknown.
    groups = layout.spread(layout.group_levels(schedule.final_levels()) == 0)
    assert groups[..., : layout.latent + 36].all(dim=-1).equal(schedule.finished)
    assert torch.equal(out[:, groups], truth[:, groups])


def active(stage: Stage) -> Tensor:
    """What a stage generates. -> (W, P) bool"""
    return (stage.levels[0] > 0) & (stage.levels[-1] == 0)


# -- (b) a Gaussian model ----------------------------------------------------------------------

PAST = 2
TOKENS = {1: 5, 2: 5, 3: 5, 4: 4}  # by the number of agents
STEPS = (50, 100)  # the covariance at infinitely many steps is extrapolated from these
TOLERANCE = 0.002  # variances are about 1
ANCESTRAL_TOLERANCE = 0.02  # with new noise in each step the error falls more slowly with the steps


class Gaussian:
    """Jointly Gaussian tokens over (time, agent), flattened time first, and the best denoiser for them."""

    def __init__(self, tokens: int, agents: int) -> None:
        generator = torch.Generator().manual_seed(agents)
        size = tokens * agents
        time = torch.arange(tokens).repeat_interleave(agents).double()
        agent = torch.arange(agents).repeat(tokens)
        near = (-(time[:, None] - time).abs() / 2).exp()
        same = torch.where(agent[:, None] == agent, 1.0, 0.7)
        odd = 0.15 * torch.randn(size, size, generator=generator, dtype=torch.float64)
        self.covariance = near * same + odd @ odd.T
        self.mean = torch.randn(size, generator=generator, dtype=torch.float64)
        self.shape = (tokens, agents)

    def denoise(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        """E[x | sqrt(a) x + sqrt(1 - a) noise], each token at a level of its own.

        A window may end early: what comes after it is integrated out.
        """
        clean = torch.zeros_like(noisy)
        flat = levels.flatten(1)
        mean, covariance = (x[..., : flat.shape[1]] for x in (self.mean, self.covariance[: flat.shape[1]]))
        for row in flat.unique(dim=0):
            alpha = alpha_bar(row).double()
            scaled = covariance * alpha.sqrt()  # covariance of x with sqrt(a) x
            gain = scaled @ torch.linalg.inv(alpha.sqrt()[:, None] * scaled + torch.diag(1 - alpha))
            who = (flat == row).all(dim=1)
            off = noisy[who][..., 0].flatten(1) - alpha.sqrt() * mean
            clean[who, ..., 0] = (mean + off @ gain.T).unflatten(1, (-1, self.shape[1]))
        return clean

    def given(self, target: Tensor, known: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and covariance of `target` given the values at `known` (indices): the textbook formula."""
        gain = self.covariance[target][:, known] @ torch.linalg.inv(self.covariance[known][:, known])
        mean = self.mean[target] + gain @ (values[known] - self.mean[known])
        return mean, self.covariance[target][:, target] - gain @ self.covariance[known][:, target]

    def turn_by_turn(
        self, turns: list[list[int]], sees: Callable[[int], list[int]], known: list[int], values: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean and covariance when the indices of a turn are drawn independently, each given what it sees.

        sees(index) are indices that are known or of earlier turns. -> over all indices drawn, in order
        """
        size = len(self.mean)
        mean, spread = values.clone(), torch.zeros(size, size, dtype=torch.float64)  # x = mean + spread @ N(0, 1)
        drawn: list[int] = []
        for turn in turns:
            for index in turn:
                seen = torch.tensor(sees(index))
                assert set(seen.tolist()) <= {*known, *drawn}
                gain = self.covariance[index, seen] @ torch.linalg.inv(self.covariance[seen][:, seen])
                mean[index] = self.mean[index] + gain @ (mean[seen] - self.mean[seen])
                spread[index] = gain @ spread[seen]
                spread[index, index] = (self.covariance[index, index] - gain @ self.covariance[seen, index]).sqrt()
            drawn += turn
        where = torch.tensor(sorted(drawn))
        return mean[where], (spread @ spread.T)[where][:, where]


class Given:
    """Noise and mask_noise of one's own choice, and new noise that is one number at a time."""

    def __init__(self, noise: Tensor, mask_noise: Tensor, eta: float = 0.0, levels: Sequence[int] = ()) -> None:
        self.noise, self.mask_noise, self.eta, self.levels = noise, mask_noise, eta, levels

    @property
    def plain(self) -> int:
        """How many draws come before those that hold a number of new noise each."""
        return len(self.noise) - len(self.levels) * self.noise[0, :, :, 0].numel()

    def drawn(self, first: int, rows: int, draws: Sequence[tuple[int, int, Tensor | None]]) -> Tensor:
        """Draw `plain` + (level number, token, agent): 1 there, 0 everywhere else.

        draws: (row, level, which numbers of its agents)
        """
        N, P = self.noise.shape[1:3]
        step_noise = torch.zeros_like(self.noise[:, first : first + rows])
        for row, level, where in draws:
            for agent in range(P):
                if where is None or bool(where[agent, 0]):
                    number = self.levels.index(level)
                    step_noise[self.plain + (number * N + first + row) * P + agent, row, agent] = 1.0
        return step_noise

    def draw(self, count: int) -> tuple[Tensor, Tensor]:
        assert count == self.noise.shape[1]
        return self.noise, self.mask_noise


def distribution(
    gaussian: Gaussian, schedule: MaskSchedule, values: Tensor, eta: float = 0.0, solver: Solver = "ddim"
) -> tuple[Tensor, Tensor]:
    """Exact mean and covariance of the generated tokens, over their flat indices in order."""
    N, P = gaussian.shape
    layout = TokenLayout(latent=1, agents=P, pairwise=False)
    size = N * P
    levels = sorted({int(x) for stage in schedule.stages for x in stage.levels[:-1].unique()} - {0}) if eta else []
    # Row 0 without noise; then each token's own noise alone; then its mask noise alone; then each step noise alone.
    draws = [torch.zeros(1 + (2 + len(levels)) * size, size, dtype=torch.float64) for _ in range(2)]
    draws[0][1 : 1 + size] = torch.eye(size)
    draws[1][1 + size : 1 + 2 * size] = torch.eye(size)
    noise = Given(*(draw.view(-1, N, P, 1).expand(-1, -1, -1, layout.width) for draw in draws), eta, levels)
    tokens = torch.where(schedule.known, values.view(N, P), torch.nan)[None, ..., None]
    tokens = tokens.expand(len(draws[0]), -1, -1, layout.width).clone()
    present = torch.ones(len(tokens), P, dtype=torch.bool)
    out = sample(gaussian.denoise, schedule, tokens, present, layout, noise=noise, solver=solver)
    generated = (schedule.finished & ~schedule.known).flatten()
    flat = out[..., 0].flatten(1)[:, generated]
    response = flat[1:] - flat[0]
    assert (response[size : 2 * size].abs() < 1e-9).all(), "what hides a token tells nothing"
    return flat[0], response.T @ response


def check(
    task: Task,
    people: int,
    expected=None,
    context: int = PAST,
    share: int = 0,
    eta: float = 0.0,
    shift: float = 1.0,
    solver: Solver = "ddim",
) -> None:
    """Compare with `expected(gaussian, values)`; by default with generated given known."""
    tokens = TOKENS[people]
    gaussian = Gaussian(tokens, people)
    values = gaussian.mean + torch.randn(
        tokens * people, generator=torch.Generator().manual_seed(9), dtype=torch.float64
    )
    found = []
    for steps in STEPS:
        pyramid_offset = steps // share if share else 0
        # Windows of blocks keep room for what lies ahead: everything is to stay in sight all the same.
        window = tokens if pyramid_offset else tokens + AHEAD
        plan = {"pyramid_offset": pyramid_offset, "shift": shift, "spacing": "even"}
        grid = Grid(tokens, people, context, steps, window=window, stride=1, **plan)
        schedule = task.schedule(grid)
        found.append(distribution(gaussian, schedule, values, eta, solver))
    (mean, coarse), (_, fine) = found
    covariance = 2 * fine - coarse if solver == "ddim" else fine
    if expected is None:
        known = schedule.known.flatten().nonzero()[:, 0]
        target = (schedule.finished & ~schedule.known).flatten().nonzero()[:, 0]
        right = gaussian.given(target, known, values)
    else:
        right = expected(gaussian, values)
    errors = (mean - right[0]).abs().max(), (covariance - right[1]).abs().max()
    print(f"{type(task).__name__} P={people}: mean off by {errors[0]:.4f}, covariance by {errors[1]:.4f}")
    assert max(errors) < (ANCESTRAL_TOLERANCE if eta else TOLERANCE)


@pytest.mark.parametrize("people", few([2, 3, 4]))
def test_joint_future_samples_all_futures_given_all_pasts(people):
    check(JointFuture(), people)


@pytest.mark.parametrize("people", few([1, 2, 3], 1))
def test_rolling_samples_the_same_futures(people):
    """Levels that differ along time are still a diffusion of the whole, so its flow is exact."""
    check(JointFuture(), people, share=2)


@pytest.mark.parametrize(("eta", "shift"), few([(0.0, 3.0), (0.5, 1.0), (1.0, 1.0), (1.0, 2.0)]))
def test_new_noise_and_levels_nearer_to_noise_sample_the_same_futures(eta, shift):
    check(JointFuture(), 2, eta=eta, shift=shift)


@pytest.mark.slow
def test_new_noise_samples_the_same_futures_when_rolling_and_in_turns():
    check(JointFuture(), 2, share=2, eta=1.0)
    check(AgenticAsync(), 2, eta=1.0)


@pytest.mark.parametrize("people", few([1, 2, 3], 1))
def test_a_pyramid_inside_the_window_samples_the_same_futures(people):
    """Ten tokens would be half denoised at a time, of which the window holds five."""
    check(JointFuture(), people, share=10)


@pytest.mark.parametrize(
    "task",
    few([JointFuture(), PartnerInpainting((0,)), PartnerPrediction((0,))], 1),
    ids=lambda task: type(task).__name__,
)
def test_levels_of_ones_own_sample_the_same_distributions_in_the_end(task):
    """Paper A.6.2: whichever way noise is taken away, a perfect model ends at the truth as the steps become finer."""
    gaussian = Gaussian(TOKENS[2], 2)
    values = gaussian.mean + torch.randn(10, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    off = []
    for steps in (50, 500):
        plan = {"pyramid_offset": 0, "noise_sampling": "independent", "spacing": "even"}
        grid = Grid(TOKENS[2], 2, PAST, steps, window=5, stride=1, **plan)
        schedule = task.schedule(grid)
        mean, covariance = distribution(gaussian, schedule, values)
        known, target = (m.flatten().nonzero()[:, 0] for m in (schedule.known, schedule.finished & ~schedule.known))
        right = gaussian.given(target, known, values)
        off.append(float(max((mean - right[0]).abs().max(), (covariance - right[1]).abs().max())))
    assert off[1] < 0.02 < off[0]


@pytest.mark.parametrize(("people", "target"), few([(2, (0,)), (3, (1,)), (4, (0, 3))], 1))
def test_inpainting_with_the_targets_own_past_is_given_that_as_well(people, target):
    check(PartnerInpainting(target, own_past=True), people)


def test_rolling_prediction_still_integrates_the_partner_out():
    check(PartnerPrediction((0,)), 2, share=2)


@pytest.mark.parametrize("people", few([1, 2, 3, 4]))
def test_generation_samples_the_joint_distribution_of_everything(people):
    check(Generation(), people, context=0)


@pytest.mark.parametrize(("people", "target"), few([(2, (0,)), (3, (1,)), (4, (0, 3))], 1))
def test_inpainting_samples_the_targets_given_the_others_whole_motion(people, target):
    check(PartnerInpainting(target), people)


@pytest.mark.parametrize(("people", "target"), few([(2, (0,)), (3, (1,)), (4, (0, 3))], 1))
def test_prediction_samples_the_targets_future_given_all_pasts_whatever_the_others_will_do(people, target):
    """P(A_t:t+L | A_0:t-1, B_0:t-1): B's future is integrated out."""
    check(PartnerPrediction(target), people)


@pytest.mark.parametrize("people", few([1, 2, 3, 4]))
@pytest.mark.parametrize("task", [Inbetweening(keys=(-1,)), Inbetweening(keys=(3,), agents=(0,))], ids=["all", "one"])
def test_inbetweening_samples_the_gaps_given_past_and_keyframes(task, people):
    check(task, people)


@pytest.mark.parametrize(("people", "target"), few([(2, (0,)), (3, (1,)), (4, (0, 3))]))
def test_motion_control_samples_each_next_token_given_the_others_up_to_then(people, target):
    """prod_t P(A_t | A_0:t-1, B_0:t). Several targets are drawn jointly at each time step."""

    def expected(gaussian: Gaussian, values: Tensor) -> tuple[Tensor, Tensor]:
        # Drawing the targets of a step one after the other is the chain rule of drawing them jointly.
        turns = [[t * people + p] for t in range(PAST, TOKENS[people]) for p in target]
        known = [i for i in range(TOKENS[people] * people) if [i] not in turns]

        def sees(index: int) -> list[int]:
            t = index // people
            others = [t * people + p for p in range(people) if p not in target]
            return sorted({*range(t * people), *others, *(t * people + p for p in target if t * people + p < index)})

        return gaussian.turn_by_turn(turns, sees, known, values)

    check(MotionControl(target), people, expected)


@pytest.mark.parametrize("people", few([1, 2, 3, 4]))
def test_agents_in_step_are_independent_given_the_past(people):
    """prod_t prod_agents P(A_t | everybody's 0:t-1)."""

    def expected(gaussian: Gaussian, values: Tensor) -> tuple[Tensor, Tensor]:
        turns = [[t * people + p for p in range(people)] for t in range(PAST, TOKENS[people])]

        def sees(index: int) -> list[int]:
            return list(range(index // people * people))

        return gaussian.turn_by_turn(turns, sees, list(range(PAST * people)), values)

    check(AgenticSync(), people, expected)


@pytest.mark.parametrize("block", few([1, 2], 1))
@pytest.mark.parametrize("offset", few([0.0, 0.2, 0.5, 1.0]))
@pytest.mark.parametrize(("people", "order"), some_slow([(1, ()), (2, ()), (2, (1, 0)), (3, (2, 0, 1))], (2, ())))
def test_turn_taking_is_the_chain_rule_of_the_joint_future_at_every_offset(people, order, offset, block):
    """prod_t P(A_t | pasts) P(B_t | pasts, A_t) ... = P(all futures | all pasts), in any order of turns."""
    check(AgenticAsync(offset, order, block), people)


@pytest.mark.parametrize("offset", few([0.0, 0.5, 1.0], 1))
def test_turns_and_joint_futures_are_the_same_to_a_solver_of_second_order(offset):
    """A hundred even steps, and nothing is extrapolated."""
    for people, order in ((2, (1, 0)), (3, (2, 0, 1))):
        check(AgenticAsync(offset, order), people, solver="dpmpp_2m")
    check(JointFuture(), 2, share=2, solver="dpmpp_2m")


def test_agents_in_step_do_not_sample_the_joint_future():
    """The difference between the two is larger than the tolerance: the laws above can tell them apart."""
    with pytest.raises(AssertionError):
        check(AgenticSync(), 2)
