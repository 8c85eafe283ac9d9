"""How the code is laid out: sizes of files and functions, what is written once, what tests may reach for."""

import ast
import functools
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_LINES, MOST_FUNCTION_LINES = 400, 70
FOLDERS = ("magnet", "tests", "examples", "scripts", "benchmarks")


@functools.cache
def parsed(folder: str) -> list[tuple[Path, str, list[ast.AST]]]:
    """Path, text and all nodes of each file of a folder."""
    texts = [(path, path.read_text(encoding="utf-8")) for path in sorted((ROOT / folder).rglob("*.py"))]
    return [(path.relative_to(ROOT), text, list(ast.walk(ast.parse(text)))) for path, text in texts]


def test_no_file_is_longer_than_a_reader_keeps_in_mind() -> None:
    files = [file for folder in FOLDERS for file in parsed(folder)]
    long = {str(path): lines for path, text, _ in files if (lines := text.count("\n")) > MOST_LINES}
    assert not long


def test_no_function_is_longer_than_a_screen() -> None:
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    long = {
        f"{path}:{node.lineno} {node.name}": lines
        for folder in FOLDERS
        for path, _, nodes in parsed(folder)
        for node in nodes
        if isinstance(node, functions) and (lines := node.end_lineno - node.lineno + 1) > MOST_FUNCTION_LINES
    }
    assert not long


def test_what_a_package_offers_is_not_hidden_by_a_module_of_that_name() -> None:
    files = (path.parent for path, _, _ in parsed("magnet") if path.name == "__init__.py")
    packages = [importlib.import_module(".".join(folder.parts)) for folder in files]
    offered = {
        f"{each.__name__}.{name}": getattr(each, name) for each in packages for name in vars(each).get("__all__", ())
    }
    assert not [name for name, value in offered.items() if inspect.ismodule(value)]


def test_the_frame_rate_of_models_is_written_once() -> None:
    written = [
        f"{path}:{default.lineno}"
        for path, _, nodes in parsed("magnet")
        for node in nodes
        for name, default in defaults(node)
        if name in ("fps", "FPS") and isinstance(default, ast.Constant) and default.value == 30
    ]
    assert [place.partition(":")[0] for place in written] == ["magnet/motion/scene.py"]


def test_joints_are_written_by_name() -> None:
    """`magnet.body.joints` has a name for each: no table of joints says 16 for a shoulder."""
    bare = [
        f"{path}:{node.lineno}"
        for path, _, nodes in parsed("magnet")
        for node in nodes
        if isinstance(node, ast.Dict) and len(node.keys) > 4
        if all(isinstance(key, ast.Constant) and isinstance(key.value, int) and key.value < 22 for key in node.keys)
    ]
    assert not bare


def defaults(node: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Names with the values that a function, a class or a module gives them."""
    if isinstance(node, ast.arguments):
        named = [*node.posonlyargs, *node.args]
        yield from ((arg.arg, value) for arg, value in zip(named[::-1], node.defaults[::-1], strict=False))
        yield from ((arg.arg, value) for arg, value in zip(node.kwonlyargs, node.kw_defaults, strict=True) if value)
    elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
        yield node.target.id, node.value
    elif isinstance(node, ast.Assign):
        yield from ((target.id, node.value) for target in node.targets if isinstance(target, ast.Name))


def private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("_")


def defined(nodes: list[ast.AST]) -> set[str]:
    """Names that a file gives to functions, classes, variables and attributes."""
    made = set()
    for node in nodes:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            made.add(node.name)
        elif isinstance(node, (ast.Attribute, ast.Name)) and isinstance(node.ctx, ast.Store):
            made.add(node.attr if isinstance(node, ast.Attribute) else node.id)
    return made


def reached_for(nodes: list[ast.AST]) -> Iterator[tuple[int, str]]:
    """Private names that a file imports, reads of something, or names to `monkeypatch.setattr`, with the line."""
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            words = [*(node.module or "").split("."), *(name.name for name in node.names)]
        elif isinstance(node, ast.Attribute):
            words = [node.attr]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") in ("setattr", "delattr"):
            texts = [word.value for word in node.args if isinstance(word, ast.Constant) and isinstance(word.value, str)]
            words = [part for text in texts for part in text.split(".")]
        else:
            continue
        yield from ((node.lineno, word) for word in words if private(word))


def test_no_test_reaches_for_a_private_name_of_the_package() -> None:
    ours = {name for _, _, nodes in parsed("magnet") for name in defined(nodes) if private(name)}
    found = [
        f"{path}:{line} {name}"
        for path, _, nodes in parsed("tests")
        for own in [defined(nodes)]
        for line, name in reached_for(nodes)
        if name in ours and name not in own
    ]
    assert not found
