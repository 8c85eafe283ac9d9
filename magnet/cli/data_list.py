"""The list of data sets: who may use each, where to ask, what must lie where, and how to train on it."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from magnet.cli.data_shown import TUNING, WHERE_CONFIGS
from magnet.datamodules import registry
from magnet.datamodules.reading.recording import Reader
from magnet.plugins import Registered, told

BODIES = {
    "smplx": "--body SMPLX_NEUTRAL.npz",
    "smpl": "--body SMPLX_NEUTRAL.npz --bodies SMPL",
    "smplh": "--body SMPLX_NEUTRAL.npz --bodies SMPLH",
}
"""The body that shape numbers need, by family: SMPL's and SMPL-H's are expressed in SMPL-X's."""
WHERE = {
    "smplx": "SMPL-X's file, npz or pkl, is from https://smpl-x.is.tue.mpg.de (register)",
    "smpl": "SMPL: the folder of its files, npz or pkl, from https://smpl.is.tue.mpg.de (register)",
    "smplh": "SMPL-H: the folder of its files, npz or pkl, from https://mano.is.tue.mpg.de (register)",
}


def draw_list(console: Console, name: str | None) -> bool:
    """Print all data sets, or one in full. -> whether the same call will print the same again"""
    if name:
        for entry in registry.unprepared():
            if entry.name.lower() == name.lower():
                show_data(console, entry)
                return True
        show_reader(console, registry.reader(name))
        return True
    for kind in registry.readers().values():
        show_reader(console, kind)
    for entry in registry.unprepared():
        show_data(console, entry)
    for lost in registry.failures():
        console.print(f"[bold red]{lost.name}[/]  of {lost.origin}", soft_wrap=True, highlight=False)
        show(console, "failed to load", told(lost.error))
    return not registry.failures()


def family_of(kind: type[Reader]) -> str:
    """Of the body that a data set's shape numbers belong to."""
    return next(iter(kind.shapes_of), kind.family)


def body_of(kind: type[Reader]) -> str:
    """Options with which a data set is prepared; "": the open body will do, which is the shipped model's."""
    return BODIES.get(family_of(kind), "")


def show_reader(console: Console, kind: type[Reader]) -> None:
    """A data set whose download is prepared."""
    console.print(f"[bold cyan]{kind.name}[/]  {kind.title}", soft_wrap=True)
    show(console, "who may use it", kind.licence)
    show(console, "where to ask", kind.source)
    wide = max((len(pattern) for pattern, _ in kind.layout), default=0)
    for number, (pattern, what) in enumerate(kind.layout):
        show(console, "" if number else "under --root", f"{pattern:<{wide}}  {what}")
    body = body_of(kind)
    model = " --data.body_model SMPLX_NEUTRAL.npz" if body else ""
    show(console, "then", f"magnet data prepare {kind.name} --root DOWNLOAD --out STORE {body}".rstrip())
    if not body:
        show(console, "", f"magnet fit --config {TUNING} --data.path STORE   # {WHERE_CONFIGS}")
    show(console, "", f"{registry.fit_command(registry.data_of(kind))} --data.path STORE{model}")
    if body:
        show(console, "", WHERE[family_of(kind)])
    if kind.fake:
        show(console, "to try it out", f"magnet data fake {kind.name} FAKE")


def show_data(console: Console, entry: Registered) -> None:
    """A data set that trains without being prepared."""
    console.print(f"[bold cyan]{entry.name}[/]  of {entry.origin}", soft_wrap=True)
    show(console, "what it is", (entry.kind.__doc__ or "").strip().partition("\n")[0])
    show(console, "then", registry.fit_command(entry.name))


def show(console: Console, what: str, text: str) -> None:
    """A line of it, as it is."""
    console.print(Text.assemble((f"  {what:<16}", "dim"), text), soft_wrap=True)
