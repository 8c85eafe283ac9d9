"""Every configuration of the repository: what it says is what would run; the paper's runs and tables are all there."""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import pkgutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from magnet import checkpoints, cli
from magnet.cli.checkpoint_config import LINKS, OWN_WAY
from magnet.cli.config_files import merged, read_layers
from magnet.datamodules import registry
from magnet.sampling.presets import PRESETS
from tests.cases import few, some_quick
from tests.options import DATA, MODELS, own

ROOT = Path(__file__).parents[1] / "configs"
PAPER = ROOT / "paper"
FILES = sorted(ROOT.rglob("*.yaml"))
QUICK = {"duobox_tokenizer", "duobox_denoiser", "embody3d_denoiser", "sampling", "no_pairwise", "gpu_round"}
QUICK |= {"duet_denoiser", "duet_posterior", "duet_tokenizer"}
"""Of which all is asked by the quick tests; to read one as the command does takes half a second."""
SETS = {"duobox": "DuoBox", "dd100": "DD100", "remocap": "ReMoCap", "interx": "InterX", "embody3d": "Embody3D"}

ROWS: dict[str, dict[str, dict[str, Any] | None]] = {
    "Table 5": {
        "no_vqvae": {"model.init_args.tokenizer": "raw"},
        "no_pairwise": {"model.init_args.network.pairwise": False},
    },
    "Table A.5": {
        "no_agent_encoding": {"model.init_args.network.agent_embedding": False},
        "no_time_encoding": {"model.init_args.network.rope": "none"},
        "no_encodings": {
            "model.init_args.network.agent_embedding": False,
            "model.init_args.network.rope": "none",
        },
    },
    "Table A.6": {
        "independent_noise": {"sampler.noise_sampling": "independent"},
        "joint_noise": {},
    },
    "not a table": {"pairwise_token_noise": {"model.init_args.noise.pairwise": "token"}},
}
"""Rows beside the full model, which is duobox_denoiser.yaml in all tables, and all that they change."""


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


