"""An option of a data set within another one is told of by its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnet import cli


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("speeds: [0.9]", "no option data.data[1].init_args.speeds: Synthetic has no speeds"),
        ("val_clips: x", "data.data[1].init_args.val_clips: got x, expected a whole number"),
        ("test: {stride: x}", "data.data[1].init_args.test.stride: got x, expected a whole number"),
    ],
)
def test_a_wrong_option_of_a_data_set_in_a_mixture_is_named_by_its_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: str, said: str
) -> None:
    one, top = (
        "      - class_path: Synthetic\n        init_args: ",
        "data:\n  class_path: Mixed\n  init_args:\n    data:\n",
    )
    file = tmp_path / "mixed.yaml"
    file.write_text(f"{top}{one}{{train_clips: 4}}\n{one}{{train_clips: 4, {wrong}}}\n")
    assert cli.main(["fit", "--config", str(file), "--model", "Tokenizer"]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.splitlines()) == 1
