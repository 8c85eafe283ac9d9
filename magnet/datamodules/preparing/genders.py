"""Shape numbers of gendered bodies, converted to those of the one body that is trained on."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from magnet.body import Body, load_body
from magnet.body.family import body_files
from magnet.body.shape import reshaped
from magnet.datamodules.reading.recording import GENDERS, DataError, Gender, Recording

MOST = 0.04
"""Metres that any joint at rest may be off, as for bodies fitted to positions."""
WORD = re.compile("|".join(sorted(GENDERS, key=len, reverse=True)))  # female before male, which it holds


def find_bodies(paths: Sequence[str | Path], families: Sequence[str] = ()) -> dict[Gender, Path]:
    """Body files by gender: from a folder, or files, named such as SMPLX_FEMALE.npz or female/model.npz.

    SMPL's own names, such as basicModel_f_lbs_10_207_0_v1.0.0.pkl, are known too. Of an npz and a pkl of one name the
    npz is taken; where a folder holds bodies of several families, those of `families`.

    Raises:
        ValueError: no such file or folder, a file of no gender, or two of one.
    """
    found: dict[Gender, Path] = {}
    for given in map(Path, paths):
        if not given.exists():
            raise ValueError(f"bodies: {given} does not exist; give a folder with SMPLX_FEMALE.npz and SMPLX_MALE.npz")
        inside = body_files(given) if given.is_dir() else [given]
        if not given.is_dir() and _named(given) is None:
            raise ValueError(f"bodies: the name of {given} says none of {', '.join(GENDERS)}")
        for gender, listed in _by_gender(inside).items():
            if len(listed) > 1 and families:
                listed = [path for path in listed if load_body(path).family in families] or listed
            both = [*([found[gender]] if gender in found else []), *listed]
            if len(both) > 1:
                raise ValueError(f"bodies: {both[0]} and {both[1]} are both {gender}; give the files themselves")
            found[gender] = listed[0]
    if not found:
        listed_ones = ", ".join(map(str, paths))
        raise ValueError(
            f"bodies: no file such as SMPLX_FEMALE.npz, SMPLX_MALE.npz or SMPLX_NEUTRAL.npz (or .pkl) in {listed_ones}"
        )
    return found


def _by_gender(paths: Sequence[Path]) -> dict[Gender, list[Path]]:
    found: dict[Gender, list[Path]] = {}
    for path in paths:
        if gender := _named(path):
            found.setdefault(gender, []).append(path)
    return found


def _named(path: Path) -> Gender | None:
    name = (path.parent.name if path.stem == "model" else path.stem).lower()
    if short := re.search(r"basicmodel_([fm])_", name):
        return "female" if short[1] == "f" else "male"
    match = WORD.search(name)
    return match[0] if match else None  # type: ignore[return-value]


def load_bodies(paths: Sequence[str | Path], families: Sequence[str] = ()) -> dict[Gender, Body]:
    """The bodies of `find_bodies`."""
    return {gender: load_body(path) for gender, path in sorted(find_bodies(paths, families).items())}


def one_body(recording: Recording, bodies: Mapping[Gender, Body], body: Body) -> Recording:
    """The same motion with everybody's shape expressed in `body`; notes say how far joints at rest are off.

    The pelvis stays where the person's own body has it: transl + J0(beta) is that of the gendered body.

    Args:
        recording: as read; positions are given back as they are.
        bodies: by gender; people of no gender are "neutral", for whom `body` will do if it is of the same family.
        body: the one that trains.

    Raises:
        DataError: a gender without a body, or joints at rest further off than 4 cm.
    """
    if recording.poses is None or recording.transl is None or recording.betas is None or not bodies or recording.body:
        return recording
    genders = recording.genders or ("neutral",) * len(recording.betas)
    alike = body.family in ("", *(one.family for one in bodies.values()))
    own_bodies: dict[Gender, Body] = {**({"neutral": body} if alike else {}), **bodies}
    transl, betas = np.array(recording.transl, dtype=np.float64), np.array(recording.betas, dtype=np.float64)
    notes = list(recording.notes)
    for p, gender in enumerate(genders):
        who = recording.persons[p] if recording.persons else f"person {p}"
        if gender not in own_bodies:
            has = ", ".join(sorted(own_bodies))
            raise DataError(
                f"{who} is {gender}, but the bodies are {has} alone; give the {gender} one with --bodies, too"
            )
        own, shape = own_bodies[gender], torch.from_numpy(betas[p : p + 1])
        found, off = reshaped(shape, own, body)
        worst = float(off.max())
        if not worst <= MOST:
            raise DataError(
                f"{who}: {gender} joints at rest are up to {100 * worst:.1f} cm off when expressed in body {body.id}, "
                f"expected at most {100 * MOST:g} cm; check that --bodies are of the same model as the data"
            )
        transl[:, p] += (own.rest_joints(shape)[0, 0] - body.rest_joints(found)[0, 0]).numpy()
        betas[p] = found[0].numpy()
        if worst:
            whole = max(1, math.ceil(1000 * worst))  # rounded up, so that takes alike share a note
            notes.append(f"{gender} shapes expressed in body {body.id}: joints at rest within {whole} mm")
    return replace(recording, transl=transl, betas=betas, notes=tuple(dict.fromkeys(notes)), genders=(), shapes_of="")
