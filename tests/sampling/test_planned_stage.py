"""A planned stage gives what the plain loop gives, bit for bit, and makes nothing anew in its steps."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from magnet.motion.tokens import TokenLayout
from magnet.sampling import planned_stage
from magnet.sampling.grid import Grid
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import NoiseStream, half_log_snr
from magnet.sampling.sampler import begin
from magnet.sampling.schedule import MaskSchedule, Stage
from magnet.sampling.solvers import History
from magnet.tasks import registry
from tests.cases import few
from tests.counting import Counting
from tests.sampling.plain import run_stage

P, N, B = 3, 20, 2
LAYOUT = TokenLayout(6, P)


def predict(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
    """A network that mixes everything that it is shown."""
    seen = noisy * present[:, None, :, None] + 1e-3 * levels[..., None]
    return (seen + 0.3 * seen.mean(dim=(1, 2), keepdim=True)).sin()


def schedule(task: str, **fields: Any) -> MaskSchedule:
    grid = Grid(N, P, 0 if task == "generation" else 4, steps=4, window=8)
    return registry.get(task)(**fields).schedule(grid)


def sampled(plan: MaskSchedule, plain: bool, guidance: Guidance, eta: float, steps_back: bool) -> tuple[Tensor, Any]:
    generator = torch.Generator().manual_seed(3)
    stream = NoiseStream((B, P, LAYOUT.width), generator, eta=eta)
    noise, mask_noise = stream.draw(N)
    truth = torch.randn(B, N, P, LAYOUT.width, generator=generator)
    tokens = begin(truth, noise, plan.known, LAYOUT)
    history = History.empty(tokens) if steps_back else None
    present = torch.ones(B, P, dtype=torch.bool)
    run = run_stage if plain else planned_stage.run_planned_stage
    how = planned_stage.Denoising(predict, present, LAYOUT, guidance, stream)
    for stage in plan.stages:
        window = slice(stage.start, stage.stop)
        kept = None if history is None else history.window(window)
        tokens[:, window] = run(how, stage, tokens[:, window], mask_noise[:, window], stage.start, kept)
    return tokens, history


@pytest.mark.parametrize("task", few([*registry.names(), "half a turn"], 3))
@pytest.mark.parametrize("way", ["plain", "new noise", "guided", "smoothed", "history"])
@torch.no_grad()
def test_every_task_is_sampled_as_by_the_plain_loop(task: str, way: str) -> None:
    plan = schedule("agentic_async", offset=0.5) if task == "half a turn" else schedule(task)
    guidance = {"guided": Guidance("self"), "smoothed": Guidance(smooth=0.05)}.get(way, Guidance())
    how = guidance, float(way != "plain"), way == "history"
    (plain, before), (planned, now) = sampled(plan, True, *how), sampled(plan, False, *how)
    assert torch.equal(plain, planned)
    if before is not None:
        assert torch.equal(before.levels, now.levels)
        seen = before.levels >= 0
        assert torch.equal(before.clean[:, seen], now.clean[:, seen])


def test_a_stage_like_an_earlier_one_is_not_planned_again() -> None:
    one, other = schedule("motion_control").stages[-2:]
    assert one.start < other.start
    plans = [planned_stage.plan_of(stage, LAYOUT, 1.0, None, torch.device("cpu")) for stage in (one, other)]
    assert plans[0] is plans[1]


@pytest.mark.parametrize("task", ["joint_future", "motion_control", "agentic_sync"])
@torch.no_grad()
def test_steps_wait_for_nothing_and_are_few_operators(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = schedule(task)
    sampled(plan, False, Guidance(), 1.0, True)  # everything is planned

    def counted(stage: Stage) -> Counting:
        tokens, mode = torch.zeros(B, *stage.levels.shape[1:], LAYOUT.width), Counting()
        present, calls = torch.ones(B, P, dtype=torch.bool), []

        def denoise(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
            if not calls:  # what was planned before the first step was planned on the host
                mode.operators, mode.waits = 0, []
            calls.append(1)
            return noisy

        stream = NoiseStream((B, P, LAYOUT.width), torch.Generator(), eta=1.0)
        monkeypatch.setattr(torch, "Generator", None)  # none is made
        how, history = planned_stage.Denoising(denoise, present, LAYOUT, noise=stream), History.empty(tokens)
        with mode:
            planned_stage.run_planned_stage(how, stage, tokens, tokens, history=history)
        monkeypatch.undo()
        return mode

    stage = plan.stages[-1]
    mode, steps = counted(stage), len(stage.levels) - 1
    assert not mode.waits
    draws = sum(len(row) for row in planned_stage.plan_of(stage, LAYOUT, 1.0, None, torch.device("cpu")).draws)
    assert mode.operators < 10 + 45 * steps + 8 * draws, (mode.operators, steps, draws)


# -- what views are shown, and what is read from them ------------------------------------------


@torch.no_grad()
def test_what_is_hidden_is_shown_as_noise_of_its_own_at_the_highest_level_and_what_is_asked_stays() -> None:
    levels = torch.tensor([700, 0])[:, None, None].expand(-1, 3, P).clone()
    visibility = torch.ones(P, 3, P, dtype=torch.bool)
    visibility[1, 2, 0] = visibility[2, :, 1] = False
    asked: list[tuple[Tensor, Tensor]] = []

    def spy(noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        asked.append((noisy.unflatten(0, (B, -1)), levels.unflatten(0, (B, -1))))
        return torch.zeros_like(noisy)

    generator = torch.Generator().manual_seed(0)
    tokens, mask_noise = (torch.randn(B, 3, P, LAYOUT.width, generator=generator) for _ in range(2))
    kept = tokens.clone()
    how = planned_stage.Denoising(spy, torch.ones(B, P, dtype=torch.bool), LAYOUT)
    planned_stage.run_planned_stage(how, Stage(0, levels.short(), visibility), tokens, mask_noise)
    assert torch.equal(tokens, kept)
    ((noisy, told),) = asked
    assert noisy.shape[1] == P, "each agent sees something else"
    for agent in range(P):
        (view,) = [v for v in range(P) if torch.equal(told[0, v] == 1000, ~visibility[agent])]
        hidden = LAYOUT.spread(LAYOUT.group_levels(torch.where(visibility[agent], 0, 1000)) == 1000)
        assert torch.equal(noisy[:, view], torch.where(hidden, mask_noise, tokens))
        assert (told[:, view][:, visibility[agent]] == 700).all()


def test_a_pair_is_read_from_the_view_of_who_is_not_seen_where_only_one_sees_the_other() -> None:
    hidden = torch.zeros(P, 1, P, dtype=torch.bool)
    hidden[1, 0, 0] = True  # 1 does not see 0, who sees it
    hidden[1, 0, 2] = hidden[2, 0, 1] = True  # neither sees the other
    source = planned_stage.views_to_read(hidden, torch.tensor([5, 6, 7]), LAYOUT)[0]
    partner = LAYOUT.partners(hidden.device)
    read = {(p, int(partner[p, k])): int(source[p, 1 + k]) for p in range(P) for k in range(P - 1)}
    assert source[:, 0].tolist() == [5, 6, 7]
    assert read == {(0, 1): 5, (0, 2): 5, (1, 0): 5, (1, 2): 6, (2, 0): 7, (2, 1): 7}


def test_a_prediction_is_extrapolated_by_half_a_step_and_no_farther_than_it_has_changed() -> None:
    """In log-SNR: the step over twice the one before; not at first, nor at level 0."""
    now, after, past = torch.tensor([[600, 300, 300, 1000, 600], [300, 200, 0, 900, 500], [700, 301, 600, -1, 1000]])
    length, since = half_log_snr(after) - half_log_snr(now), half_log_snr(now) - half_log_snr(past.clamp_min(0))
    share = planned_stage.carried_share(now, after, past)
    assert share.tolist() == pytest.approx([min(float(length[0] / (2 * since[0])), 1.0), 1.0, 0.0, 0.0, 0.5])
