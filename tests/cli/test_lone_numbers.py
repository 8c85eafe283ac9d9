"""One whole number where an option takes a list of them."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from magnet.cli.errors import CommandError
from magnet.cli.lone_numbers import in_lists
from magnet.cli.main import main
from magnet.cli.tasks import parse_task
from magnet.tasks import registry as tasks


def config(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    """What a run would be given."""
    assert main([*words, "--print_config"]) == 0
    return yaml.safe_load(capsys.readouterr().out)


@pytest.mark.parametrize("one", [["--task.target", "1"], ["--task.target=1"], ["--task.init_args.target", "1"]])
def test_one_number_of_a_task_is_a_list_of_it(one: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    found = config(capsys, "test", "--task", "partner_prediction", *one)
    assert found["task"] == config(capsys, "test", "--task", "partner_prediction", "--task.target", "[1]")["task"]
    assert found["task"]["target"] == [1]


@pytest.mark.parametrize("one", [["--data.people", "2"], ["--data.people=2"], ["--data.init_args.people", "2"]])
def test_one_number_of_a_data_set_is_a_list_of_it_also_where_none_is_named(
    one: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    for named in ([], ["--data", "Synthetic"]):
        found = config(capsys, "test", *named, *one, "--data.batch_size", "3")["data"]["init_args"]
        assert (found["people"], found["batch_size"]) == ([2], 3)


def test_every_task_and_its_every_list_of_whole_numbers_take_one() -> None:
    listing = {
        (entry.name, name): value
        for entry in tasks.entries()
        for name, value in vars(entry.kind).items()
        if not name.startswith("_") and entry.kind.__annotations__.get(name) == "tuple[int, ...]"
    }
    assert {name for _, name in listing} >= {"target", "order", "keys", "agents"}
    for task, name in listing:
        assert list(parse_task(task, [f"--task.{name}", "3"]).fields[name]) == [3]


def test_what_is_no_lone_number_or_no_list_of_them_stays_as_it_is() -> None:
    flags = ["--task.target", "x", "--task.pairs", "1", "--task.every", "4", "1", "--task.target=1,2"]
    assert in_lists(flags, {"--task.target"}.__contains__) == flags
    assert in_lists(["--task.target", "-1"], {"--task.target"}.__contains__) == ["--task.target", "[-1]"]
    for words in (["--task.target", "x"], ["--task.target", "1.5"]):
        with pytest.raises(CommandError, match=r"--task\.target: got .*, expected a list such as \[0,1\]"):
            parse_task("partner_prediction", words)
