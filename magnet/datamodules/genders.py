"""People recorded with gendered bodies, as people of the one body that trains."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from magnet.body import Body, load_body
from magnet.body.shape import reshaped
from magnet.datamodules.recording import GENDERS, DataError, Gender, Recording

MOST = 0.04
"""Metres that any joint at rest may be off, as for bodies fitted to positions."""
WORD = re.compile("|".join(sorted(GENDERS, key=len, reverse=True)))  # female before male, which it holds


def find_bodies(paths: Sequence[str | Path]) -> dict[Gender, Path]:
    """Body files by gender: from a folder, or files, named such as SMPLX_FEMALE.npz or female/model.npz.

    Raises:
        ValueError: no such file or folder, a file of no gender, or two of one.
    """
    found: dict[Gender, Path] = {}
    for given in map(Path, paths):
        if not given.exists():
            raise ValueError(f"bodies: {given} does not exist; give a folder with SMPLX_FEMALE.npz and SMPLX_MALE.npz")
        inside = sorted([*given.glob("*.npz"), *given.glob("*/*.npz")]) if given.is_dir() else [given]
        for path in inside:
            gender = _named(path)
            if gender is None and path == given:
                raise ValueError(f"bodies: the name of {path} says none of {', '.join(GENDERS)}")
            if gender is not None and gender in found:
                raise ValueError(f"bodies: {found[gender]} and {path} are both {gender}; give the files themselves")
            if gender is not None:
                found[gender] = path
    if not found:
        listed = ", ".join(map(str, paths))
        raise ValueError(f"bodies: no file such as SMPLX_FEMALE.npz, SMPLX_MALE.npz or SMPLX_NEUTRAL.npz in {listed}")
    return found


def _named(path: Path) -> Gender | None:
    name = path.parent.name if path.stem == "model" else path.stem
    match = WORD.search(name.lower())
    return match[0] if match else None  # type: ignore[return-value]


def load_bodies(paths: Sequence[str | Path]) -> dict[Gender, Body]:
    """The bodies of `find_bodies`."""
    return {gender: load_body(path) for gender, path in sorted(find_bodies(paths).items())}


def one_body(recording: Recording, bodies: Mapping[Gender, Body], body: Body) -> Recording:
    """The same motion with everybody's shape expressed in `body`; notes say how far joints at rest are off.

    The pelvis stays where the person's own body has it: transl + J0(beta) is that of the gendered body.

    Args:
        recording: as read; positions are given back as they are.
        bodies: by gender; people of no gender are "neutral", for whom `body` will do.
        body: the one that trains.

    Raises:
        DataError: a gender without a body, or joints at rest further off than 4 cm.
    """
    if recording.poses is None or recording.transl is None or recording.betas is None or not bodies:
        return recording
    genders = recording.genders or ("neutral",) * len(recording.betas)
    bodies = {"neutral": body, **bodies}
    transl, betas = np.array(recording.transl, dtype=np.float64), np.array(recording.betas, dtype=np.float64)
    notes = list(recording.notes)
    for p, gender in enumerate(genders):
        who = recording.persons[p] if recording.persons else f"person {p}"
        if gender not in bodies:
            has = ", ".join(sorted(bodies))
            raise DataError(f"{who} is {gender}, but the bodies are {has} alone; add the {gender} one to --bodies")
        own, shape = bodies[gender], torch.from_numpy(betas[p : p + 1])
        found, off = reshaped(shape, own, body)
        worst = float(off.max())
        if not worst <= MOST:
            raise DataError(
                f"{who}: {gender} joints at rest are up to {100 * worst:.1f} cm off when expressed in body {body.id}, "
                f"expected at most {100 * MOST:g} cm; are --bodies of the same model as the data?"
            )
        transl[:, p] += (own.rest_joints(shape)[0, 0] - body.rest_joints(found)[0, 0]).numpy()
        betas[p] = found[0].numpy()
        if worst:
            notes.append(f"{gender} shapes expressed in body {body.id}: joints at rest within {_whole_mm(worst)} mm")
    return replace(recording, transl=transl, betas=betas, notes=tuple(dict.fromkeys(notes)), genders=())


def _whole_mm(metres: float) -> int:
    """Rounded up, so that takes alike share a note."""
    return max(1, math.ceil(1000 * metres))
