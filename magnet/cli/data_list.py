"""`magnet data list`: for each data set who may use it, where to ask, what must lie where, and the commands then."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from magnet.cli import answers

if TYPE_CHECKING:
    from rich.console import Console

    from magnet.datamodules.reading.recording import Reader
    from magnet.plugins import Registered

BODIES = {"smplx": "--body SMPLX_NEUTRAL.npz", "smpl": "--body SMPLX_NEUTRAL.npz --bodies SMPL"}
"""The body that shape numbers need, by family: SMPL's are expressed in SMPL-X's."""
WHERE = {
    "smplx": "SMPL-X's file, npz or pkl, is from https://smpl-x.is.tue.mpg.de (register)",
    "smpl": "SMPL: the folder of its files, npz or pkl, from https://smpl.is.tue.mpg.de (register)",
}


def add_list(one: argparse.ArgumentParser) -> None:
    one.add_argument("name", nargs="?", help="the data set to tell of; default: all")


def run_list(given: argparse.Namespace) -> int:
    answers.show(f"data list {given.name or ''}", lambda console: draw_list(console, given.name))
    return 0


def draw_list(console: Console, name: str | None) -> bool:
    """Print all data sets, or one in full. -> whether the same call will print the same again"""
    from magnet.datamodules import registry

    if name:
        show_reader(console, registry.reader(name))
        return True
    for kind in registry.readers().values():
        show_reader(console, kind)
    for entry in registry.unprepared():
        show_data(console, entry)
    for plugin, error in registry.failures().items():
        console.print(f"[bold red]{plugin}[/]", soft_wrap=True)
        show(console, "failed to load", f"{type(error).__name__}: {error}")
    return not registry.failures()


def show_reader(console: Console, kind: type[Reader]) -> None:
    """A data set whose download is prepared."""
    from magnet.datamodules import registry

    console.print(f"[bold cyan]{kind.name}[/]  {kind.title}", soft_wrap=True)
    show(console, "who may use it", kind.licence)
    show(console, "where to ask", kind.source)
    wide = max((len(pattern) for pattern, _ in kind.layout), default=0)
    for number, (pattern, what) in enumerate(kind.layout):
        show(console, "" if number else "under --root", f"{pattern:<{wide}}  {what}")
    body = BODIES.get(kind.family, "")
    model = " --data.body_model SMPLX_NEUTRAL.npz" if body else ""
    show(console, "then", f"magnet data prepare {kind.name} --root DOWNLOAD --out STORE {body}".rstrip())
    if kind.own:
        show(console, "", "magnet fit --config configs/finetune.yaml --data.path STORE")
    show(console, "", f"{registry.fit_command(registry.data_of(kind))} --data.path STORE{model}")
    if body:
        show(console, "", WHERE[kind.family])
    if kind.fake:
        show(console, "to try it out", f"magnet data fake {kind.name} FAKE")


def show_data(console: Console, entry: Registered) -> None:
    """A data set that trains without being prepared."""
    from magnet.datamodules import registry

    console.print(f"[bold cyan]{entry.name}[/]  of {entry.origin}", soft_wrap=True)
    show(console, "what it is", (entry.kind.__doc__ or "").strip().partition("\n")[0])
    show(console, "then", registry.fit_command(entry.name))


def show(console: Console, what: str, text: str) -> None:
    """A line of it, as it is."""
    from rich.text import Text

    console.print(Text.assemble((f"  {what:<16}", "dim"), text), soft_wrap=True)
