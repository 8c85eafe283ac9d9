"""Embody 3D: conversations and shared tasks of two to four people in SMPL-X, 30 fps, y up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.datamodules.clip import Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.arrays import (
    AGAIN,
    Doubles,
    floats,
    one_length,
    one_shape,
    open_json,
    open_npy,
    require,
)
from magnet.datamodules.reading.fields import PersonMotion, listing, side_by_side
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.reading.session_split import split_sessions
from magnet.datamodules.registry import register_data
from magnet.unpickle import mapping

WIDTHS = {"smplx_mesh_global_orient": 3, "smplx_mesh_body_pose": 63, "smplx_mesh_transl": 3}
FEATURES = (*WIDTHS, "smplx_mesh_betas", "missing")
BETAS = 300
LIST = "dataset.json"
USUAL = ("acting", "daylife")
"""Sections that are taken unless others are named."""
FIRST = "the first 10 of 300 shape numbers are used: the same basis, slightly another mesh"


@dataclass(frozen=True)
class _Scene:
    section: str
    capture: str
    people: tuple[str, ...]  # subject ids, sorted
    frames: int  # by the list; at least 1

    @property
    def session(self) -> str:
        """DATE--TIME: everything recorded in one go."""
        parts = self.capture.split("--")
        return "--".join(parts[1:3]) if len(parts) > 2 else self.capture


class Embody3DReader(Reader):
    """Embody 3D's `datasets/<section>/<capture>/<subject>/<feature>/<capture>.npy`.

    A scene holds everybody whom a section's dataset.json lists or names for the same capture. Whole sessions (date and
    time of the capture) go to one split: `split_sessions` gives test and val a tenth of the frames of each number of
    people. It reads the lists alone, those of acting and daylife first, then those of each other section in
    alphabetical order; sessions already assigned keep their split. So a scene's split does not depend on which sections
    and numbers of people are chosen or downloaded, as long as the same lists are present; the toolbox has them all.

    Args:
        root: the folder `datasets`, the one above, or one section's.
        sections: such as acting, daylife, aiagent, emotions, icebreakers, location, polyadic; None: acting and daylife
            as far as they were downloaded, else all that were. The paper's own choice is not published; acting and
            daylife come closest to its numbers.
        people: how many people a scene may have.
        good: what `missing` holds where tracking is good: 1 by the README, against the name.
    """

    name = "embody3d"
    title = "Embody 3D"
    source = "https://www.meta.com/emerging-tech/codec-avatars/embody-3d"
    licence = "Meta's XRCIA research licence, by form; no redistribution"
    fake = "magnet.datamodules.fakes.embody3d"
    family = "smplx"
    layout = (
        ("datasets/SECTION/CAPTURE/SUBJECT/FEATURE/CAPTURE.npy", "features smplx_mesh_* and missing"),
        ("datasets/SECTION/dataset.json", "the list of each section, from the toolbox"),
    )

    def __init__(
        self, root: str | Path, sections: Sequence[str] | None = None, people: Sequence[int] = (2, 3, 4), good: int = 1
    ) -> None:
        super().__init__(root)
        if good not in (0, 1):
            raise ValueError(f"good: got {good}, expected 1 (the README) or 0")
        self.people, self.good = tuple(people), good
        self.folder = self.root / "datasets" if (self.root / "datasets").is_dir() else self.root
        if (self.root / LIST).is_file():
            self.folder, sections = self.root.absolute().parent, sections or (self.root.absolute().name,)
        self.listed = sorted(path.parent.name for path in self.folder.glob(f"*/{LIST}"))
        if lacking := [section for section in sections or () if section not in self.listed]:
            raise DataError(
                f"{self.folder}: no {', '.join(f'{section}/{LIST}' for section in lacking)}; sections with one: "
                f"{', '.join(self.listed) or 'none'}; give those as --reader.sections, or get {LIST} from the toolbox"
            )
        self.sections = tuple(sections) if sections is not None else self._downloaded()

    def _downloaded(self) -> tuple[str, ...]:
        """Sections of which captures are there: acting and daylife, or all others."""
        held = {path.parents[2].name for path in self.folder.glob("*/c--*/*/missing")}
        if unlisted := [section for section in USUAL if section in held and section not in self.listed]:
            raise DataError(
                f"{self.folder}: captures of {', '.join(unlisted)}, but no {unlisted[0]}/{LIST}; get it from the "
                f"toolbox, or name the sections to read as --reader.sections"
            )
        there = [section for section in self.listed if section in held]
        if not there:
            listed = f"lists of {', '.join(self.listed)}" if self.listed else f"no SECTION/{LIST}"
            raise DataError(
                f"{self.folder}: {listed}, but no captures SECTION/CAPTURE/SUBJECT/missing; it holds "
                f"{listing(self.folder)}; unpack the downloaded categories there, each with its {LIST} of the toolbox"
            )
        return tuple(section for section in there if section in USUAL) or tuple(there)

    def found(self) -> list[Take]:
        splits, scenes = self._splits()
        return [
            Take(
                name=scene.capture if len(scene.people) > 1 else f"{scene.capture}/{scene.people[0]}",
                files=tuple(self._file(scene, person, feature) for person in scene.people for feature in FEATURES),
                split=splits[scene.session],
                group=scene.capture,
            )
            for section in self.sections
            for scene in scenes[section]
            if len(scene.people) in self.people
        ]

    def _splits(self) -> tuple[dict[str, Split], dict[str, list[_Scene]]]:
        """The split of every listed session, whatever was chosen of them; and the scenes of each section."""
        scenes: dict[str, list[_Scene]] = {}
        splits: dict[str, Split] = {}
        first = [section for section in USUAL if section in self.listed]
        for sections in (first, *([section] for section in self.listed if section not in first)):
            sessions: dict[str, Counter[int]] = {}
            for section in sections:
                scenes[section] = self._scenes(section)
                for scene in scenes[section]:
                    sessions.setdefault(scene.session, Counter())[len(scene.people)] += scene.frames
            splits |= split_sessions(sessions, splits)
        return splits, scenes

    def read(self, take: Take) -> Recording:
        """Everybody in a scene, sorted by id, with the frames where everybody's tracking is good."""
        files = [take.files[start : start + len(FEATURES)] for start in range(0, len(take.files), len(FEATURES))]
        people = [self._person(dict(zip(FEATURES, of, strict=True))) for of in files]
        scene = side_by_side(take.name, [person for person, _ in people], 30.0, "+y", notes=[FIRST])
        return replace(scene, valid=np.stack([valid for _, valid in people], axis=1))

    def _scenes(self, section: str) -> list[_Scene]:
        """Everybody by capture, and whom they say they met."""
        path = self.folder / section / LIST
        together: dict[str, set[str]] = {}
        frames: Counter[str] = Counter()
        alone: list[_Scene] = []
        for subject, captures in mapping(path, open_json(path)).items():
            for capture, said in mapping(f"{path}: {subject}", captures).items():
                where = f"{path}: {subject}, {capture}"
                require(where, mapping(where, said), ("multiperson",))
                others, length = said["multiperson"], said.get("length")
                frames[capture] = max(frames[capture], length if isinstance(length, int) else 1, 1)
                if not others:
                    alone.append(_Scene(section, capture, (subject,), frames[capture]))
                    continue
                if not isinstance(others, list) or not all(isinstance(other, str) for other in others):
                    raise DataError(
                        f"{where}: multiperson is {others!r:.80}, expected subjects' ids or null; download the "
                        "list again"
                    )
                # Whoever is named was there: a partner without files must be missed when the scene is read.
                together.setdefault(capture, set()).update((subject, *others))
        scenes = [
            _Scene(section, capture, tuple(sorted(people)), frames[capture]) for capture, people in together.items()
        ]
        for scene in (*scenes, *alone):
            for part in (scene.capture, *scene.people):
                if part in ("", ".", "..") or len(part) > 240 or set("/\\\0") & set(part):
                    raise DataError(f"{path}: {part!r} is not the name of a folder; get dataset.json anew")
        return sorted((*scenes, *alone), key=lambda scene: (scene.capture, scene.people))

    def _file(self, scene: _Scene, person: str, feature: str) -> Path:
        return self.folder / scene.section / scene.capture / person / feature / f"{scene.capture}.npy"

    def _person(self, files: dict[str, Path]) -> tuple[PersonMotion, NDArray[np.bool_]]:
        folder = files["missing"].parents[1]
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder: a partner's files are missing; {AGAIN}")
        valid = self._valid(files["missing"])
        widths = {**WIDTHS, "smplx_mesh_betas": BETAS}
        held = {key: open_npy(files[key]) for key in widths}
        if held["smplx_mesh_betas"].ndim == 1:
            held["smplx_mesh_betas"] = np.broadcast_to(
                held["smplx_mesh_betas"], (len(valid), *held["smplx_mesh_betas"].shape)
            )
        arrays = {key: floats(files[key], array, ("T", widths[key]), finite=False) for key, array in held.items()}
        one_length(folder, {key: len(array) for key, array in arrays.items()} | {"missing": len(valid)})
        arrays = {key: _held(files[key], array, valid) for key, array in arrays.items()}
        shape, notes = one_shape(files["smplx_mesh_betas"], arrays["smplx_mesh_betas"])
        poses = np.concatenate([arrays["smplx_mesh_global_orient"], arrays["smplx_mesh_body_pose"]], axis=1)
        person = PersonMotion(poses.reshape(-1, 22, 3), arrays["smplx_mesh_transl"], shape, folder.name, notes)
        return person, valid

    def _valid(self, path: Path) -> NDArray[np.bool_]:
        array = open_npy(path)
        array = array.astype(np.uint8) if array.dtype == bool else array
        flags = floats(path, array[:, 0] if array.shape[1:] == (1,) else array, ("T",))
        if strange := sorted(set(np.unique(flags)) - {0.0, 1.0}):
            raise DataError(f"{path}: holds {strange[0]:g}, expected only 0 and 1; {AGAIN}")
        valid = flags == self.good
        if valid.mean() < 0.5:
            raise DataError(
                f"{path}: only {valid.mean():.0%} of {len(valid)} frames hold {self.good}, which means good tracking; "
                f"if nearly all scenes say so, the meaning is the other way round: give --reader.good {1 - self.good}; "
                f"if only this one does, leave it out"
            )
        return valid


def _held(path: Path, array: Doubles, valid: NDArray[np.bool_]) -> Doubles:
    """Refuse NaN in valid frames; in other frames, which are not trained on, repeat the last finite numbers."""
    bad = ~np.isfinite(array).all(axis=1)
    if (bad & valid).any():
        raise DataError(f"{path}: NaN or infinity in {int((bad & valid).sum())} frames of good tracking; {AGAIN}")
    good = np.flatnonzero(~bad)
    return array[good[np.searchsorted(good[1:], np.arange(len(array)), side="right")]]


@register_data()
class Embody3D(Prepared):
    """Embody 3D from a prepared store: scenes of two to four people.

    A model of two, three or four people trains on a store that was prepared with `people` of that number; the mixed
    one on a store of all, where `augment.drop` and `augment.drop_at_most` mask people at random (paper 4).

    Args:
        path: the store's folder.
        max_agents: slots P of every batch.
        **kwargs: as for Prepared.
    """

    reader = Embody3DReader

    def __init__(self, path: str = "", max_agents: int = 4, **kwargs: Any) -> None:
        super().__init__(path=path, max_agents=max_agents, **kwargs)
