"""The paper's tables as rows and claims: what is printed, what each needs, and what the leak table calls a leak."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from magnet.cli import score
from magnet.evaluation.benchmark import SPLIT_FILE
from magnet.evaluation.evaluator import Evaluator
from magnet.motion.tokens import TokenLayout
from magnet.report import measure
from magnet.report.cells import BUDGETS
from magnet.report.plan import COLUMNS, PAPER
from magnet.report.tables import OWN_PLACE, TABLES, cells_of, named
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser
from tests.evaluation.test_evaluator import FAST, data
from tests.report.toys import PLAN


def test_printed_numbers_are_those_that_the_text_quotes() -> None:
    """Section 4.2 and A.6 quote ratios of them; and the paper contradicts itself as issue 21 says."""
    tables = {
        name: {row: v for rows in each.values() for row, v in rows.items()} for name, each in PAPER["tables"].items()
    }
    assert 1 - tables["Fig. 7"]["Ours"][0] / tables["Fig. 7"]["R2R"][0] == pytest.approx(0.89, abs=0.005)
    fd, mpjve = (PAPER["columns"].index(name) for name in ("fd", "mpjve"))
    full = tables["5"]["Ours"][fd]
    assert tables["5"]["w/o VQ-VAE"][fd] / full == pytest.approx(86, abs=0.5)
    assert tables["A.5"]["w/o Agent PE"][fd] / full == pytest.approx(11, abs=0.5)
    assert tables["A.5"]["w/o Time PE"][fd] / full == pytest.approx(39, abs=0.5)
    assert (tables["3"]["Ours"][fd], full) == (0.118, 0.052)
    assert (tables["5"]["Ours"][mpjve], tables["A.6"]["Ours"][mpjve]) == (0.034, 0.006)
    for name, rows in tables.items():
        assert {len(row) for row in rows.values()} == {1 if name == "A.3" else 7}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_claims_what_it_has_rows_for(name: str) -> None:
    blocks = TABLES[name](PLAN)
    assert blocks
    for block in blocks:
        titles = [row.title for row in block.rows]
        assert len(titles) == len(set(titles))
        assert {title for claim in block.claims for title in (claim.better, claim.worse)} <= set(titles)
    cells = cells_of(blocks)
    assert len({cell.name for cell in cells}) == len(cells)
    for number, cell in enumerate(cells):
        assert cell.needs is None or cell.needs in cells[:number]
        if cell.kind == "train":
            assert cell.model is not None and cell.model.digest, "no such configuration"
    shipped = cells_of(TABLES[name](replace(PLAN, only_shipped=True)))
    assert all(cell.kind != "train" and cell.needs is None for cell in shipped)


def test_the_open_benchmark_is_measured_as_magnet_score_measures_it_whatever_the_budget() -> None:
    split = json.loads(SPLIT_FILE.read_text(encoding="utf-8"))
    for budget in ("evening", "paper"):
        blocks = TABLES["benchmark"](replace(PLAN, budget=BUDGETS[budget], data="synthetic2"))
        assert [block.title.rpartition(" ")[2] for block in blocks] == split["tasks"]
        for cell in cells_of(blocks):
            assert (cell.scenes, cell.samples) == (len(split["scenes"]), split["samples"])
            assert cell.seed == score.parser().get_default("seed")
            assert cell.data == "salsa" and not cell.task_options and not cell.sampler


def test_on_the_papers_budget_every_model_is_sampled_as_the_paper_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = replace(PLAN, budget=BUDGETS["paper"])
    cells = cells_of(block for name, table in TABLES.items() if name != "benchmark" for block in table(plan))
    asked = {cell.sampler: cell for cell in cells if cell.model is not None and cell.kind != "train"}
    assert len(asked) == 2  # agents' noise joint, and independent
    monkeypatch.setattr(measure, "load", lambda _: tiny_denoiser(max_agents=2))
    for cell in asked.values():
        method = measure.predictor(cell, data(max_agents=2), "some.ckpt")
        noise = dict(cell.sampler).get("noise_sampling", "joint")
        assert method.__self__.sampler == SamplerOptions.preset("paper", noise_sampling=noise)


def test_an_ordering_is_that_of_the_printed_numbers_or_says_that_it_is_not() -> None:
    """Of Table 3 the two tasks have tables of their own, of Table 4 the group sizes."""
    for name, table in TABLES.items():
        printed = PAPER["tables"].get(name, {})
        for block in table(PLAN):
            words = block.title.removeprefix("joint future of ").partition(",")[0]
            near = {title: rows for title, rows in printed.items() if words in title} or printed
            for claim in block.claims:
                place = COLUMNS.index(claim.metric) if claim.metric in COLUMNS and claim.place != OWN_PLACE else None
                for rows in near.values() if place is not None else ():
                    both = [rows.get(row, [None] * 7)[place] for row in (claim.better, claim.worse)]
                    if None not in both and sorted({*both}, reverse=not claim.lower) != both:
                        assert "prints" in claim.place, f"{name}: {claim}"


@pytest.mark.parametrize(("said", "meant"), [("3", "3"), ("a3", "A.3"), ("Fig7", "Fig. 7"), ("table5", "5")])
def test_tables_are_known_by_what_one_writes(said: str, meant: str) -> None:
    assert named(said) == meant


@pytest.mark.parametrize(
    ("task", "leaks"), [("partner_prediction", False), ("partner_inpainting", True), ("motion_control", True)]
)
def test_pairs_as_clean_as_their_token_tell_of_who_is_unknown_where_a_partner_is_given(task: str, leaks: bool) -> None:
    """Where all that the task does not give is noise, the samples are others: what the table calls a leak."""
    made = []
    for noisy in (False, True):
        model = tiny_denoiser(max_agents=2)
        layout = TokenLayout(model.layout.latent, 2, True, "token")
        model.layout = model.transformer.layout = layout
        datamodule = data(max_agents=2)
        evaluation = Evaluator(model, registry.get(task)(), FAST, 1, baselines=False)
        evaluation.start(datamodule)
        batch = next(iter(datamodule.test_dataloader()))
        if noisy:
            plan = evaluation.schedule(evaluation.context, evaluation.horizon, 2)
            known = plan.known.repeat_interleave(4, dim=0)[: batch.frames, :, None, None]
            noise = random_scene(batch.scenes, batch.frames, 2, torch.Generator().manual_seed(5))
            batch = batch.replace(
                body_rot=torch.where(known[..., None], batch.body_rot, noise.body_rot),
                T_world_root=torch.where(known, batch.T_world_root, noise.T_world_root),
            )
        made.append(evaluation.sample(batch, 1, evaluation.generators_of(batch.scenes)).T_world_root)
    assert torch.equal(*made) != leaks
