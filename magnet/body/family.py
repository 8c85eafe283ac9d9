"""Which model of SMPL's family a body file holds, by its tree of joints; shape numbers differ between models."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from magnet.body.joints import HEAD, L_WRIST, PARENTS, R_WRIST, WRISTS


def _hand(wrist: int, first: int) -> list[int]:
    """Five fingers of three joints each, numbered from `first`."""
    return [wrist if k % 3 == 0 else first + k - 1 for k in range(15)]


TREES: dict[str, tuple[int, ...]] = {
    "smpl": (*PARENTS, *WRISTS),
    "smplh": (*PARENTS, *_hand(L_WRIST, 22), *_hand(R_WRIST, 37)),
    "smplx": (*PARENTS, HEAD, HEAD, HEAD, *_hand(L_WRIST, 25), *_hand(R_WRIST, 40)),
}
"""Parents of all joints: SMPL has two hand joints, SMPL-H thirty finger joints, SMPL-X also a jaw and eyes."""
TITLES = {"smpl": "SMPL", "smplh": "SMPL-H", "smplx": "SMPL-X"}
FILES = (".npz", ".pkl")


def family_of(parents: Sequence[int]) -> str:
    """ "smpl", "smplh" or "smplx" by the parents of all joints, whatever the root's; "": another tree."""
    tree = (-1, *(int(parent) for parent in parents[1:]))
    return next((family for family, known in TREES.items() if known == tree), "")


def title(family: str) -> str:
    """What a family is called."""
    return TITLES.get(family, "another tree of joints")


def body_files(folder: Path) -> list[Path]:
    """Possible body files in a folder and its subfolders; of an npz and a pkl of one name, the npz."""
    found = [path for end in FILES for path in (*folder.glob(f"*{end}"), *folder.glob(f"*/*{end}"))]
    return sorted({path.with_suffix(""): path for path in reversed(found)}.values())


def titles(families: Iterable[str]) -> str:
    """Several families, in words."""
    return " or ".join(map(title, families))
