"""What a released model says of its weights: data, the weights they started from, licence, body and runs."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path, PureWindowsPath
from typing import Any

from magnet import datamodules
from magnet.body import load_body
from magnet.cli.errors import CommandError
from magnet.training import origins

RECORDINGS = Path(datamodules.__file__).with_name("cmu.sha256")
HELD_OUT = ("03", "05", "10", "15")
SUBJECTS = ("02", "05", "17", "18", "55", "60", "61", "90", "131", "135", "143")
COUPLE, SINGLES, SYNTHETIC = (
    "CMU motion capture, salsa couple (60, 61)",
    "CMU motion capture, single people",
    "synthetic scenes",
)
TRAINED_ON = {
    COUPLE: "takes 01 02 06 07 08 09 11; 05 10 15 held out, 03 for validation",
    SINGLES: "subjects 02 05 17 18 55 90 131 135 143, without 02_03, 05_12 and 135_08",
    SYNTHETIC: "magnet.datamodules.synthetic, training seeds",
}
"""What configs/duet_*.yaml train on."""
LICENCE = "Apache-2.0"
"""Of weights that nothing else went into."""
ACKNOWLEDGEMENT = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. "
    "The database was created with funding from NSF EIA-0196217."
)
SHOWN = 3
"""So many of the weights that a model started from are told in words, whatever they are."""


def about(
    checkpoint: dict[str, Any], path: Path, trained_on: str | None, licence: str | None, decoder: Path | None = None
) -> dict[str, Any]:
    """The record of a denoiser's checkpoint, and of the tokenizer's whose decoder it has taken.

    trained_on, licence: what the user says of data and weights
    """
    own, before = origins.data_of(checkpoint), origins.started_from(checkpoint)
    if decoder is not None:
        first, *others = origins.sources(decoder)
        before = origins.distinct([*before, first | {"part": "decoder"}, *others])
    known, all_known = ours(own), ours(own) and all(map(ours_of, before))
    require_said(known, all_known, trained_on, licence)
    everything = [own, *(each.get("data") or [] for each in before)]
    mine = in_our_words(*everything) if all_known else in_our_words(own)
    record: dict[str, Any] = {"trained on": trained_on or mine}
    if not trained_on and {COUPLE, SINGLES} & mine.keys():
        record["recordings"] = manifest(SINGLES in mine)
    if before:
        record[origins.STARTED] = [passed_on(each) for each in before]
    owed = [ACKNOWLEDGEMENT] if any(map(cmu, everything)) else []
    owed += [each["acknowledgement"] for each in before if each.get("acknowledgement")]
    if owed:
        record["acknowledgement"] = " ".join(dict.fromkeys(owed))
    record |= {"licence": licence or LICENCE, "body": body_of(checkpoint)}
    return record | run_of("run", path) | (run_of("decoder run", decoder) if decoder else {})


def require_said(known: bool, all_known: bool, trained_on: str | None, licence: str | None) -> None:
    """Raises CommandError where the user must say more than is known."""
    lacking = [] if known or trained_on else ["--trained_on 'WHAT'"]
    lacking += [] if all_known or licence else ["--licence 'WHICH'"]
    if lacking:
        what = "were trained on" if not known else "started from weights that were trained on"
        raise CommandError(f"these weights {what} other data than configs/duet_*.yaml: say {' and '.join(lacking)}")


def ours(data: Any) -> bool:
    """Whether a data configuration holds only data sets of configs/duet_*.yaml, with their held-out takes."""
    if isinstance(data, list):
        return bool(data) and all(map(ours, data))
    if not isinstance(data, dict) or "class_path" not in data:
        return False
    package, name = str(data["class_path"]).partition(".")[0], str(data["class_path"]).rpartition(".")[2]
    if package not in (name, "magnet"):  # a data set of another package may have the name of one of ours
        return False
    said = data.get("init_args") or {}
    if name == "CMU":
        takes = {f"{take:02d}" for key in ("test_takes", "val_takes") for take in said.get(key, ())}
        return takes == set(HELD_OUT) and not said.get("path")
    return name == "Synthetic" or (name in ("Mixed", "Reshaped", "SoloPairs") and ours(said.get("data")))


def ours_of(source: dict[str, Any]) -> bool:
    """Whether weights that others started from are ours: a model of the package, or trained on our data alone."""
    said = source.get("trained on")
    shipped = isinstance(said, dict) and said.keys() <= TRAINED_ON.keys() and source.get("licence") == LICENCE
    return shipped or ours(source.get("data"))


def parts_of(data: Any) -> set[str]:
    """Which parts of `TRAINED_ON` a data configuration that is `ours` holds; of any other none."""
    if isinstance(data, list):
        return {part for each in data for part in parts_of(each)}
    if not ours(data):
        return set()
    name, said = data["class_path"].rpartition(".")[2], data.get("init_args") or {}
    if name == "CMU":
        return {COUPLE, SINGLES} if said.get("singles", True) else {COUPLE}
    return {SYNTHETIC} if name == "Synthetic" else parts_of(said["data"])


def in_our_words(*data: Any) -> dict[str, str]:
    """The parts of `TRAINED_ON` that data configurations hold, with what is held out."""
    parts = set().union(*map(parts_of, data))
    return {part: takes for part, takes in TRAINED_ON.items() if part in parts}


def cmu(data: Any) -> bool:
    """Whether a data configuration holds CMU's recordings, whichever takes of them, also in a prepared store."""
    if isinstance(data, dict):
        own = str(data.get("class_path")).rpartition(".")[2] == "CMU" or data.get("store") == "cmu"
        return own or any(map(cmu, data.values()))
    return isinstance(data, list) and any(map(cmu, data))


