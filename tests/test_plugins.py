"""Classes of other packages: whatever one of them does when it is loaded, the others are there."""

from __future__ import annotations

import threading
import warnings
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
    registry.discover()
    assert set(registry.known) == {"good"} and registry.failed == [plugins.Failed("Bad", error, "of_Bad:Thing")]
    with pytest.raises(ValueError) as caught:
        registry.require_loaded("bad")
    assert str(caught.value) == f"thing Bad failed to load: {said} (of of_Bad:Thing)"


def test_of_two_of_one_name_that_fail_each_is_told(offered: tuple[plugins.Registry, list[Point]]) -> None:
    registry, points = offered
    points += [Point("bad", raising(ImportError("no shoes"))), Point("bad", raising(OSError("no disk")))]
    points[1].value = "others:Thing"
    registry.discover()
    with pytest.raises(ValueError) as caught:
        registry.require_loaded("bad")
    both = "ImportError: no shoes (of of_bad:Thing); OSError: no disk (of others:Thing)"
    assert str(caught.value) == f"thing bad failed to load: {both}"


def warnings_of(registry: plugins.Registry) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        registry.discover()
    return [str(each.message) for each in caught]


def test_a_class_under_two_names_is_said_to_have_the_first(offered: tuple[plugins.Registry, list[Point]]) -> None:
    registry, points = offered
    points += [Point("first", lambda: int), Point("second", lambda: int)]
    said = "entry point second of some.things (of_second:Thing) names a class that is registered already: use first"
    assert warnings_of(registry) == [said] and set(registry.known) == {"first"}


def test_a_class_that_registers_itself_under_another_name_is_said_to_have_that(
    offered: tuple[plugins.Registry, list[Point]],
) -> None:
    registry, points = offered

    def decorated() -> type:
        registry.add("own", int, "magnet")
        return int

    points.append(Point("other", decorated))
    (said,) = warnings_of(registry)
    assert said.endswith("(of_other:Thing) names a class that is registered already: use own")
    assert registry.known["own"].origin == "of_other:Thing"


@pytest.mark.parametrize("bad_first", [True, False])
def test_one_whose_name_is_taken_is_said_to_be_unused_and_why(
    offered: tuple[plugins.Registry, list[Point]], bad_first: bool
) -> None:
    registry, points = offered
    bad = Point("same", raising(ImportError("no shoes")))
    points += [bad, Point("same", lambda: int)] if bad_first else [Point("same", lambda: int), bad]
    (said,) = warnings_of(registry)
    assert said.startswith("entry point same of some.things (of_same:Thing) is not used, same is of ")
    assert said.endswith(": ImportError: no shoes")


def test_a_taken_name_is_told_with_who_has_it(offered: tuple[plugins.Registry, list[Point]]) -> None:
    registry, points = offered
    registry.add("mine", str, "magnet")
    points += [Point("mine", lambda: int), Point("good", lambda: float)]
    (said,) = warnings_of(registry)
    assert "is not used, mine is of magnet: ValueError: thing name mine is taken by builtins.str" in said


@pytest.mark.parametrize("error", [KeyboardInterrupt(), Stopped(143)])
def test_what_ends_the_process_is_no_failure_of_a_plug_in(
    offered: tuple[plugins.Registry, list[Point]], error: BaseException
) -> None:
    registry, points = offered
    points.append(Point("bad", raising(error)))
    with pytest.raises(type(error)):
        registry.discover()
    points[:] = [Point("good", lambda: int)]
    registry.discover()  # as where a notebook's cell is interrupted and run again
    assert set(registry.known) == {"good"}


def test_a_thread_that_asks_while_another_loads_waits_for_it(offered: tuple[plugins.Registry, list[Point]]) -> None:
    registry, points = offered
    seen: list[set[str]] = []

    def ask() -> None:
        registry.discover()
        seen.append(set(registry.known))

    other = threading.Thread(target=ask)

    def slow() -> type:
        registry.discover()  # a plug-in itself does not wait
        other.start()
        other.join(0.2)
        return int

    points.append(Point("late", slow))
    registry.discover()
    other.join()
    assert seen == [{"late"}]
