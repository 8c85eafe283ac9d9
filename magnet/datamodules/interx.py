"""Inter-X: pairs of people in forty kinds of interaction, SMPL-X at 120 fps."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from magnet.datamodules.clip import SPLITS, Split
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.arrays import OR_YOURS, open_names, open_npz
from magnet.datamodules.reading.fields import PersonMotion, first_folder, listing, person, side_by_side
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.registry import register_data
from magnet.unpickle import load_pickle

RATE = 120.0
FILES = ("P1.npz", "P2.npz")
PLACES = ("motions", "Inter-X_Dataset/motions", "Inter-X/motions", "")
LISTS = ("splits", "../splits", "../datasets", "datasets")
"""Where the split lists lie, from the folder of the motions; its repository has them in datasets/."""
CLIP = re.compile(r"(G\d{3}T\d{3}A\d{3}R\d{3})(_.*)?")
KEYS = ("pose_body", "root_orient", "trans", "betas")
PROCESSED = (
    "its processed .h5 is not read: there the floor is each person's own, the translation relative to one of them and "
    "the body shapes are gone; unpack motions.zip and give the folder above motions/"
)


class InterXReader(Reader):
    """Inter-X's motions/G001T000A000R000/{P1,P2}.npz, whose folders may carry the action's name (.._Hug).

    Args:
        root: the folder of motions/, splits/ and annots/.
        split: "official" reads splits/{train,val,test}.txt; "paper" reads `lists`, since the paper's authors split
            anew (9074, 1157 and 1157 clips).
        lists: folder of the lists for "paper": {train,val,test}.txt, .csv or _data.csv, one clip a line.
    """

    name = "interx"
    title = "Inter-X"
    source = "https://github.com/liangxuy/Inter-X"
    licence = "CC BY-NC-SA 4.0 and its terms for research; no redistribution"
    fake = "magnet.datamodules.fakes.interx"
    family = "smplx"
    layout = (
        ("motions/CLIP/{P1,P2}.npz", "such as G001T000A000R000/P1.npz"),
        ("splits/{train,val,test}.txt", "the official lists"),
        ("annots/interaction_order.pkl", "not needed, says who acts"),
    )
    version = 2  # genders are read

    def __init__(
        self, root: str | Path, split: Literal["official", "paper"] = "official", lists: Path | None = None
    ) -> None:
        super().__init__(root)
        if split not in ("official", "paper"):
            raise DataError(f"split: got {split!r}, expected 'official' or 'paper': give one of them")
        folder = first_folder(self.root, PLACES, "G[0-9]*T[0-9]*A[0-9]*R[0-9]*")
        if folder is None:
            processed = any(self.root.rglob("*.h5"))
            hint = PROCESSED if processed else "unpack motions.zip and give the folder above motions/"
            raise DataError(
                f"Inter-X: no clips such as motions/G001T000A000R000 in {self.root}, which holds {listing(self.root)}; "
                f"{hint}"
            )
        self.folder, self.paper, self.lists = folder, split == "paper", lists

    def official(self) -> dict[str, Split]:
        """By a clip's number, from the lists."""
        where = self._listed_in()
        found: dict[str, Split] = {}
        for name in SPLITS:
            for clip in self._listed(where, name):
                if found.setdefault(clip, name) != name:
                    raise DataError(f"{where}: clip {clip} is in both {found[clip]} and {name}; make the lists anew")
        if not found:
            raise DataError(f"{where}: all lists are empty; copy them again")
        return found

    def _listed_in(self) -> Path:
        if self.paper and self.lists is not None:
            return Path(self.lists)
        if self.paper:
            raise DataError(
                "split=paper needs lists=FOLDER with train, val and test lists (.txt or .csv); the paper's are "
                f"data/data_split/interx_data_split of its authors' repository{OR_YOURS}"
            )
        where = next((self.folder / place for place in LISTS if (self.folder / place / "train.txt").is_file()), None)
        if where is None:
            raise DataError(
                f"Inter-X: no splits/train.txt beside {self.folder}; unpack the data set's splits there, take "
                f"datasets/{{train,val,test}}.txt of its repository{OR_YOURS}"
            )
        return where

    def _listed(self, where: Path, name: Split) -> list[str]:
        files = [where / f"{name}{ending}" for ending in (".txt", ".csv", "_data.csv")]
        path = next((file for file in files if file.is_file()), None)
        if path is None:
            raise DataError(f"{where}: no {', '.join(file.name for file in files)}; the lists are incomplete")
        lines = [line.split(",")[0].strip() for line in open_names(path)]
        clips = [match[1] for line in lines if (match := CLIP.fullmatch(line))]
        if len(clips) < len(lines) - 1 or (lines and not clips):  # a heading is allowed
            raise DataError(
                f"{path}: {len(clips)} of {len(lines)} lines name a clip such as G001T000A000R000; is it another list?"
            )
        return clips

    def found(self) -> list[Take]:
        """One take per folder; `read` refuses one with missing files."""
        found: dict[str, Path] = {}
        for folder in sorted(self.folder.iterdir()):
            if (match := CLIP.fullmatch(folder.name)) and folder.is_dir():
                if match[1] in found:
                    raise DataError(f"{folder}: the same clip as {found[match[1]]}; leave one out")
                found[match[1]] = folder
        return [
            Take(folder.name, tuple(folder / name for name in FILES), None, clip, also=self._orders())
            for clip, folder in found.items()
        ]

    def _orders(self) -> tuple[Path, ...]:
        return tuple(self.folder / place / "interaction_order.pkl" for place in ("../annots", "annots"))

    @cached_property
    def _order(self) -> dict[str, Any] | DataError | None:
        """Who acts, by clip: 0 is P1, 1 is P2. Without the file, or with a damaged one, roles stay unknown."""
        for path in self._orders():
            if path.is_file():
                try:
                    held = load_pickle(path)
                except DataError as error:
                    return error
                return {str(key)[:16]: role for key, role in held.items()} if isinstance(held, dict) else None
        return None

    def read(self, take: Take) -> Recording:
        """P1 and P2 at 120 fps, y up; `persons` are their roles where interaction_order.pkl tells."""
        held = [open_npz(path, KEYS, ("gender",)) for path in take.files]
        notes: list[str] = []
        names = ("P1", "P2")
        if isinstance(self._order, DataError):
            notes.append(f"roles are unknown: {self._order}")
        elif self._order is not None and (actor := self._order.get(take.name[:16])) in (0, 1):
            names = ("P1, actor", "P2, reactor") if actor == 0 else ("P1, reactor", "P2, actor")
        people: list[PersonMotion] = [
            person(path, one, name, gender=one.get("gender"), orient="root_orient", body="pose_body", transl="trans")
            for path, one, name in zip(take.files, held, names, strict=True)
        ]
        return side_by_side(take.files[0].parent, people, RATE, "+y", notes=notes)


@register_data()
class InterX(Prepared):
    """Pairs of Inter-X, from a store that `magnet data prepare interx` made."""

    reader = InterXReader
