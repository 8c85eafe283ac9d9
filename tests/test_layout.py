"""How the code is laid out: sizes of files and functions."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_LINES, MOST_FUNCTION_LINES = 400, 70


def parsed(folder: str) -> Iterator[tuple[Path, str, ast.Module]]:
    for path in sorted((ROOT / folder).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        yield path.relative_to(ROOT), text, ast.parse(text)


def test_no_file_is_longer_than_a_reader_keeps_in_mind() -> None:
    long = {str(path): lines for path, text, _ in parsed("magnet") if (lines := text.count("\n")) > MOST_LINES}
    assert not long


def test_no_function_is_longer_than_a_screen() -> None:
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    long = {
        f"{path}:{node.lineno} {node.name}": lines
        for path, _, tree in parsed("magnet")
        for node in ast.walk(tree)
        if isinstance(node, functions) and (lines := node.end_lineno - node.lineno + 1) > MOST_FUNCTION_LINES
    }
    assert not long
