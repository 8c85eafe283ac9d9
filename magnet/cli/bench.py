"""`magnet bench`: how fast a model samples on this machine, beside the arithmetic that it cannot do without."""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magnet.cli.errors import CommandError, no_such
from magnet.cli.flags import PlainParser, taken_out
from magnet.errors import counted

if TYPE_CHECKING:
    from magnet.denoiser.core import DenoiserCore

EPILOG = """\
ms/eval is one run of the network on the whole batch. "floor" is its matrix products alone, timed in the same round;
compare other machines and days by the ratio, "x floor". "first" is the time until the first frames. "live" is a partner
who answers token by token in real time. --task.NAME VALUE sets an option of all tasks that have it (magnet tasks lists
them).

for example:
  magnet bench --quick
  magnet bench --model paper --task joint_future --task motion_control --out paper.json
  magnet bench --quick --task agentic_async --task.offset 0.5
  magnet bench --quick --compare before.json
"""
COLUMNS = {
    "evaluation_ms": "ms/eval",
    "floor_ratio": "x floor",
    "operators": "operators",
    "evaluations_per_frame": "evals/frame",
    "frames_per_second": "frames/s",
    "first_frame_ms": "first, ms",
    "memory_mib": "MiB",
}
QUICK: dict[str, Any] = {"people": [2], "batch": [1], "live": 10.0}
WHOLE: dict[str, Any] = {"people": [1, 2, 3, 4], "batch": [1, 10], "live": 60.0}


def parser() -> argparse.ArgumentParser:
    options = PlainParser("bench", __doc__, EPILOG)
    add = options.add_argument
    add("--model", default=None, metavar="NAME", help="shipped model, checkpoint, or `paper`: untrained, at its sizes")
    add("--task", action="append", default=[], metavar="NAME", help="only this task; may be repeated (default: all)")
    add("--people", type=int, action="append", default=[], metavar="P", help="may be repeated (default: 1 to 4)")
    add("--batch", type=int, action="append", default=[], metavar="B", help="scenes at once (default: 1 and 10)")
    add("--quick", action="store_true", help="two people, batch 1, ten seconds live")
    add("--frames", type=int, default=32, help="frames to sample (default: %(default)s)")
    add("--rounds", type=int, default=3, help="rounds to take medians over (default: %(default)s)")
    add("--sampler", default="default", metavar="PRESET", help="sampler preset (default: %(default)s)")
    add("--steps", type=int, default=None, help="denoising steps (default: the sampler's)")
    add("--precision", default=None, help="reference, float32, bf16 or int8 (default: the sampler's)")
    add("--compile", action="store_true", help="compile the network, with int8 or on a GPU; not counted")
    add("--live", type=float, default=None, metavar="SECONDS", help="seconds of live answers (default: 60); 0: none")
    add("--threads", type=int, default=None, help="threads of torch (default: its own choice)")
    add("--clock", choices=("wall", "cpu"), default="wall", help="cpu: seconds of this process, for a busy machine")
    add("--device", default="cpu", help="where it runs (default: %(default)s)")
    add("--out", type=Path, default=None, metavar="FILE", help="write everything measured as JSON")
    add("--compare", type=Path, default=None, metavar="FILE", help="JSON of another run: print now over then")
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code."""
    taken, others = taken_out(arguments, r"--task\.")
    of_tasks = {words[0].removeprefix("--task.").partition("=")[0]: words for words in taken}
    given = parser().parse_args(others)
    for name in ("frames", "rounds", "steps", "threads"):
        if getattr(given, name) is not None and getattr(given, name) < 1:
            raise CommandError(f"--{name} is {getattr(given, name)}, expected at least 1")
    for name in ("people", "batch"):
        if min(getattr(given, name) or [1]) < 1:
            raise CommandError(f"--{name} is {min(getattr(given, name))}, expected at least 1")
    if given.live is not None and not 0 <= given.live < float("inf"):
        raise CommandError(f"--live is {given.live:g}, expected seconds, 0 for none")
    if given.out is not None:
        from magnet.files import require_place, write_text  # imports NumPy, which --help need not wait for

        require_place(given.out)
    then = None if given.compare is None else read(given.compare)
    import torch

    if given.threads is not None:
        torch.set_num_threads(given.threads)
    found = run(given, of_tasks)
    if given.out is not None:
        write_text(given.out, json.dumps(found, indent=1, default=dataclasses.asdict) + "\n")
        print(f"written: {given.out}")
    if then is not None:
        print(compared(then, found))
    return 0


def read(path: Path) -> dict[str, Any]:
    """What another run has written."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        for case in found["cases"].values():
            _positive(case[name] for name in COLUMNS if case.get(name))
        if found.get("live"):
            _positive([found["live"]["median_ms"]])
        (found.get("git") or {}).get("commit")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CommandError(f"--compare {path}: not a file that `magnet bench --out` has written") from error
    return dict(found)


def _positive(numbers: Iterable[Any]) -> None:
    """Raises ValueError or TypeError where something is no number over 0."""
    for number in numbers:
        if not 0 < number < float("inf"):
            raise ValueError(f"got {number!r}")


