"""What mkdocs.yml's site holds beside docs/: pages of other files, the API, the notebook with its outputs, players.

mkdocs calls the functions whose names begin with `on_`. Links between files of the repository go on working on the
site: a page that a link leads to is brought along, and a link that leads nowhere is left as it is, so that strict
building fails.
"""

from __future__ import annotations

import ast
import contextlib
import io
import json
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import griffe

ROOT = Path(__file__).parents[1]
ELSEWHERE = {
    "README.md": "index.md",
    "CHANGELOG.md": "changes.md",
    "CONTRIBUTING.md": "contributing.md",
    "magnet/weights/duet/README.md": "card.md",
    "magnet/weights/duet1/README.md": "card1.md",
    "magnet/body/OPEN_BODY.md": "open_body.md",
    "examples/magnet-duel/README.md": "plugin.md",
    "examples/tour.ipynb": "tour.md",
    "examples/own_people.ipynb": "own_people.md",
}
"""Pages of the site that are written somewhere else in the repository."""
FOLDERS = {"examples/magnet-duel": "examples/magnet-duel/README.md"}
UNLISTED = ("open_body.md", "plugin.md", "own_people.md")
"""Pages that others link to and that the navigation leaves out."""
STYLES = {
    # On a phone the theme breaks names anywhere; a table may be wider than the page, and is moved by a finger. The
    # head of a table without one is an empty row.
    "site.css": ".md-typeset td code, .md-typeset th code { word-break: normal; }\n"
    ".md-typeset table:not([class]) th:empty { padding: 0; border: 0; }\n"
}
"""What the theme lacks, as `extra_css` names it."""
FRAMES = 60
"""Frames a scene of the tour has on the site; MAGNET_TOUR_FRAMES=150 gives what the notebook says."""
SCENES = {"duet": "two people, from nothing", "quartet": "four people, from nothing"}
"""Scenes that come with the model, which the start page plays."""
ROOMS = (
    *("api", "motion", "body", "tasks", "sampling", "generation", "metrics", "export", "datamodules", "tokenizer"),
    *("denoiser", "training", "evaluation", "baselines", "synthesis", "viewer", "callbacks", "checkpoints", "testing"),
)
LINK = re.compile(r"(?P<open>\]\(|(?:src|href)=\")(?P<target>[^)\"\s#:]+)(?P<rest>#[^)\"\s]*)?(?P<close>[)\"])")


EXAMPLE = re.compile(r"(?m)^(?P<example>>>> .*(?:\n.+)*)")


class FencedExamples(griffe.Extension):
    """Shows the examples of docstrings as code, which stand there without a heading of their own."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        if obj.docstring is not None and ">>> " in obj.docstring.value:
            obj.docstring.value = EXAMPLE.sub(r"\n```pycon\n\g<example>\n```\n", obj.docstring.value)


def on_config(config: Any) -> Any:
    """List the pages of the API, which are as many as there are rooms, and at the end pages that have no place yet."""
    said = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for entry in config.nav:
        if isinstance(entry, dict) and "Project" in entry:
            entry["Project"] += [p.name for p in sorted((ROOT / "docs").glob("*.md")) if p.name not in said]
        if isinstance(entry, dict) and "API" in entry:
            entry["API"] = ["api/index.md", *(f"api/{room}.md" for room in ROOMS)]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made or come from elsewhere, and the players."""
    from mkdocs.structure.files import File, InclusionLevel

    def add(uri: str, content: str | bytes) -> None:
        listed = InclusionLevel.NOT_IN_NAV if uri in UNLISTED else InclusionLevel.UNDEFINED
        files.append(File.generated(config, uri, content=content, inclusion=listed))

    brought: dict[str, bytes] = {}
    for source, uri in ELSEWHERE.items():
        text = (
            notebook(ROOT / source, brought)
            if source.endswith(".ipynb")
            else (ROOT / source).read_text(encoding="utf-8")
        )
        text = moved(text, source, uri, brought)
        add(uri, text + players(brought) if uri == "index.md" else text)
    for path in sorted((ROOT / "docs").glob("*.md")):
        moved(path.read_text(encoding="utf-8"), f"docs/{path.name}", path.name, brought)  # what its links bring along
    for uri, text in [*reference(), *STYLES.items()]:
        add(uri, text)
    for uri, data in brought.items():
        add(uri, data)
    return files


def on_page_read_source(page: Any, config: Any) -> str | None:
    """Pages of docs/ as they are, with links that lead out of docs/ led back onto the site."""
    source = page.file.abs_src_path
    if source is None or not Path(source).is_relative_to(ROOT / "docs"):
        return None
    name = Path(source).relative_to(ROOT).as_posix()
    return moved(Path(source).read_text(encoding="utf-8"), name, page.file.src_uri, {})


def on_post_build(config: Any) -> None:
    """Refuse a site with pictures and players that are not there: strict building looks at those of Markdown alone."""
    site = Path(config.site_dir)
    missing = {f"{page.relative_to(site)}: {name}" for page in site.rglob("*.html") for name in absent(page)}
    if missing:
        raise FileNotFoundError("\n".join(sorted(missing)))