def passed_on(source: dict[str, Any]) -> dict[str, Any]:
    """What a released model says of weights that it started from."""
    said = {key: value for key, value in source.items() if key != "data"} | {"name": without_folders(source["name"])}
    data = source.get("data") or []
    if ours(data):
        said |= {"trained on": in_our_words(data)}
    elif data:
        said |= {"data": without_folders(data)}
    elif "trained on" not in said:
        said |= {"trained on": origins.UNKNOWN}
    return said


def body_of(checkpoint: dict[str, Any]) -> str:
    """The id of the body that a model was trained with, where its checkpoint tells."""
    if (body := origins.body_of(checkpoint)) is not None:
        return body
    models = {(each.get("init_args") or {}).get("body_model") for each in origins.data_of(checkpoint)}
    return load_body().id if models == {"open"} else origins.UNKNOWN


def manifest(singles: bool = True) -> dict[str, str]:
    """Files of recordings, and their sha256, of the takes that were trained on; of the couple alone without singles."""
    held = (
        {f"60_{take}.amc" for take in HELD_OUT}
        | {f"61_{take}.amc" for take in HELD_OUT}
        | {"02_03.amc", "05_12.amc", "135_08.amc"}
    )
    subjects = SUBJECTS if singles else ("60", "61")
    lines = (line.split() for line in RECORDINGS.read_text(encoding="utf-8").splitlines())
    return {name: digest for digest, name in lines if name not in held and re.split(r"[._]", name)[0] in subjects}


def run_of(key: str, checkpoint: Path) -> dict[str, Any]:
    """How a checkpoint came about, where its run's record still lies beside it."""
    record = checkpoint.resolve().parent.parent / "run.json"
    return {key: without_folders(json.loads(record.read_text(encoding="utf-8")))} if record.exists() else {}


PLACE = r"(?:file:/|/(?=\S)|\\\\|\.\.[\\/]|~[\w.-]*/|[A-Za-z]:[\\/])"
"""How the name of a place on some machine begins."""
INSIDE = rf"(?:(?<=[\"'`\[({{<, =;|])|(?<=:)(?!//)){PLACE}[^\"'`,\])}}>;|]*"
"""A place within a word, such as in a list or in brackets; of an address (https://) no part is one."""
QUOTED = r"(?:\"[^\"]*\"|'[^']*'|\S)+"
"""A word of a text; what is quoted holds together."""