def task_options(flags: Mapping[str, list[str]], tasks: Sequence[str]) -> dict[str, dict[str, Any]]:
    """What was asked of each task: those of the options that it has."""
    from magnet.cli.tasks import parse_task, task_class

    has = {task: {each.name for each in dataclasses.fields(task_class(task))} for task in tasks}
    known = sorted(set().union(*has.values()))
    for name in flags:
        if name.partition(".")[0] not in known:  # what lies in a dataclass of a task, its own parser knows
            raise CommandError(
                no_such("option", f"--task.{name}", [f"--task.{each}" for each in known], "magnet tasks")
            )
    found = {}
    for task, own in has.items():
        said = [name for name in flags if name.partition(".")[0] in own]
        words = [word for name in said for word in flags[name]]
        asked = parse_task(task, words, command=f"tasks show {task}").task
        found[task] = {name: getattr(asked, name) for name in dict.fromkeys(name.partition(".")[0] for name in said)}
    return found


def run(given: argparse.Namespace, of_tasks: Mapping[str, list[str]]) -> dict[str, Any]:
    """Measure and print, case by case. Returns everything that was measured, JSON-ready."""
    import torch

    from magnet.bench.speed import cases, live_latency, measure
    from magnet.cli.provenance import machine, provenance
    from magnet.precision import device_of
    from magnet.sampling.options import SamplerOptions
    from magnet.tasks import registry

    clock = time.process_time if given.clock == "cpu" else time.perf_counter
    usual = QUICK if given.quick else WHOLE
    tasks = given.task or registry.names()
    options_of = task_options(of_tasks, tasks)
    model = load(given.model).to(device_of(given.device))
    asked = {"steps": given.steps, "precision": given.precision, "compile": given.compile or None}
    options = SamplerOptions.preset(given.sampler, **{name: v for name, v in asked.items() if v is not None})
    most = model.layout.agents
    if given.people and max(given.people) > most:
        raise CommandError(f"--people is {max(given.people)}, expected at most the model's {most}")
    people = [P for P in given.people or usual["people"] if most >= P]
    wanted = cases(tasks, people, given.batch or usual["batch"], options_of)
    if not wanted:
        raise CommandError(f"none of {', '.join(tasks)} is for {' or '.join(map(str, people))} people")
    threads = counted(torch.get_num_threads(), "thread")
    print(f"{given.model or 'the default model'}, {options.steps} steps, {options.precision}, {threads}")
    print(row("", list(COLUMNS.values())), flush=True)
    found: dict[str, Any] = {"cases": {}, "live": None}
    for case in wanted:
        speed = dataclasses.asdict(measure(model, case, options, given.frames, given.rounds, clock=clock))
        found["cases"][str(case)] = speed
        print(row(str(case), [shown(speed[name]) for name in COLUMNS]), flush=True)
    seconds = usual["live"] if given.live is None else given.live
    if seconds and model.layout.agents > 1:
        found["live"] = live = live_latency(model, options, seconds)
        print(
            f"live: {live['answers']} answers in {live['median_ms']:.0f} ms (median), {live['p99_ms']:.0f} ms (99th "
            f"percentile), jitter {live['jitter_ms']:.1f} ms, {live['late']} late of {live['period_ms']:.0f} ms"
        )
    about = {"model": given.model, "threads": threads, "frames": given.frames, "rounds": given.rounds}
    about |= {"clock": given.clock, "task_options": dict(item for own in options_of.values() for item in own.items())}
    return {**found, **about, "sampler": dataclasses.asdict(options), "machine": machine(), **provenance()}


def load(name: str | None) -> DenoiserCore:
    """The model that is measured."""
    from magnet.bench.speed import paper_model
    from magnet.denoiser.core import DenoiserCore

    return paper_model() if name == "paper" else DenoiserCore.load(name)


def compared(then: dict[str, Any], now: dict[str, Any]) -> str:
    """How two runs differ: now over then, of each case that both have."""
    both = [name for name in now["cases"] if name in then["cases"]]
    if not both:
        return f"nothing to compare: the other run measured {', '.join(then['cases']) or 'nothing'}"
    lines = [f"now over then ({(then.get('git') or {}).get('commit', 'no commit')})", row("", list(COLUMNS.values()))]
    for name in both:
        old, new = then["cases"][name], now["cases"][name]
        ratios = [new[key] / old[key] if old.get(key) and new.get(key) else None for key in COLUMNS]
        lines.append(row(name, [shown(ratio) for ratio in ratios]))
    if then.get("live") and now.get("live"):
        lines.append(f"live, median answer: {now['live']['median_ms'] / then['live']['median_ms']:.2f}")
    return "\n".join(lines)


def row(name: str, values: Sequence[str]) -> str:
    return f"{name:<42}" + "".join(f"{value:>12}" for value in values)


def shown(value: float | None) -> str:
    """A number in few digits."""
    if value is None:
        return "-"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
