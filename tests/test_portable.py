"""What a user of Windows or macOS meets, as far as it can be seen from here."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import magnet

ROOT = Path(magnet.__file__).parents[1]


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a folder, where what only POSIX has is missing and output is in Windows' letters."""
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252", "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    run = [sys.executable, "-W", "ignore", "-m", "tests.without_posix", *words]
    return subprocess.run(run, cwd=folder, env=environment, capture_output=True, encoding="cp1252")


def done(folder: Path, *words: str) -> str:
    """What the command prints where all goes well."""
    ran = command(folder, *words)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_people_from_nothing_are_written_in_files_of_any_kind(tmp_path: Path) -> None:
    outs = ("a.npz", "b.glb", "c.bvh", "d.html", "e.png")
    quick = ("--frames", "8", "--sampler.steps", "2", "--sampler.opening", "0", "--sampler.settle", "off")
    said = done(tmp_path, "doctor", "THEN", "tasks", "THEN", "predict", "--people", "2", *quick, "--out", *outs)
    written = sorted(path.name for path in tmp_path.iterdir())
    assert (
        written == ["a.npz", "b.glb", "c_person0.bvh", "c_person1.bvh", "d.html", "e.png"] and "written: e.png" in said
    )
    assert "magnet predict" in said and "what to do" in said


@pytest.mark.slow
def test_recordings_are_prepared_and_models_trained_and_measured(tmp_path: Path) -> None:
    done(tmp_path, *["data", "fake", "interx", "FAKE"])
    done(tmp_path, *["data", "prepare", "interx", "--root", "FAKE", "--out", "STORE", "--body", "FAKE/body.npz"])
    done(tmp_path, *["data", "check", "STORE"])
    ran = command(tmp_path, "fit", "--config", str(ROOT / "configs" / "debug.yaml"), "--trainer.max_steps", "2")
    assert ran.returncode == 0 and ran.stderr.count("no link") == 1, "said once, and not at every checkpoint"
    few = ("--data.test_clips", "2")
    assert "results.json" in done(tmp_path, "test", "--ckpt_path", "last", "--model", "Tokenizer", *few)
    done(tmp_path, "test", "--task", "joint_future", "--samples", "2", "--sampler.steps", "2", *few)


def test_text_is_utf_8_wherever_it_is_read_or_written() -> None:
    """Which is not what Python does on Windows by itself."""
    for path in (ROOT / "magnet").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            called = node.func.attr if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) else ""
            if called in ("read_text", "write_text"):
                said = any(word.arg == "encoding" for word in node.keywords)
                assert said or (called == "read_text" and node.args), f"{path}:{node.lineno}: no encoding"
