"""The project's words: one name for one class, pages that exist, and a glossary of words that the code uses."""

from __future__ import annotations

import ast
import functools
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "magnet").rglob("*.py"))
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text()


def test_no_class_name_exists_twice():
    where: dict[str, list[str]] = defaultdict(list)
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                where[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    twice = {name: places for name, places in where.items() if len(places) > 1}
    assert not twice, f"one word for one thing: {twice}"


@functools.cache
def tokens(path: Path) -> list[tuple[int, str]]:
    """Kind and text of each word of a source file."""
    return [
        (token.type, token.string)
        for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline)
    ]


def texts(path: Path) -> Iterator[str]:
    """Comments and strings of a source file, docstrings among them."""
    return (text for kind, text in tokens(path) if kind in (tokenize.COMMENT, tokenize.STRING))


def test_every_page_that_the_code_names_is_in_the_repository():
    missing = []
    for path in SOURCES:
        for page in re.findall(r"[\w./-]*\w\.md\b", "\n".join(texts(path))):
            near = (ROOT / page, path.parent / page)
            if not any(place.exists() for place in near):
                missing.append(f"{path.relative_to(ROOT)}: {page}")
    assert not missing, missing


def test_every_dotted_name_that_a_docstring_gives_is_there():
    lost = []
    for path in SOURCES:
        for name in re.findall(r"`(magnet(?:\.\w+)+)`", path.read_text()):
            place, last = ROOT.joinpath(*name.split(".")[:-1]), name.rpartition(".")[2]
            modules = (place / f"{last}.py", place / last / "__init__.py")
            inside = [file.read_text() for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()]
            if not any(map(Path.is_file, modules)) and not any(re.search(rf"\b{last}\b", text) for text in inside):
                lost.append(f"{path.relative_to(ROOT)}: {name}")
    assert not lost, lost


def glossary() -> list[tuple[str, str]]:
    """(word, what it is called in the code) of every row of the glossary's tables of three columns."""
    rows = re.findall(r"(?m)^\| ([^|]+) \| ([^|]+) \| [^|]+ \|$", GLOSSARY)
    return [(word, name) for word, names in rows for name in re.findall(r"`(\w+)`", names)]


@functools.cache
def names() -> set[str]:
    """Every name that the package's code uses, and its modules."""
    found = {path.stem for path in SOURCES}
    for path in SOURCES:
        found |= {text for kind, text in tokens(path) if kind == tokenize.NAME}
    return found


def test_every_word_of_the_glossary_is_used_in_the_code():
    entries = glossary()
    assert len(entries) > 40
    unused = [f"{word}: {name}" for word, name in entries if name not in names()]
    assert not unused, unused