def without_folders(value: Any) -> Any:
    """The same record with files by their names alone: where they lay on some machine is nobody's business."""
    if isinstance(value, dict):
        return {key: without_folders(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [without_folders(one) for one in value]
    if not isinstance(value, str):
        return value
    if re.match(PLACE, value):
        return name_alone(value)
    try:
        words = shlex.split(value) if value.startswith("magnet ") else None
    except ValueError:  # no command, for all its first word
        words = None
    return re.sub(QUOTED, lambda word: _word(word[0]), value) if words is None else shlex.join(map(_word, words))


def _word(word: str) -> str:
    """A word of a command or of a text, without folders: it is a path, an option with one, or holds some in a list."""
    option = re.match(r"--?[\w.+-]+=", word)
    if option:
        return option[0] + str(without_folders(word[option.end() :]))
    if re.match(PLACE, word):
        return name_alone(word)
    return re.sub(INSIDE, lambda found: name_alone(found[0]), word)


def name_alone(path: str) -> str:
    """The last part of a path of any system."""
    return PureWindowsPath(path).name or path


def summary(record: dict[str, Any]) -> str:
    """The record in a few lines."""
    lines = [f"  trained on: {in_words(record['trained on'])}"]
    lines += [f"  started from: {said}" for said in sources_in_words(record)]
    lines += [f"  {key}: {record[key]}" for key in ("acknowledgement", "licence", "body") if key in record]
    return "\n".join(lines)


def in_words(trained_on: Any) -> str:
    return "; ".join(trained_on) if isinstance(trained_on, dict) else str(trained_on)


def sources_in_words(record: dict[str, Any]) -> list[str]:
    """Lines about the weights that a model started from: the nearest, and all with a licence of their own."""
    every = record.get(origins.STARTED, [])
    shown = [each for number, each in enumerate(every) if number < SHOWN or "licence" in each]
    more = len(every) - len(shown)
    return [*map(in_words_of, shown), *([f"{more} more, behind these; config.json lists all"] if more else [])]


def in_words_of(source: dict[str, Any]) -> str:
    """Weights that others started from, in a line."""
    digest = f" (sha256 {source['sha256'][:12]})" if "sha256" in source else ""
    data = in_words(source["trained on"]) if "trained on" in source else "the data in config.json"
    part = "; its decoder alone" if source.get("part") == "decoder" else ""
    licence = f"; licence {source['licence']}" if "licence" in source else ""
    return f"{source['name']}{digest}, trained on: {data}{part}{licence}"


def same_card(folder: Path) -> bool:
    """Whether a released folder's README.md is what `card` says of it, so that nobody has written another."""
    try:
        record = json.loads((folder / "config.json").read_bytes())["about"]
        size = sum(part.stat().st_size for part in folder.glob("*.safetensors"))
        return (folder / "README.md").read_text(encoding="utf-8") == card(folder.resolve().name, record, size)
    except (OSError, ValueError, KeyError, TypeError):  # another card, or the record of another program
        return False


def card(name: str, record: dict[str, Any], size: int) -> str:
    """README.md of a released model, for whoever it is passed on to; its maker may write a better one."""
    rows = [("trained on", in_words(record["trained on"]))]
    rows += [("started from", said) for said in sources_in_words(record)]
    rows += [("body", record["body"]), ("licence", record["licence"]), ("files", f"safetensors, {size / 1e6:.1f} MB")]
    table = [f"| {key} | {' '.join(text.split()).replace('|', '/')} |" for key, text in rows]
    lines = [
        f"# {name}",
        "",
        "A model of motion of several people together, for the Python package `magnet-motion`.",
        "",
        "    magnet predict --ckpt_path FOLDER --people 2 --out scene.html",
        "",
        "| | |",
        "|---|---|",
        *table,
    ]
    lines += ["", record["acknowledgement"]] if "acknowledgement" in record else []
    return "\n".join(lines) + "\n"
