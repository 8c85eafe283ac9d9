"""CMU's motion capture: salsa couples and single people, fitted to a body once and kept in a cache."""

from __future__ import annotations

import hashlib
import json
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.utilities import rank_zero_info, rank_zero_warn
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from magnet.body import Body
from magnet.datamodules.base import Clip, MotionDataModule, Split
from magnet.datamodules.reading.asf_amc import read_amc, read_asf
from magnet.datamodules.reading.cmu_fit import Fitted, check_rate, fit_recordings
from magnet.datamodules.reading.cmu_subjects import RATES, USUAL_RATE, couple_of
from magnet.datamodules.registry import register_data
from magnet.datamodules.speeds import at_speed
from magnet.files import writing
from magnet.motion.scene import Scene
from magnet.threads import one_thread

FIT_VERSION = 4
"""Raise it whenever the same recordings would be fitted otherwise: caches are then made anew."""
WHERE = (
    "CMU's recordings come from mocap.cs.cmu.edu: `magnet data download cmu FOLDER` fetches them, or put NN.asf and "
    "NN_TT.amc of couples (60 and 61 dance salsa) and of any single people into one folder yourself; say where with "
    '--data.root or MAGNET_CMU. Published results must say: "The data used in this project was obtained from '
    'mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217."'
)


@dataclass(frozen=True)
class Take:
    """One recording: the files of everybody in it."""

    name: str  # "60_05+61_05", "02_03"
    number: int
    asf: tuple[Path, ...]
    amc: tuple[Path, ...]

    @property
    def couple(self) -> bool:
        return len(self.amc) > 1


