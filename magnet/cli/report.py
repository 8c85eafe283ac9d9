"""`magnet report TABLE`: the paper's tables, run here, beside the printed numbers, and what holds of its claims."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from magnet.cli.flags import PlainParser

if TYPE_CHECKING:
    from magnet.report.cells import Cell
    from magnet.report.run import Runner

EPILOG = """\
TABLE is 2, 3, 4, 5, A.3, A.4, A.5, A.6, Fig.7, own (choices of ours), leak (what partner tasks gain by the reference's
reading), benchmark (the open one, as magnet score measures it) or all; several may be named. A table is made of cells:
a measurement with one seed, or a training. Those that are done are kept in OUT/cells, one file each, so a run that was
stopped goes on where it was, a training from its last checkpoint.

for example:
  magnet report 3 --dry_run            the cells of Table 3, and how long they may take
  magnet report 4 A.4 leak --shipped   what needs no training
  magnet report all                    a day on two cores, trainings included
  magnet report 5 --budget paper --data configs/paper/data/duobox.yaml --configs configs/paper/ablations
"""


def parser() -> argparse.ArgumentParser:
    options = PlainParser("report", __doc__, EPILOG)
    add = options.add_argument
    add("tables", nargs="+", metavar="TABLE", help="which")
    out = "folder for cells and page (default: %(default)s)"
    add("--out", type=Path, default=Path("runs/report"), metavar="FOLDER", help=out)
    budgets = ("tiny", "evening", "small", "paper")
    add("--budget", choices=budgets, default="small", help="of every cell (default: %(default)s)")
    add("--ckpt_path", default="duet", metavar="MODEL", help="weights of our row (default: %(default)s)")
    add("--data", default="salsa", help="scenes of two people: salsa, synthetic2, or a file (default: %(default)s)")
    add("--configs", type=Path, default=Path("configs/report"), help="of trainings (default: %(default)s)")
    add("--shipped", action="store_true", help="leave out rows that would have to be trained")
    add("--dry_run", action="store_true", help="list the cells and what they may take, and stop")
    only = "run only cells whose name holds one of these, and what these need"
    add("--only", nargs="+", action="extend", metavar="TEXT", help=only)
    skip = "leave cells for later whose name holds one of these, and what needs a training of them that is not done"
    add("--skip", nargs="+", action="extend", default=[], metavar="TEXT", help=skip)
    add("--page_only", action="store_true", help="write the page from what is done")
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code: 1 where a cell could not be done."""
    given = parser().parse_args(list(arguments))
    from magnet.cli import folder_lock
    from magnet.cli.provenance import machine, provenance
    from magnet.cli.quiet import quiet
    from magnet.cli.train import run_trainer
    from magnet.files import require_place
    from magnet.report.cells import BUDGETS, Store
    from magnet.report.page import page
    from magnet.report.plan import ReportOptions
    from magnet.report.run import Runner, clock
    from magnet.report.tables import TABLES, cells_of, named

    quiet()
    names = list(TABLES) if "all" in given.tables else [named(table) for table in given.tables]
    plan = ReportOptions(BUDGETS[given.budget], given.data, given.ckpt_path, given.shipped, given.configs)
    blocks = {name: TABLES[name](plan) for name in names}
    cells = cells_of(block for each in blocks.values() for block in each)
    store = Store(given.out)
    git = provenance()["git"]
    own_data = Path(given.data) if given.data.endswith((".yaml", ".yml")) else None
    runner = Runner(
        store,
        lambda words: run_trainer("fit", words),
        given.configs,
        given.ckpt_path,
        plan.budget.speed_rounds,
        "" if git is None else git["commit"][:7] + "+" * git["changed"],  # a plus where files were changed
        own_data,
    )
    wanted = chosen(runner, cells, given.only or [""], given.skip)
    todo = runner.missing(wanted)
    if given.dry_run:
        times = runner.times(todo)
        for cell, seconds in zip(todo, times, strict=True):
            print(f"{seconds:6.0f} s  {cell.name}")
        total = clock(sum(times))
        guessed = any(not store.of_kind(kind) for kind in {cell.kind for cell in todo})
        how = ", guessed for the budget small where none of a kind is done" * guessed
        print(f"{len(wanted)} cells, {len(wanted) - len(todo)} done; the other {len(todo)} may take {total}{how}")
        return 0
    if not given.page_only:
        require_place(given.out / "report.json")
        with folder_lock.held(given.out, "report"):  # another one would begin the same trainings anew
            runner.run(wanted)
    facts = {"tables": ", ".join(names), "budget": f"{given.budget}: {plan.budget.told}", "data": given.data}
    facts |= {"checkpoint": given.ckpt_path, **provenance(), "machine": machine()}
    written = page(blocks, store, runner.failed, facts)
    store.pack()
    print(f"written: {written}, report.json and cells.json")
    return int(bool(runner.failed))


def chosen(runner: Runner, cells: Sequence[Cell], only: Sequence[str], skip: Sequence[str]) -> list[Cell]:
    """The cells that --only and --skip leave, and the trainings that they need."""
    later = {cell for cell in cells if held(cell.name, skip)}
    wait = {cell for cell in cells if cell.needs in later and cell.needs in runner.missing([cell.needs, cell])}
    wanted = {cell for cell in cells if held(cell.name, only)} - later - wait
    needed = {cell.needs for cell in wanted}
    return [cell for cell in cells if cell in wanted or cell in needed]


def held(name: str, texts: Sequence[str]) -> bool:
    """Whether a name holds one of some texts."""
    return any(text in name for text in texts)