def absent(page: Path) -> list[str]:
    """Files beside a page of the site that it shows and that are not there."""
    shown = re.findall(r"<(?:img|iframe)\b[^>]*? src=\"([^\":?#]+)\"", page.read_text(encoding="utf-8"))
    return [name for name in shown if not name.startswith("/") and not (page.parent / name).exists()]


def moved(text: str, source: str, uri: str, brought: dict[str, bytes]) -> str:
    """A page's text with its links, as they are written in `source`, as they must be at `uri`.

    Files of the repository that are no pages are brought along.
    """
    from_folder, here = PurePosixPath(source).parent, PurePosixPath(uri).parent
    served = here if PurePosixPath(uri).stem == "index" else PurePosixPath(uri).with_suffix("")

    def link(match: re.Match[str]) -> str:
        place = os.path.normpath(from_folder / match["target"])
        place = FOLDERS.get(place, place)
        if place in ELSEWHERE:
            target = ELSEWHERE[place]
        elif place.startswith("docs/"):
            target = place.removeprefix("docs/")
        elif (ROOT / place).is_file():
            target = f"files/{place}"
            brought[target] = (ROOT / place).read_bytes()
        else:
            return match[0]
        begin = served if match["open"].endswith('"') else here  # mkdocs makes folders of pages, but leaves HTML
        return f"{match['open']}{os.path.relpath(target, begin)}{match['rest'] or ''}{match['close']}"

    lines = text.splitlines(keepends=True)
    return "".join(line if line.startswith("    ") else LINK.sub(link, line) for line in lines)


def players(brought: dict[str, bytes]) -> str:
    """The scenes that come with the model, each in a player, for the end of the start page."""
    import magnet

    parts = ["\n\n## Turn them\n\nMade by the shipped model; drag to turn, scroll to come closer, space to play.\n"]
    for name, words in SCENES.items():
        scene = magnet.read(ROOT / f"magnet/weights/duet/scenes/{name}.npz")
        parts.append(f"\n{words}\n\n{frame(page_of(scene), f'players/{name}.html', 'index.md', brought)}\n")
    return "".join(parts)


def page_of(scene: Any) -> str:
    """The page that plays a scene."""
    with tempfile.TemporaryDirectory() as folder:
        return Path(scene.save(Path(folder) / "scene.html", style="light")).read_text(encoding="utf-8")


def frame(page: str, target: str, uri: str, brought: dict[str, bytes]) -> str:
    """A player inside another page; browsers fetch it when it comes into sight."""
    brought[target] = page.encode()
    away = "../" if uri != "index.md" else ""
    return (
        f'<iframe src="{away}{target}" loading="lazy" title="player" style="width:100%;height:420px;border:0"></iframe>'
    )


def notebook(path: Path, brought: dict[str, bytes]) -> str:
    """A notebook as a page. The tour is run for it and shows its outputs; others need recordings of one's own."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    runs, parts, space = path.stem == "tour", [], {"__name__": "__main__"}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for number, cell in enumerate(cells):
            source = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                parts.append(source)
                continue
            parts.append(f"```python\n{source}\n```")
            if runs:
                parts += outputs(source, space, f"players/{path.stem}_{number}.html", brought)
    return "\n\n".join(parts) + "\n"


def outputs(source: str, space: dict[str, Any], target: str, brought: dict[str, bytes]) -> Iterator[str]:
    """What a cell prints and shows."""
    frames = os.environ.get("MAGNET_TOUR_FRAMES", str(FRAMES))
    tree = ast.parse(re.sub(r"^FRAMES = \d+", f"FRAMES = {frames}", source, flags=re.MULTILINE))
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(tree, target, "exec"), space)
        shown = None if last is None else eval(compile(ast.Expression(last.value), target, "eval"), space)
    if said.getvalue():
        yield f"```text\n{said.getvalue()}```"
    if hasattr(shown, "data") and getattr(shown, "kind", "") == ".html":
        yield frame(shown.data.decode(), target, "tour.md", brought)


def reference() -> Iterator[tuple[str, str]]:
    """A page of the API for each room, with every module that has a public name."""
    intro = ["# API\n\nFrom the docstrings. `magnet.load` and the scenes it gives are all that most need.\n"]
    for room in ROOMS:
        package = ROOT / "magnet" / room
        modules = sorted(package.glob("*.py")) if package.is_dir() else [package.with_suffix(".py")]
        dotted = (".".join(path.relative_to(ROOT).with_suffix("").parts) for path in modules if public(path))
        names = [name.removesuffix(".__init__") for name in dotted]
        first = (ast.get_docstring(ast.parse(modules[0].read_text(encoding="utf-8"))) or "").partition("\n")[0]
        intro.append(f"- [magnet.{room}]({room}.md): {first}")
        yield f"api/{room}.md", f"# magnet.{room}\n\n{first}\n\n" + "\n\n".join(f"::: {name}" for name in names) + "\n"
    yield "api/index.md", "\n".join(intro) + "\n"


def public(path: Path) -> bool:
    """Whether a module defines a class or function that is not private."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    kinds = (ast.ClassDef, ast.FunctionDef)
    return any(isinstance(node, kinds) and not node.name.startswith("_") for node in tree.body)