@register_data()
class CMU(MotionDataModule):
    """Couples of CMU (60 and 61, who dance salsa, and four others) and single people, as bodies at 30 fps.

    `prepare_data` reads ASF and AMC files, mends or masks capture glitches, fits the body and caches each take.
    A take that cannot be used is reported after all others are done. Splits are by take. Sources of clips, for
    `weights`: "cmu-couples" and "cmu-singles".

    Args:
        root: folder with the files, searched whole; None: the variable MAGNET_CMU.
        cache: folder for fitted takes; None: magnet/cmu in the user's cache folder. Never put it in a repository:
            the recordings may not be passed on, converted or not.
        singles: use recordings of single people as well.
        test_takes: takes of every couple held out for testing, by number.
        val_takes: takes of every couple held out for validation.
        test_singles: single people's recordings held out for testing, by name; they add scenes of one person.
        val_singles: single people's recordings held out for validation.
        fps: frame rate of a subject's recordings by its number, which AMC files do not say; adds to `RATES`, and
            others have 120.
        trim: cut two people's files of unequal length to the shorter instead of refusing them.
        speeds: training recordings are also played at each of these speeds, such as 0.9 and 1.1.
        **kwargs: as for MotionDataModule.

    Raises:
        ValueError: a take is in two splits.
    """

    def __init__(
        self,
        root: str | None = None,
        cache: str | None = None,
        singles: bool = True,
        test_takes: Sequence[int] = (5, 10, 15),
        val_takes: Sequence[int] = (3,),
        test_singles: Sequence[str] = (),
        val_singles: Sequence[str] = ("02_03", "05_12"),
        fps: dict[str, float] | None = None,
        trim: bool = False,
        speeds: Sequence[float] = (),
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        both = sorted({*test_takes} & {*val_takes}) + sorted({*test_singles} & {*val_singles})
        if both:
            raise ValueError(f"takes {both} are in both val and test; each take belongs to one split")
        self.root = root
        self.cache = cache
        self.singles = singles
        self.test_takes, self.val_takes = tuple(test_takes), tuple(val_takes)
        self.test_singles, self.val_singles = tuple(test_singles), tuple(val_singles)
        self.fps = {**RATES, **(fps or {})}
        self.trim = trim
        self.speeds = tuple(speeds)

    # -- Lightning -----------------------------------------------------------------------------

    def prepare_data(self) -> None:
        """Fit what the cache lacks.

        Raises:
            FileNotFoundError: no folder was given or it holds no recordings; says where to get them.
            ValueError: no take at all could be used; says why for each.
        """
        takes, failed = self.takes(), self.fit_takes()
        if failed:
            listed = "".join(f"\n  {name}: {reason}" for name, reason in failed.items())
            if len(failed) == len(takes):
                raise ValueError(f"{self._folder()}: no take could be used:{listed}")
            rank_zero_warn(f"CMU: {len(failed)} of {len(takes)} takes are left out:{listed}")

    def fit_takes(self) -> dict[str, str]:
        """Fit what the cache lacks; seconds a take. Returns why takes cannot be used, by name."""
        takes = self.takes()
        if todo := self._lacking(takes):
            self._convert(todo)
        return {take.name: str(report["error"]) for take in takes if "error" in (report := self.report(take))}

    def clips(self, split: Split) -> list[Clip]:
        """Fitted takes of a split; makes the cache if `prepare_data` has not."""
        takes = self.takes()
        if self._lacking(takes):
            self.prepare_data()
        clips = []
        for take in takes:
            if self.split_of(take) == split and self._file(take).exists():
                source = "cmu-couples" if take.couple else "cmu-singles"
                scene = Scene.load(self._file(take))
                clips.append(Clip(scene, take.name, source, split))
                for speed in self.speeds if split == "train" else ():
                    clips.append(Clip(at_speed(scene, speed), f"{take.name} x{speed:g}", source, split))
        return clips

    # -- files ---------------------------------------------------------------------------------

    def split_of(self, take: Take) -> Split:
        """Which split a take belongs to."""
        test = take.number in self.test_takes if take.couple else take.name in self.test_singles
        val = take.number in self.val_takes if take.couple else take.name in self.val_singles
        return "test" if test else "val" if val else "train"

    def takes(self) -> list[Take]:
        """Every take in the folder; a couple's without the partner's file is listed too, and refused when it is read.

        Raises:
            FileNotFoundError: no folder was given or it holds no recordings; says where to get them.
        """
        folder = self._folder()
        found = {take.name: take for take in found_takes(folder) if take.couple or self.singles}
        if not found:
            raise FileNotFoundError(f"{folder}: holds no files named NN_TT.amc. {WHERE}")
        return [found[label] for label in sorted(found)]

    def _folder(self) -> Path:
        root = self.root or os.environ.get("MAGNET_CMU")
        if not root:
            raise FileNotFoundError(f"no folder of recordings was given. {WHERE}")
        folder = Path(root).expanduser()
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: no such folder. {WHERE}")
        return folder

    @property
    def cache_folder(self) -> Path:
        """Where fitted takes lie."""
        if self.cache:
            return Path(self.cache).expanduser()
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "magnet" / "cmu"

    def _rates(self, take: Take) -> list[float]:
        return [self.fps.get(path.name.split("_")[0], USUAL_RATE) for path in take.amc]

    def _file(self, take: Take) -> Path:
        """Where the fitted take lies: the name holds a hash of all that it was made from."""
        if not hasattr(self, "_keys"):
            self._keys: dict[str, str] = {}
            shape = self.body.J_template.numpy().tobytes() + self.body.J_shapedirs.numpy().tobytes()
            self._body_key = hashlib.sha256(shape).digest()
        if take.name not in self._keys:
            key = hashlib.sha256(self._body_key)
            key.update(repr((FIT_VERSION, self.body.id, self._rates(take), self.trim)).encode())
            for path in (*take.asf, *take.amc):
                key.update(path.read_bytes() if path.is_file() else b"missing")
            self._keys[take.name] = key.hexdigest()[:16]
        return self.cache_folder / f"{take.name}.{self._keys[take.name]}.npz"

    def report(self, take: Take) -> dict[str, Any]:
        """What became of these very files: `report_of`, or an "error"; empty while that is not known."""
        report = self._file(take).with_suffix(".json")
        return json.loads(report.read_text()) if report.exists() else {}

    def _lacking(self, takes: list[Take]) -> list[Take]:
        return [take for take in takes if not (self._file(take).exists() or "error" in self.report(take))]

    # -- fitting -------------------------------------------------------------------------------

    def _convert(self, takes: list[Take]) -> None:
        with writing(self.cache_folder, "give another --data.cache"):
            self.cache_folder.mkdir(parents=True, exist_ok=True)
        rank_zero_info(f"CMU: fitting {len(takes)} takes to body {self.body.id} once, into {self.cache_folder}")
        size = {take.name: sum(path.stat().st_size for path in take.amc if path.is_file()) for take in takes}
        bar = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("left"))
        # The fit's tensors are so small that threads cost more than they give, many times more on a busy machine.
        with one_thread(), Progress(*bar, TimeRemainingColumn()) as progress:
            task, before = progress.add_task("fitting", total=max(sum(size.values()), 1)), 0
            for take in takes:
                progress.update(task, description=f"fitting {take.name}")

                def tell(done: int, total: int, before: int = before, size: int = size[take.name]) -> None:
                    progress.update(task, completed=before + size * done / total)

                self._convert_one(take, tell)
                before += size[take.name]
                progress.update(task, completed=before)

    def _convert_one(self, take: Take, tell: Callable[[int, int], None]) -> None:
        report: dict[str, Any]
        try:
            fitted = fit_take(take, self._rates(take), self.body, self.trim, tell)
        except (ValueError, FileNotFoundError) as error:
            report = {"take": take.name, "error": str(error)}
        else:
            report = {"take": take.name, **report_of(fitted)}
            scene = fitted.fit.scene.replace(names=(take.name,))
            _write(self._file(take), lambda path: scene.save(path))
        text = json.dumps(report, indent=1)
        _write(self._file(take).with_suffix(".json"), lambda path: path.write_text(text))


