"""`magnet data list`: for each data set who may use it, where to ask, what must lie where, and the commands then."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from magnet.datamodules.reading.recording import Reader

BODIES = {
    "smplx": "--body SMPLX_NEUTRAL.npz",
    "smpl": "--body SMPLX_NEUTRAL.npz --bodies SMPL",
}
"""The body that shape numbers need, by family: SMPL's are expressed in SMPL-X's."""
WHERE = {
    "smplx": "SMPL-X's file, npz or pkl, is from https://smpl-x.is.tue.mpg.de (register)",
    "smpl": "SMPL: the folder of its files, npz or pkl, from https://smpl.is.tue.mpg.de (register)",
}


def add_list(one: argparse.ArgumentParser) -> None:
    one.add_argument("name", nargs="?", help="the data set to tell of; default: all")


def run_list(given: argparse.Namespace) -> int:
    from rich.console import Console

    from magnet.datamodules import catalogue

    console = Console(highlight=False)
    for name in [given.name] if given.name else [*catalogue.NAMES, *catalogue.UNPREPARED]:
        if name in catalogue.UNPREPARED:
            console.print(f"[bold cyan]{name}[/]", soft_wrap=True)
            show(console, "what to do", catalogue.UNPREPARED[name])
        else:
            show_reader(console, name, catalogue.find(name).load_reader(), catalogue.find(name).data.partition(":")[2])
    if not given.name:
        show_plugins(console)
    return 0


def show_reader(console: Console, name: str, kind: type[Reader], data: str) -> None:
    """One data set."""
    from magnet.datamodules import catalogue

    console.print(f"[bold cyan]{name}[/]  {kind.title}", soft_wrap=True)
    show(console, "who may use it", kind.licence)
    show(console, "where to ask", kind.source)
    wide = max((len(pattern) for pattern, _ in kind.layout), default=0)
    for number, (pattern, what) in enumerate(kind.layout):
        show(console, "" if number else "under --root", f"{pattern:<{wide}}  {what}")
    body = BODIES.get(kind.family, "")
    model = " --data.body_model SMPLX_NEUTRAL.npz" if body else ""
    show(console, "then", f"magnet data prepare {name} --root DOWNLOAD --out STORE {body}".rstrip())
    if name in catalogue.OWN:
        show(console, "", "magnet fit --config configs/finetune.yaml --data.path STORE")
    show(console, "", f"magnet fit --model Tokenizer --data {data} --data.path STORE{model}")
    if body:
        show(console, "", WHERE[kind.family])
    show(console, "to try it out", f"magnet data fake {name} FAKE")


def show_plugins(console: Console) -> None:
    """Data sets that installed packages bring, and those that failed to load."""
    from magnet.datamodules import plugins

    found = plugins.discover()
    for plugin in found.plugins:
        console.print(f"[bold cyan]{plugin.name}[/]  of {plugin.origin}", soft_wrap=True)
        show(console, "what it is", (plugin.data.__doc__ or "").strip().partition("\n")[0])
        show(console, "then", f"magnet fit --model Tokenizer --data {plugin.name}")
    for name, error in found.failures.items():
        console.print(f"[bold red]{name}[/]", soft_wrap=True)
        show(console, "failed to load", f"{type(error).__name__}: {error}")


def show(console: Console, what: str, text: str) -> None:
    """A line of it, as it is."""
    from rich.text import Text

    console.print(Text.assemble((f"  {what:<16}", "dim"), text), soft_wrap=True)
