"""Classes of other packages: whatever one of them does when it is loaded, the others are there."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from magnet import plugins
from magnet.errors import Stopped


class Point:
    """What importlib.metadata gives for an entry point."""

    dist = None

    def __init__(self, name: str, load: Callable[[], type]) -> None:
        self.name, self.load, self.value = name, load, f"of_{name}:Thing"


def raising(error: BaseException) -> Callable[[], type]:
    def load() -> type:
        raise error

    return load


@pytest.fixture
def offered(monkeypatch: pytest.MonkeyPatch) -> tuple[plugins.Registry, list[Point]]:
    """A registry, and the entry points that it finds."""
    points: list[Point] = []
    monkeypatch.setattr(plugins, "entry_points", lambda group: points)
    return plugins.Registry("thing", "some.things", (), lambda name, kind: None), points


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ImportError("no module\n named shoes"), "ImportError: no module named shoes"),
        (SystemExit("bye"), "SystemExit: bye"),
        (SystemExit(), "SystemExit"),
        (GeneratorExit("odd"), "GeneratorExit: odd"),
    ],
)
def test_one_that_fails_is_left_out_with_its_reason(
    offered: tuple[plugins.Registry, list[Point]], error: BaseException, said: str
) -> None:
    registry, points = offered
    points += [Point("Bad", raising(error)), Point("good", lambda: int)]
    assert registry.discover()
    assert set(registry.known) == {"good"} and registry.failed == {"Bad": error}
    assert registry.failed_of == {"Bad": "of_Bad:Thing"}
    with pytest.raises(ValueError) as caught:
        registry.require_loaded("bad")
    assert str(caught.value) == f"thing Bad failed to load: {said}"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), Stopped(143)])
def test_what_ends_the_process_is_no_failure_of_a_plug_in(
    offered: tuple[plugins.Registry, list[Point]], error: BaseException
) -> None:
    registry, points = offered
    points.append(Point("bad", raising(error)))
    with pytest.raises(type(error)):
        registry.discover()
