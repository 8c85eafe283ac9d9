"""Which rows each table has, which cells they need, and what the paper claims of their order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from magnet.evaluation.benchmark import Benchmark
from magnet.report.cells import Cell
from magnet.report.folds import COPIED
from magnet.report.plan import FLOORS, OURS, Block, Claim, ReportOptions, Row

OWN_PLACE = "not in the paper"
"""Of orderings that are asked here alone."""
SAME = "Ours, trained as the peers"
"""base.yaml: as many steps on as many windows of the same data."""
BEFORE = "duet1"
"""The model before the shipped one."""
SCORE_SEED = 1111
"""Of `magnet score` and `magnet test`, so that these give the same numbers."""
BENCHMARK_COLUMNS = ("fd", "fd_pair", "div", "mi", "fs", "ip_ratio", "mpjpe@1s", "mpjpe", "mpjpe_best", "mpjve")
TRAINED_SO = ("trained and sampled so: pairs as clean as their token", "trained and sampled so: base.yaml")


def _rows(*rows: Row | list[Row] | None) -> tuple[Row, ...]:
    found: list[Row] = []
    for row in rows:
        found += row if isinstance(row, list) else [row] if row is not None else []
    return tuple(found)


def _claims(place: str, better: str, worse: str, metrics: str) -> list[Claim]:
    return [Claim(metric, better, worse, place) for metric in metrics.split()]


def table2(plan: ReportOptions) -> list[Block]:
    task, past = "partner_inpainting", {"own_past": True}
    claims = [
        *_claims("Table 2, DD100", "Ours", "Duolando", "fd mi fs ip_ratio mpjpe mpjve"),
        *_claims("Table 2, ReMoCap", "ReMoS", "Ours", "fd fs ip_ratio mpjpe"),
        Claim("div", "Ours", "ReMoS", "Table 2, ReMoCap"),
        Claim("mi", "Ours", "ReMoS", "section 4.2: in both cases better in MI"),
        *(claim for floor in ("RS", "NN") for claim in _claims("Table 2", "Ours", floor, "fd mi ip_ratio mpjpe mpjve")),
        *(Claim("fs", floor, "Ours", "section 4.2, on foot sliding") for floor in ("RS", "NN")),
        *(claim for peer in ("ReMoS", "Duolando") for claim in _claims(OWN_PLACE, SAME, peer, "fd mi fs mpjpe mpjve")),
    ]
    rows = [
        plan.floors(task, task_options=past),
        plan.row("ReMoS", task, "peer_remos", task_options=past),
        plan.row("Duolando", task, "peer_duolando", task_options=past),
        plan.row(SAME, task, "base", task_options=past),
        plan.row("Ours", task, task_options=past),
    ]
    nothing = [
        plan.floors(task, ("training set", "ground truth")),
        plan.row("ReMoS", task, "peer_remos"),
        plan.row("Duolando", task, "peer_duolando"),
        plan.row(SAME, task, "base"),
        plan.row("Ours", task),
    ]
    mine = tuple(
        claim for claim in claims if "RS" not in (claim.better, claim.worse) and "NN" not in (claim.better, claim.worse)
    )
    return [
        Block("partner inpainting, the past of both given", _rows(*rows), tuple(claims)),
        Block("partner inpainting, nothing of the generated person given", _rows(*nothing), mine),
    ]


def table3(plan: ReportOptions) -> list[Block]:
    partner = [
        plan.floors("partner_prediction"),
        plan.row("R2R", "partner_prediction", "peer_ready_to_react"),
        plan.row(SAME, "partner_prediction", "base"),
        plan.row("Ours", "partner_prediction"),
    ]
    turns = [
        plan.row(f"Ours (TT: {100 * offset:.0f}%)", "agentic_async", task_options={"offset": offset})
        for offset in (0.0, 0.5, 1.0)
    ]
    dyadic = [
        plan.floors("joint_future"),
        plan.row("R2R", "joint_future", "peer_ready_to_react"),
        plan.row(SAME, "joint_future", "base"),
        *turns,
        plan.row("Ours", "joint_future"),
    ]
    zero, half, whole = (f"Ours (TT: {percent}%)" for percent in (0, 50, 100))
    offsets = [
        *_claims("Table 3: FD grows with the offset", zero, half, "fd div"),
        *_claims("Table 3: FD grows with the offset", half, whole, "fd div"),
        *_claims("section 4.2: larger offsets are smoother", half, zero, "fs mpjve"),
        *_claims("section 4.2: larger offsets are smoother", whole, half, "fs mpjve"),
    ]
    return [
        Block(
            "partner prediction",
            _rows(*partner),
            (
                *_claims("section 4.2, partner prediction", "Ours", "R2R", "fd mi ip_ratio mpjpe mpjve"),
                *_claims("Table 3, left", "Ours", "NN", "fd mi ip_ratio mpjpe mpjve"),
                *_claims(OWN_PLACE, SAME, "R2R", "fd mi fs mpjpe mpjve"),
            ),
        ),
        Block(
            "dyadic prediction",
            _rows(*dyadic),
            (
                *_claims("section 4.2, dyadic prediction", "Ours", "R2R", "fd div ip_ratio"),
                *_claims("section 4.2 says so, Table 3 prints the contrary", "Ours", "R2R", "fs"),
                *_claims("Table 3, right", "Ours", "NN", "fd mi ip_ratio"),
                *_claims("Table 3, right", "R2R", "Ours", "mpjpe mpjve"),
                *_claims(OWN_PLACE, SAME, "R2R", "fd mi fs mpjpe mpjve"),
                *offsets,
            ),
        ),
    ]


def table4(plan: ReportOptions) -> list[Block]:
    blocks = []
    for people in (2, 3, 4):
        place = f"section 4.2, polyadic, Table 4, N = {people}"
        data = f"synthetic{people}"
        rows = _rows(plan.floors("joint_future", data=data), plan.row("Ours", "joint_future", data=data))
        claims = [claim for floor in ("RS", "NN") for claim in _claims(place, "Ours", floor, "fd fs mpjpe")]
        said = place if people < 4 else "section 4.2, polyadic, N = 4; Table 4 prints 0.009 for both"
        claims += [Claim("mpjve", "NN", "Ours", said), Claim("div", "RS", "Ours", place)]
        blocks.append(Block(f"joint future of {people} people, synthetic scenes", rows, tuple(claims)))
    return blocks


def table_a4(plan: ReportOptions) -> list[Block]:
    """Scenes differ from row to row, so each has training windows of its own."""
    scenes = {"2 people, recorded scenes": plan.data} | {f"{n} people, synthetic": f"synthetic{n}" for n in (2, 3, 4)}
    floors = [
        replace(row, title=f"{row.title}, {title}")
        for title, data in scenes.items()
        for row in plan.floors("joint_future", ("training set",), data=data)
    ]
    rows = [plan.row(title, "joint_future", data=data) for title, data in scenes.items()]
    _, two, three, four = scenes
    claims = [
        claim for more in (two, four) for claim in _claims("A.5: of three people lowest", three, more, "fd mpjpe")
    ]
    return [Block("joint future; one model for all", _rows(floors, *rows), tuple(claims))]


def ablated(
    title: str, rows: dict[str, str], claims: Sequence[tuple[str, ...]], place: str
) -> Callable[[ReportOptions], list[Block]]:
    """A table of trainings that differ in one thing from base.yaml.

    claims: better, worse, in which metrics, and where the paper says so, if not at `place`
    """

    def table(plan: ReportOptions) -> list[Block]:
        floors = plan.floors("joint_future", ("NN", "training set", "ground truth"))
        trained = [plan.row(name, "joint_future", config) for name, config in {**rows, "Ours": "base"}.items()]
        said = [claim for who, whom, of, *at in claims for claim in _claims(at[0] if at else place, who, whom, of)]
        return [Block(title, _rows(floors, *trained), tuple(said))]

    return table


def table_a3(plan: ReportOptions) -> list[Block]:
    tasks = {
        "partner_inpainting": ("partner inpainting", {"Duolando": "peer_duolando", "ReMoS": "peer_remos"}),
        "partner_prediction": ("partner prediction", {"R2R": "peer_ready_to_react"}),
        "joint_future": ("dyadic prediction", {"R2R": "peer_ready_to_react"}),
    }
    blocks = []
    for task, (title, peers) in tasks.items():
        own = {"own_past": True} if task == "partner_inpainting" else {}
        rows = [plan.row(name, task, config, "speed", task_options=own) for name, config in peers.items()]
        rows.append(plan.row("Ours", task, "", "speed", task_options=own))
        claims = tuple(Claim("times_shipped", "Ours", name, "Table A.3") for name in peers)
        blocks.append(Block(f"{title}, frames a second of one scene", _rows(*rows), claims, ("fps", "times_shipped")))
    return blocks


def table_a6(plan: ReportOptions) -> list[Block]:
    options = {"noise_sampling": "independent"}
    blocks = []
    for config, what in (("", "the shipped weights"), ("base", "base.yaml, trained here")):
        floors = plan.floors("joint_future", ("NN", "training set", "ground truth"))
        sampled = _rows(
            plan.row("Independent (per-token)", "joint_future", config, sampler=options),
            plan.row("Ours", "joint_future", config),
        )
        claims = (
            *_claims("A.6.2, Table A.6", "Ours", "Independent (per-token)", "fd div mi ip_ratio"),
            *_claims("A.6.2, Table A.6", "Independent (per-token)", "Ours", "fs mpjpe"),
        )
        if sampled:
            title = f"dyadic prediction, {what}: noise of agents at a time step"
            blocks.append(Block(title, _rows(floors, *sampled), claims))
    return blocks


def figure7(plan: ReportOptions) -> list[Block]:
    length = min(150, plan.budget.frames)
    ends = tuple(f"fd@{end}" for end in range(length, plan.budget.frames + 1, length))
    rows = _rows(
        plan.floors("joint_future", ("training set", "ground truth"), "long"),
        plan.row("R2R", "joint_future", "peer_ready_to_react", "long"),
        plan.row("Ours", "joint_future", "", "long"),
    )
    claims = tuple(_claims("section 4.2, ultra-long generation", "Ours", "R2R", "fd mi ip_ratio"))
    columns = (*ends, "mi", "ip_ratio")
    return [Block("FD of all that was generated so far, by frames; MI and IP of all of it", rows, claims, columns)]


def leaks(plan: ReportOptions) -> list[Block]:
    """What partner tasks gain by the reference's reading (docs/representation.md)."""
    blocks = []
    for task in ("partner_prediction", "motion_control", "partner_inpainting"):
        rows = [
            *plan.floors(task, ("training set", "ground truth")),
            plan.row("ours: nothing unknown is read", task),
            plan.row("pairs as clean as their token", task, leak="pairs"),
            plan.row(TRAINED_SO[1], task, "base"),
            plan.row(TRAINED_SO[0], task, "pairwise_token_noise"),
        ]
        listed = []
        for row in _rows(*rows):
            both = [row, replace(row, title=row.title + COPIED, inside=OURS + COPIED)]
            listed += both if row.inside == OURS else [row]
        claims = [
            claim
            for clean, plain in (("pairs as clean as their token", "ours: nothing unknown is read"), TRAINED_SO)
            if {clean, plain} <= {row.title for row in listed}
            for claim in _claims(OWN_PLACE, clean, plain, "fd mi mpjpe mpjve")
        ]
        blocks.append(Block(task, tuple(listed), tuple(claims)))
    return blocks


