"""What `benchmarks/long_horizon.py` refuses before it has generated anything."""

from pathlib import Path

import pytest

from tests.scripts import module_at


def test_scenes_too_short_to_measure_are_refused_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They were generated, and then had no lowest moment of three seconds to draw."""
    pytest.importorskip("matplotlib")
    long_horizon = module_at(Path(__file__).parents[1] / "benchmarks" / "long_horizon.py")
    monkeypatch.setattr("sys.argv", ["long_horizon.py", "--frames", "150"])
    assert long_horizon.options().frames == 150
    monkeypatch.setattr("sys.argv", ["long_horizon.py", "--frames", "149"])
    with pytest.raises(SystemExit):
        long_horizon.options()
    assert "--frames 149: expected 150 or more, the five seconds that each number is of" in capsys.readouterr().err