@functools.cache
def written(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def said(path: Path) -> dict[str, Any]:
    """What a file and those it extends say, merged by hand."""
    options = copy.deepcopy(written(path))
    below: dict[str, Any] = {}
    names = options.pop("extends", [])
    for name in [names] if isinstance(names, str) else names:
        below = over(below, said(path.parent / name))
    return over(below, options)


def over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    both = copy.deepcopy(below)
    for key, value in above.items():
        if key == "sampler" and isinstance(value, str):
            value = PRESETS[value]
        both[key] = over(both.get(key) or {}, value) if isinstance(value, dict) else value
    return both


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, part in value.items():
            yield from leaves(part, f"{place}.{key}" if place else key)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for number, part in enumerate(value):
            yield from leaves(part, f"{place}[{number}]")
    else:
        yield place, value


def is_sampling(options: dict[str, Any]) -> bool:
    return "sampler" in options


def quickly(paths: Iterable[Path]) -> list[Any]:
    every = list(paths)
    return some_quick(every, *(path for path in every if path.stem in QUICK))


def is_part(options: dict[str, Any]) -> bool:
    """Whether a file is only there to be extended."""
    return not is_sampling(options) and not ("model" in options and "data" in options)


@functools.cache
def printed(path: Path) -> dict[str, Any]:
    """What would run, with a file as the only argument."""
    command = "test" if is_sampling(said(path)) else "fit"
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert cli.main([command, "--config", str(path), "--print_config"]) == 0
    return yaml.safe_load(out.getvalue())


def resolved(path: Path) -> dict[str, Any]:
    """The same by every field."""
    return dict(leaves(printed(path)))


@pytest.mark.parametrize("path", quickly(p for p in FILES if not is_part(said(p))), ids=relative)
def test_what_a_configuration_says_is_what_would_run(path: Path) -> None:
    run = resolved(path)
    for place, value in leaves(said(path)):
        if place.endswith("class_path"):
            assert run[place].rpartition(".")[2] == value.rpartition(".")[2], place
        else:
            assert run[place] == (float(value) if isinstance(run[place], float) else value), place


def told(path: Path) -> dict[str, Any]:
    """What a file and those it extends say, merged as the command does: another class takes over nothing."""
    return functools.reduce(merged, (layer.options for layer in layers(path)), {})


def taken_over(name: str | None) -> dict[str, Any]:
    """What a configuration that starts from a shipped model has from it."""
    if name not in checkpoints.names():
        return {}
    stored = checkpoints.read(checkpoints.resolve(name))["hyper_parameters"]
    return {key: value for key, value in stored.items() if not key.startswith("_") and key not in OWN_WAY}


@pytest.mark.parametrize(
    "path", quickly(p for p in FILES if not is_part(said(p)) and not is_sampling(said(p))), ids=relative
)
def test_what_a_configuration_does_not_say_is_the_classes_own_default(path: Path) -> None:
    options, got = told(path), printed(path)
    fields, name = options["model"].get("init_args", {}), options["model"]["class_path"]
    kind = MODELS[name] if name in MODELS else pkgutil.resolve_name(name)  # peers have no short names
    model = merged(own(kind), merged(taken_over(fields.get("start_from")), fields))
    assert got["model"]["init_args"] == {key: value for key, value in model.items() if key not in LINKS.values()}

    def whole(spec: dict[str, Any]) -> dict[str, Any]:
        options = merged(own(DATA[spec["class_path"]]), spec.get("init_args", {}))
        return options | ({"data": [whole(part) for part in options["data"]]} if "data" in options else {})

    def plain(options: dict[str, Any]) -> dict[str, Any]:
        parts = options.get("data")
        return options | ({"data": [plain(part["init_args"]) for part in parts]} if parts else {})

    assert plain(got["data"]["init_args"]) == whole(options["data"])


@pytest.mark.parametrize("path", [p for p in FILES if is_part(said(p))], ids=relative)
def test_a_part_belongs_to_a_run(path: Path) -> None:
    users = [other for other in FILES if path in [(ROOT / layer.path).resolve() for layer in layers(other)[:-1]]]
    assert users


@functools.cache
def layers(path: Path) -> list[Any]:
    return read_layers(str(path))


@pytest.mark.parametrize("path", sorted(PAPER.rglob("*.yaml")), ids=relative)
def test_a_configuration_of_the_paper_says_what_it_needs_and_costs(path: Path) -> None:
    head = " ".join(line.lstrip("# ") for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("#"))
    assert "Needs" in head and ("cost" in head.lower() or path.parent.name == "data")
    assert "Table" in head or not path.stem.startswith("table")


# -- the paper's runs ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", some_quick(SETS, "duobox", "embody3d"))
def test_the_papers_five_data_sets_are_trained_as_it_says(name: str) -> None:
    """Paper 3, 4, A.3, A.4 and Table A.2; 64 frames are the released code's."""
    tokenizer, denoiser = (resolved(PAPER / f"{name}_{what}.yaml") for what in ("tokenizer", "denoiser"))
    assert (tokenizer["trainer.max_steps"], denoiser["trainer.max_steps"]) == (100_000, 300_000)
    for run in (tokenizer, denoiser):
        assert run["data.class_path"].endswith(SETS[name])
        assert (run["data.init_args.batch_size"], run["data.init_args.window_frames"]) == (256, 64)
        assert run["data.init_args.augment.mirror"] and run["data.init_args.augment.shuffle"]
        assert run["data.init_args.augment.compose"] == 0
        optimizer = [run[f"model.init_args.optimizer.{name}"] for name in ("learning_rate", "weight_decay")]
        assert optimizer == [2e-4, 1e-4]
        people = 4 if name == "embody3d" else 2
        assert run["data.init_args.max_agents"] == people
        masked = (run["data.init_args.augment.drop"] > 0, run["data.init_args.augment.drop_at_most"])
        assert masked == ((True, 2) if people == 4 else (False, 1))
    sizes = {"network.width": 512, "quantizer.codebook_dim": 512, "quantizer.codebook_size": 1024}
    sizes |= {"quantizer.num_quantizers": 1}
    assert {key: tokenizer[f"model.init_args.{key}"] for key in sizes} == sizes
    sizes = {"width": 512, "layers": 6, "heads": 8, "mlp_ratio": 4, "level_width": 256, "agent_width": 256}
    assert {key: denoiser[f"model.init_args.network.{key}"] for key in sizes} == sizes
    paper = {"rope": "hidden", "agent_embedding": True, "pairwise": True}
    assert {key: denoiser[f"model.init_args.network.{key}"] for key in paper} == paper
    assert denoiser["model.init_args.noise.distribution"] == "per_token"
    assert denoiser["model.init_args.tokenizer"] == f"runs/{name}_tokenizer/latest/checkpoints/best.ckpt"


@pytest.mark.parametrize(("table", "row"), few([(table, row) for table, rows in ROWS.items() for row in rows], 4))
def test_a_row_of_a_table_changes_only_what_it_is_about(table: str, row: str) -> None:
    path = PAPER / "ablations" / f"{row}.yaml"
    base = PAPER / ("sampling.yaml" if table == "Table A.6" else "duobox_denoiser.yaml")
    changed, full = resolved(path), resolved(base)
    differences = {place: value for place, value in changed.items() if value != full.get(place)}
    assert differences == ROWS[table][row]
    assert table in path.read_text() or table == "not a table"


def test_every_ablation_is_a_row_that_is_told_or_one_that_the_report_trains() -> None:
    there, trained = (
        {path.stem for path in (ROOT / folder).glob("*.yaml")} for folder in ("paper/ablations", "report")
    )
    told = {row for rows in ROWS.values() for row in rows}
    assert told <= there <= told | trained


# -- and they run --------------------------------------------------------------------------------

CPU = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")
SMALL_PEER = {"network.width": 16, "network.layers": 1, "network.heads": 2}
TINY = {
    "Tokenizer": {
        "network.width": 8,
        "network.depth": 1,
        "quantizer.codebook_dim": 8,
        "quantizer.codebook_size": 8,
    },
    "Denoiser": {
        "network.width": 16,
        "network.layers": 1,
        "network.heads": 2,
        "network.mlp_ratio": 1,
        "network.level_width": 8,
        "network.agent_width": 8,
    },
}
TINY |= {f"magnet.peers.{peer}": SMALL_PEER for peer in ("ReMoS", "Duolando", "ReadyToReact")}
SMALL = {"batch_size": 2, "epoch_size": 4, "window_frames": 16, "val_batch_size": 2}
FAKES = {"remocap": ("--frames", "40", "--takes", "4"), "duobox": ("--frames", "150", "--takes", "1")}


@functools.cache
def prepared(name: str, folder: Path) -> tuple[str, ...]:
    """Flags for a made-up download of a data set, prepared."""
    download, store = folder / f"{name}_download", folder / name
    words = FAKES.get(name, ("--frames", "80", "--takes", "4"))
    assert cli.main(["data", "fake", name, str(download), *words]) == 0
    fitted = registry.reader(name).family == "positions"
    body = ("--min_frames", "8") if fitted else ("--body", str(download / "body.npz"))
    prepare = ("--root", str(download), "--out", str(store), "--workers", "1", *body)
    assert cli.main(["data", "prepare", name, *prepare]) == 0
    return ("--data.path", str(store), "--data.body_model", "open" if fitted else body[1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("stores")


def two_steps(path: Path, data: tuple[str, ...], out: Path, *more: str) -> Path:
    """Two steps of a configuration at tiny sizes, and its checkpoint."""
    kind = said(path)["model"]["class_path"]
    sizes = {f"model.{key}": value for key, value in TINY[kind].items()}
    sizes |= {f"data.{key}": value for key, value in SMALL.items()}
    flags = [word for key, value in sizes.items() for word in (f"--{key}", str(value))]
    steps = ("--trainer.max_steps", "2", "--trainer.limit_val_batches", "1", "--out", str(out))
    assert cli.main(["fit", "--config", str(path), *flags, *data, *steps, *more, *CPU]) == 0
    return out / "checkpoints" / "last.ckpt"


def tokenizer_of(name: str, folder: Path) -> str:
    out = folder / f"{name}_tokenizer"
    if not out.exists():
        two_steps(PAPER / f"{name}_tokenizer.yaml", prepared(name, folder), out)
    return str(out / "checkpoints" / "last.ckpt")


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_a_data_sets_tokenizer_and_denoiser_train(name: str, folder: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    tokenizer = ("--model.tokenizer", tokenizer_of(name, folder))
    assert two_steps(PAPER / f"{name}_denoiser.yaml", prepared(name, folder), tmp_path / "run", *tokenizer).exists()


@pytest.mark.slow
def test_every_ablation_trains_and_both_ways_of_sampling_sample(folder: Path, tmp_path: Path, monkeypatch) -> None:
    """One test, because all share a store and a tokenizer."""
    monkeypatch.chdir(tmp_path)
    data, tokenizer = prepared("duobox", folder), tokenizer_of("duobox", folder)
    for row in sorted((PAPER / "ablations").glob("*.yaml")):
        if is_sampling(said(row)):
            continue
        raw = said(row)["model"]["init_args"]["tokenizer"] == "raw"
        more = () if raw else ("--model.tokenizer", tokenizer)
        assert two_steps(row, data, tmp_path / row.stem, *more).exists()
    checkpoint = tmp_path / "base" / "checkpoints" / "last.ckpt"
    short = ("--data.test.context_frames", "8", "--data.test.horizon_frames", "8", "--data.test.limit", "2")
    quick = ("--sampler.steps", "3", "--samples", "1", "--baselines", "false", "--ckpt_path", str(checkpoint))
    for row in (PAPER / "ablations" / f"{name}.yaml" for name in ROWS["Table A.6"]):
        out = tmp_path / f"tested_{row.stem}"
        assert cli.main(["test", "--config", str(row), *quick, *short, "--out", str(out), *CPU]) == 0
        assert (out / "results.json").exists()