def found_takes(folder: Path) -> list[Take]:
    """Every take under a folder, of couples and of single people, by name.

    Subjects who were recorded together make one take; where nothing at all of the partner is there, somebody alone.
    """
    files = {path.name.lower(): path for path in sorted(folder.rglob("*")) if path.suffix.lower() in (".asf", ".amc")}
    matches = [match for name in files if (match := re.fullmatch(r"(\d+)_(\d+)\.amc", name))]
    there = {int(match[1]) for match in matches} | {int(name[:-4]) for name in files if re.fullmatch(r"\d+\.asf", name)}
    found: dict[str, Take] = {}
    for match in matches:
        subject, number = match[1], match[2]
        couple = couple_of(subject)
        together = couple is not None and there.issuperset(couple)
        people = tuple(f"{person:02}" for person in couple or ()) if together else (subject,)
        label = "+".join(f"{person}_{number}" for person in people)
        found[label] = Take(
            label,
            int(number),
            tuple(files.get(f"{person}.asf", folder / f"{person}.asf") for person in people),
            tuple(files.get(f"{person}_{number}.amc", folder / f"{person}_{number}.amc") for person in people),
        )
    return [found[label] for label in sorted(found)]


def _write(target: Path, write: Callable[[Path], object]) -> None:
    """All of a file or none of it."""
    with writing(target.parent, "give another --data.cache; then run the same command again, which keeps fitted takes"):
        handle, name = tempfile.mkstemp(prefix=".", suffix=target.suffix, dir=target.parent)
        os.close(handle)
        try:
            write(Path(name))
            os.replace(name, target)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise


def fit_take(
    take: Take, fps: Sequence[float], body: Body, trim: bool = False, tell: Callable[[int, int], None] | None = None
) -> Fitted:
    """Read a take's files and fit the body.

    Raises:
        FileNotFoundError: a file is missing, such as a partner's.
        ValueError: a file is damaged, lengths differ, the frame rate is implausible or the body does not fit.
    """
    recordings = []
    for asf, amc, rate in zip(take.asf, take.amc, fps, strict=True):
        if not amc.is_file() and take.couple:
            raise FileNotFoundError(f"{amc.name} is missing: take {take.name} needs both partners' files")
        recordings.append(read_amc(amc, read_asf(asf), rate))
    for recording in recordings:
        check_rate(recording)
    return fit_recordings(recordings, body, trim=trim, progress=tell)


def report_of(fitted: Fitted) -> dict[str, Any]:
    """What the json beside a cached take says; lengths in centimetres."""
    scene = fitted.fit.scene
    assert scene.valid is not None

    def cm(metres: float) -> float | None:
        return None if np.isnan(metres) else round(100 * metres, 2)

    def percent(share: float) -> float | None:
        return None if np.isnan(share) else round(100 * share, 1)

    return {
        "frames": scene.frames,
        "frames masked": int((~scene.valid).sum()),
        "limb error cm": cm(fitted.limb_error),
        "wrist error cm": cm(fitted.wrist_error),
        "nearest wrists recorded cm": cm(fitted.wrist_recorded),
        "nearest wrists fitted cm": cm(fitted.wrist_fitted),
        "wrists under 20 cm recorded %": percent(fitted.held_recorded),
        "wrists under 20 cm fitted %": percent(fitted.held_fitted),
        "floor cm": cm(fitted.floor),
        "largest shape number": round(float(scene.betas.abs().max()), 2),
        "glitches": [
            {
                "jumps": glitch.jumps,
                "jumps of modelled joints": glitch.body_jumps,
                "frames interpolated": int(glitch.repaired.sum()),
                "frames masked": int(glitch.masked.sum()),
            }
            for glitch in fitted.glitches
        ],
    }