def benchmark(plan: ReportOptions) -> list[Block]:
    """The open benchmark as its page asks: all its scenes, its number of samples, and the seed of `magnet score`."""
    split = Benchmark.read()
    if plan.budget.whole_benchmark:
        budget = replace(plan.budget, scenes=len(split.scenes), samples=split.samples, sampler="default")
        plan = replace(plan, budget=budget)
    plan = replace(plan, data="salsa", own_seeds=(SCORE_SEED,))
    before = replace(plan, checkpoint=BEFORE)
    blocks = []
    for task in split.tasks:
        blind = task == "partner_inpainting"  # nothing of the generated person is given: no baseline can go on from it
        rows = _rows(plan.floors(task, FLOORS[-2:] if blind else FLOORS))
        if task != "motion_control":  # ten samples of it take as long as all else here
            rows = _rows(plan.row("Ours", task), before.row(BEFORE, task), list(rows))
        blocks.append(Block(f"the open benchmark, {task}", rows, (), BENCHMARK_COLUMNS))
    return blocks


_A5 = {"w/o Agent PE": "no_agent_encoding", "w/o Time PE": "no_time_encoding", "w/o Agent & Time PE": "no_encodings"}
_OWN = {
    "noise per timestep": "per_timestep_noise",
    "noise per sequence": "per_sequence_noise",
    "pairs as clean as their token": "pairwise_token_noise",
    "noise as sampling has it": "mixture",
    "that and self-forcing": "self_forcing",
    "skip": "skip",
    "causal": "causal",
}
_OWN_BASE = {"that and self-forcing": "noise as sampling has it"}
"""What a choice is compared with where that is another choice of ours."""

