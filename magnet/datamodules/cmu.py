"""CMU's motion capture: salsa couples and single people, fitted to a body once and kept in a cache, or prepared."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from lightning.pytorch.utilities import rank_zero_warn

from magnet.datamodules.base import Clip, MotionDataModule, Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.preparing.fit_cache import FitCache, Steps, cache_folder, fit_whole
from magnet.datamodules.reading.asf_amc import read_amc, read_asf
from magnet.datamodules.reading.cmu_joints import Glitches, check_rate, measured
from magnet.datamodules.reading.cmu_subjects import RATES, USUAL_RATE, couple_of
from magnet.datamodules.reading.fields import files_under, listing
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.registry import register_data
from magnet.datamodules.store.memory import MemoryStore
from magnet.datamodules.store.reader import StoreSplit
from magnet.motion.resample import at_speed
from magnet.motion.scene import Scene

FIT_VERSION = 4
"""Raise it when the same recordings would be fitted differently: caches are then made anew."""
WHERE = (
    "CMU's recordings come from http://mocap.cs.cmu.edu: `magnet data download cmu FOLDER` fetches them, or put NN.asf "
    "and NN_TT.amc of couples (60 and 61 dance salsa) and of any single people into one folder yourself; say where "
    "with --data.root (magnet score: --root) or MAGNET_CMU. Published results must say: "
    '"The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF '
    'EIA-0196217."'
)
TEST_TAKES, VAL_TAKES = (5, 10, 15), (3,)
VAL_SINGLES = ("02_03", "05_12")


class CMUReader(Reader):
    """NN.asf and NN_TT.amc anywhere in a folder; subjects who were recorded together form one take.

    A subject of a couple is read alone if the folder holds no file of the partner. Capture glitches are interpolated
    or masked.

    Args:
        root: folder with the files, searched whole.
        singles: use recordings of single people as well.
        test_takes: takes of every couple held out for testing, by number.
        val_takes: takes of every couple held out for validation.
        test_singles: single people's recordings held out for testing, by name.
        val_singles: single people's recordings held out for validation.
        fps: frame rate of a subject's recordings by its number, which AMC files do not say; adds to `RATES`, and
            others have 120.
        trim: cut two people's files of unequal length to the shorter instead of refusing them.

    Raises:
        DataError: no such folder, or one without recordings; says where to get them.
        ValueError: a take is in two splits.
    """

    name = "cmu"
    title = "CMU Graphics Lab Motion Capture Database"
    source = "http://mocap.cs.cmu.edu"
    licence = "free for research and products; not to be sold or passed on, converted or not"
    fake = "magnet.datamodules.fakes.cmu"
    family = "positions"
    layout = (
        ("NN.asf", "a subject's skeleton, such as 60.asf, in any folder"),
        ("NN_NN.amc", "a subject's take, such as 60_05.amc; of couples both"),
    )

    def __init__(
        self,
        root: str | Path,
        singles: bool = True,
        test_takes: Sequence[int] = TEST_TAKES,
        val_takes: Sequence[int] = VAL_TAKES,
        test_singles: Sequence[str] = (),
        val_singles: Sequence[str] = VAL_SINGLES,
        fps: dict[str, float] | None = None,
        trim: bool = False,
    ) -> None:
        both = sorted({*test_takes} & {*val_takes}) + sorted({*test_singles} & {*val_singles})
        if both:
            raise ValueError(f"takes {both} are in both val and test; each take belongs to one split")
        self.root = Path(root).expanduser()
        if not self.root.is_dir():
            raise DataError(f"{self.root}: no such folder. {WHERE}")
        self.singles = singles
        self.couples_in: dict[int, Split] = {**dict.fromkeys(test_takes, "test"), **dict.fromkeys(val_takes, "val")}
        self.singles_in: dict[str, Split] = {**dict.fromkeys(test_singles, "test"), **dict.fromkeys(val_singles, "val")}
        self.trim = trim
        self.fps: dict[int, float] = dict(RATES)
        for subject, rate in (fps or {}).items():
            if not re.fullmatch(r"\d+", str(subject)):
                raise ValueError(f"fps: got subject {subject!r}, expected a number such as 60")
            self.fps[int(subject)] = rate

    def found(self) -> list[Take]:
        """Every take; one that lacks the partner's file is listed too, and refused when it is read."""
        everything = self._all()
        takes = [take for take in everything if self.singles or is_couple(take)]
        if not takes:
            raise DataError(f"{self.root}: holds no files named NN_TT.amc, but {listing(self.root)}: no takes. {WHERE}")
        self._require_known(everything)
        return takes

    def _require_known(self, takes: Sequence[Take]) -> None:
        """Refuse options about what is not there: a mistyped take that is to be held out would be trained on."""
        alone = [take.name for take in takes if not is_couple(take)]
        numbers = sorted({int(take.name.rpartition("_")[2]) for take in takes if is_couple(take)})
        subjects = sorted({int(path.name.split("_")[0]) for take in takes for path in amc_files(take)})
        for option, said, usual, there in (
            ("test_takes, val_takes", self.couples_in, {*TEST_TAKES, *VAL_TAKES}, numbers),
            ("test_singles, val_singles", self.singles_in, {*VAL_SINGLES}, alone),
            ("fps", self.fps, {*RATES}, subjects),
        ):
            unknown = [one for one in said if one not in usual and one not in there]
            if unknown:
                some = ", ".join(map(str, there[:8])) + (", ..." if len(there) > 8 else "")
                raise DataError(f"{option}: got {unknown[0]}; give one of those in {self.root}: {some or 'none'}")

    def _files(self) -> dict[str, Path]:
        """Skeletons and takes by name in lower case."""
        files: dict[str, Path] = {}
        for path in sorted(files_under(self.root)):
            if path.suffix.lower() not in (".asf", ".amc"):
                continue
            other = files.setdefault(path.name.lower(), path)
            if other != path and other.read_bytes() != path.read_bytes():
                raise DataError(f"{other} and {path} have one name and differ; move one elsewhere")
        return files

    def _all(self) -> list[Take]:
        files = self._files()
        matches = [match for name in files if (match := re.fullmatch(r"(\d+)_(\d+)\.amc", name))]
        there = {int(match[1]) for match in matches}
        there |= {int(name[:-4]) for name in files if re.fullmatch(r"\d+\.asf", name)}
        found: dict[str, Take] = {}
        for match in matches:
            subject, number = match[1], match[2]
            couple = couple_of(subject)
            together = couple is not None and there.issuperset(couple)
            people = tuple(f"{person:02}" for person in couple or ()) if together else (subject,)
            name = "+".join(f"{person}_{number}" for person in people)
            names = [f"{person}.asf" for person in people] + [f"{person}_{number}.amc" for person in people]
            paths = tuple(files.get(file, self.root / file) for file in names)
            split = self.couples_in.get(int(number)) if together else self.singles_in.get(name)
            found[name] = Take(name, paths, split or "train", name)
        return [found[name] for name in sorted(found)]

    def rates(self, take: Take) -> list[float]:
        """Frames a second of each person's file."""
        return [self.fps.get(int(path.name.split("_")[0]), USUAL_RATE) for path in amc_files(take)]

    def read(self, take: Take) -> Recording:
        """Joints of everybody at 30 fps, y up, with rotations as hints for the fit."""
        return self.measured(take)[0]

    def measured(self, take: Take) -> tuple[Recording, tuple[Glitches, ...]]:
        """The recording, and the glitches that were repaired in it.

        Raises:
            DataError: a file is missing or damaged, lengths differ, or the frame rate is implausible.
        """
        recordings = []
        for asf, amc, rate in zip(take.files, amc_files(take), self.rates(take), strict=False):
            if not amc.is_file() and is_couple(take):
                raise DataError(
                    f"{amc.name} is missing: take {take.name} needs both partners' files; download it again"
                )
            try:
                recordings.append(read_amc(amc, read_asf(asf), rate))
            except OSError as error:
                raise DataError(f"{error}; take {take.name} needs it: download it again") from error
        for recording in recordings:
            check_rate(recording)
        return measured(recordings, trim=self.trim)


