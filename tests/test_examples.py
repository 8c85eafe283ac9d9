"""The examples in docstrings do what they show."""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "magnet").rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


def examples_of(module: str) -> list[doctest.DocTest]:
    found = doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(module))
    return [test for test in found if test.examples]


@pytest.mark.parametrize("module", MODULES)
def test_an_example_prints_what_it_shows(module: str) -> None:
    examples = examples_of(module)
    assert examples
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS, verbose=False)
    for example in examples:
        said: list[str] = []
        assert not runner.run(example, out=said.append).failed, "".join(said)


def test_at_least_twenty_public_functions_have_an_example() -> None:
    names = {test.name for module in MODULES for test in examples_of(module)}
    assert len(names) >= 20
    assert not [name for name in names if any(part.startswith("_") for part in name.split("."))]