TABLES: dict[str, Callable[[ReportOptions], list[Block]]] = {
    "2": table2,
    "3": table3,
    "4": table4,
    "5": ablated(
        "dyadic prediction, ablations",
        {"w/o VQ-VAE": "no_vqvae", "w/o T^self->partner": "no_pairwise"},
        [("Ours", "w/o VQ-VAE", "fd fs mi mpjpe mpjve"), ("Ours", "w/o T^self->partner", "fd ip_ratio mpjpe")],
        "section 4.2, Table 5",
    ),
    "A.3": table_a3,
    "A.4": table_a4,
    "A.5": ablated(
        "dyadic prediction, encodings",
        _A5,
        [
            *(("Ours", row, "fd mi fs ip_ratio mpjpe mpjve") for row in list(_A5)[:2]),
            ("Ours", "w/o Agent & Time PE", "fd fs ip_ratio mpjpe mpjve"),
            ("Ours", "w/o Agent & Time PE", "mi", "A.6.1 says so, Table A.5 prints the contrary"),
            *((row, "Ours", "div") for row in _A5),
            ("w/o Agent PE", "w/o Time PE", "fd"),
            *((row, "w/o Agent & Time PE", "mpjve") for row in list(_A5)[:2]),
        ],
        "A.6.1, Table A.5",
    ),
    "A.6": table_a6,
    "Fig. 7": figure7,
    "own": ablated(
        "choices of ours",
        _OWN,
        [(_OWN_BASE.get(row, "Ours"), row, "fd mi mpjpe mpjve") for row in _OWN],
        OWN_PLACE,
    ),
    "leak": leaks,
    "benchmark": benchmark,
}


def named(table: str) -> str:
    """A table by what a user may write: `3`, `a.3`, `A3`, `fig7`.

    Raises:
        ValueError: no such table.
    """
    plain = {name.lower().replace(".", "").replace(" ", ""): name for name in TABLES}
    found = plain.get(table.lower().replace(".", "").replace(" ", "").removeprefix("table"))
    if found is None:
        raise ValueError(f"table: got {table!r}, expected one of {', '.join(TABLES)} or all")
    return found


def cells_of(blocks: Iterable[Block]) -> list[Cell]:
    """Every cell once: trainings first, then seed by seed, so that a report that is cut short has whole seeds."""
    found: dict[Cell, None] = {}
    for block in blocks:
        for row in block.rows:
            for cell in row.cells:
                if cell.needs is not None:
                    found.setdefault(cell.needs)
                found.setdefault(cell)
    return sorted(found, key=lambda cell: (cell.kind != "train", cell.seed))