def is_couple(take: Take) -> bool:
    """Whether two people are in a take."""
    return len(take.files) > 2


def amc_files(take: Take) -> tuple[Path, ...]:
    """The motion files of a take, which come after the skeletons."""
    return take.files[len(take.files) // 2 :]


@register_data()
class CMU(Prepared):
    """Couples of CMU (60 and 61, who dance salsa, and four others) and single people, as bodies at 30 fps.

    Recordings need no `magnet data prepare`: `prepare_data` fits the body to each take of `root` once, at full
    precision and with glitches masked, and caches the result. Takes that cannot be used are reported when all others
    are done. Splits are by take. Sources of clips, for `weights`: "cmu-couples" and "cmu-singles". With `path`, it
    trains on a prepared store like any other data set.

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
        speeds: also train on the recordings played at these speeds, such as 0.9 and 1.1; not available for a store.
        path: a store of `magnet data prepare cmu`, in place of recordings.
        device_resident: keep all frames on the trainer's device.
        **kwargs: as for Prepared.

    Raises:
        ValueError: a take is in two splits, or a store is given beside what is for recordings.
    """

    reader = CMUReader

    def __init__(
        self,
        root: str | None = None,
        cache: str | None = None,
        singles: bool = True,
        test_takes: Sequence[int] = TEST_TAKES,
        val_takes: Sequence[int] = VAL_TAKES,
        test_singles: Sequence[str] = (),
        val_singles: Sequence[str] = VAL_SINGLES,
        fps: dict[str, float] | None = None,
        trim: bool = False,
        speeds: Sequence[float] = (),
        path: str = "",
        device_resident: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(path=path, device_resident=device_resident, **kwargs)
        self.root, self.cache, self.speeds = root, cache, tuple(speeds)
        self.read_options: Mapping[str, Any] = {
            "singles": singles,
            "test_takes": test_takes,
            "val_takes": val_takes,
            "test_singles": test_singles,
            "val_singles": val_singles,
            "fps": fps,
            "trim": trim,
        }
        said = {"root": root, "cache": cache, "speeds": speeds, **self.read_options}
        plain = inspect.signature(CMU.__init__).parameters
        also = [name for name, value in said.items() if _tuple(value) != _tuple(plain[name].default)]
        if path and also:
            raise ValueError(
                f"path: got the store {path} beside {also[0]}, which is for recordings: leave it out; what a store "
                "holds is chosen when it is made, magnet data prepare cmu --help"
            )

    # -- recordings ----------------------------------------------------------------------------

    @cached_property
    def recordings(self) -> CMUReader:
        """The reader of the folder.

        Raises:
            DataError: no folder was given or it holds no recordings; says where to get them.
        """
        root = self.root or os.environ.get("MAGNET_CMU")
        if not root:
            raise DataError(f"no folder of recordings was given. {WHERE}")
        return CMUReader(root, **self.read_options)

    @cached_property
    def fits(self) -> FitCache:
        """Fitted takes, and a report of each."""
        reader = self.recordings

        def fit(take: Take, progress: Steps) -> tuple[Scene, dict[str, Any]]:
            return fit_whole(*reader.measured(take), self.body, progress)

        def facts(take: Take) -> tuple[Any, ...]:
            return FIT_VERSION, self.body.id, reader.rates(take), reader.trim

        return FitCache(cache_folder(self.cache, "cmu"), self.body, facts, fit)

    def prepare_data(self) -> None:
        """Fit takes that are not in the cache; for a store, check that it exists and belongs to this body.

        Raises:
            DataError: no folder was given or it holds no recordings, or no take at all could be used.
        """
        if self.path:
            super().prepare_data()
            return
        takes = self.recordings.found()
        if failed := self.fits.fill("CMU", takes):
            listed = "".join(f"\n  {name}: {reason}" for name, reason in failed.items())
            if len(failed) == len(takes):
                raise DataError(f"{self.recordings.root}: no take could be used:{listed}")
            rank_zero_warn(f"CMU: {len(failed)} of {len(takes)} takes are left out:{listed}")

    def clips(self, split: Split) -> list[Clip]:
        """Clips of a split; makes the cache if `prepare_data` has not."""
        if self.path:
            return super().clips(split)
        takes = self.recordings.found()
        if self.fits.lacking(takes):
            self.prepare_data()
        clips = []
        for take in takes:
            scene = self.fits.scene(take) if take.split == split else None
            if scene is not None:
                source = "cmu-couples" if is_couple(take) else "cmu-singles"
                clips.append(Clip(scene, take.name, source, split))
                for speed in self.speeds if split == "train" else ():
                    clips.append(Clip(at_speed(scene, speed), f"{take.name} x{speed:g}", source, split))
        return clips

    # -- where frames are kept -----------------------------------------------------------------

    @property
    def maps_files(self) -> bool:  # type: ignore[override]
        return bool(self.path) and not self.device_resident

    def split_data(self, split: Split) -> StoreSplit | None:
        """The split's rows, on disk or encoded."""
        return super().split_data(split) if self.path else MotionDataModule.split_data(self, split)

    def open_store(self, split: Split) -> MemoryStore:
        """The split by memory map where it is a store that is not `device_resident`, else in memory."""
        return super().open_store(split) if self.path else MotionDataModule.open_store(self, split)


def _tuple(value: object) -> object:
    """A list as the tuple it stands for: a configuration file knows no tuples."""
    return tuple(value) if isinstance(value, list) else value
