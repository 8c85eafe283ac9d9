"""Whole takes fitted to a body, and a cache of them: a file per take, named by a hash of all that it was made from."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor

from magnet.body import Body
from magnet.body.fit import floor_height
from magnet.body.joints import ELBOWS, FEET, HIPS, KNEES, SHOULDERS, WRISTS
from magnet.datamodules.preparing.canonicalize import fit_positions
from magnet.datamodules.preparing.convert import sizes
from magnet.datamodules.preparing.progress import progress_bar
from magnet.datamodules.reading.cmu_joints import Glitches
from magnet.datamodules.reading.recording import Recording, Take
from magnet.datamodules.store.reader import body_hash
from magnet.files import write_whole, writing
from magnet.motion.scene import Scene
from magnet.threads import one_thread

LIMBS = (*HIPS, *KNEES, *FEET, *SHOULDERS, *ELBOWS, *WRISTS)
HELD = 0.20
"""Metres between two people's wrists below which they may hold hands."""
ADVICE = "give another --data.cache; then run the same command again, which keeps fitted takes"
Steps = Callable[[int, int], None]
"""Called with the steps of a fit that are done, and how many there are."""


def cache_folder(named: str | None, name: str) -> Path:
    """The folder that somebody named to keep what takes long to make, or else one in the user's cache."""
    if named:
        return Path(named).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "magnet" / name


def fit_whole(
    recording: Recording, glitches: Sequence[Glitches], body: Body, progress: Steps | None = None
) -> tuple[Scene, dict[str, Any]]:
    """A whole take as bodies in one scene at 30 fps, feet at rest on y = 0, and a report on the fit.

    Of the lower sole of each person and frame, the median over valid frames is taken to rest on the floor: people
    stand on at least one foot most of the time. Lengths in the report are in centimetres.

    Raises:
        ValueError: the body does not fit.
    """
    assert recording.positions is not None and recording.valid is not None
    targets, good = torch.from_numpy(recording.positions), torch.from_numpy(recording.valid)
    fit = fit_positions(recording, targets, recording.valid, body, progress=progress)
    joints, scene = list(recording.joints), fit.scene
    found = body.joints(scene)[0]
    limbs, wrists = ([joints.index(joint) for joint in some] for some in (LIMBS, WRISTS))
    recorded, fitted = (wrists_apart(each, good) for each in (targets[:, :, wrists], found[:, :, WRISTS]))
    valid = torch.ones(1, scene.frames, dtype=torch.bool) if scene.valid is None else scene.valid
    floor = float(floor_height(found, body, scene.betas[0])[valid[0]].median())
    T_world_root = scene.T_world_root.clone()
    T_world_root[..., 1, 3] -= floor

    def rounded(value: float | Tensor, digits: int = 2) -> float | None:
        return None if math.isnan(value) else round(100 * float(value), digits)

    def nearest(apart: Tensor) -> float | None:
        return rounded(apart.amin()) if len(apart) else None

    report = {
        "frames": scene.frames,
        "frames masked": int((~valid).sum()),
        "limb error cm": rounded(fit.residual[good][:, limbs].mean()),
        "wrist error cm": rounded(fit.residual[good][:, wrists].mean()),
        "nearest wrists recorded cm": nearest(recorded),
        "nearest wrists fitted cm": nearest(fitted),
        "wrists under 20 cm recorded %": rounded((recorded < HELD).double().mean(), 1),
        "wrists under 20 cm fitted %": rounded((fitted < HELD).double().mean(), 1),
        "floor cm": rounded(floor),
        "largest shape number": round(float(scene.betas.abs().max()), 2),
        "glitches": [
            {
                "jumps": glitch.jumps,
                "jumps of modelled joints": glitch.body_jumps,
                "frames interpolated": int(glitch.repaired.sum()),
                "frames masked": int(glitch.masked.sum()),
            }
            for glitch in glitches
        ],
    }
    return scene.replace(T_world_root=T_world_root), report


def wrists_apart(wrists: Tensor, valid: Tensor) -> Tensor:
    """Metres between the nearest wrists of two people, in frames with two who are valid; none for one person.

    (T, P, 2, 3), (T, P) -> (frames,)
    """
    pairs = [(p, q) for p in range(wrists.shape[1]) for q in range(p)]
    nearest = torch.full((len(wrists), 1), torch.inf, dtype=wrists.dtype)
    for p, q in pairs:
        apart = torch.cdist(wrists[:, p], wrists[:, q]).amin(dim=(-1, -2))
        nearest = torch.cat([nearest, torch.where(valid[:, p] & valid[:, q], apart, torch.inf)[:, None]], dim=1)
    nearest = nearest.amin(dim=1)
    return nearest[nearest.isfinite()]


@dataclass(frozen=True)
class FitCache:
    """Fitted takes of one data set and body, with a report beside each.

    Args:
        folder: where they lie.
        body: the body that is fitted.
        facts: what a take's fit depends on besides its files and the body's joints.
        fit: fits a take, and reports on it; its second argument is told of progress.
    """

    folder: Path
    body: Body
    facts: Callable[[Take], tuple[Any, ...]]
    fit: Callable[[Take, Steps], tuple[Scene, dict[str, Any]]]
    keys: dict[str, str] = field(default_factory=dict)

    def file(self, take: Take) -> Path:
        """Where a fitted take lies or will lie."""
        if take.name not in self.keys:
            key = hashlib.sha256(bytes.fromhex(body_hash(self.body)))
            key.update(repr(self.facts(take)).encode())
            for path in take.files:
                key.update(path.read_bytes() if path.is_file() else b"missing")
            self.keys[take.name] = key.hexdigest()[:16]
        return self.folder / f"{take.name}.{self.keys[take.name]}.npz"

    def report(self, take: Take) -> dict[str, Any]:
        """The report on a take with these very files, or an "error"; empty while it has not been fitted.

        Raises:
            ValueError: its file is damaged.
        """
        report = self.file(take).with_suffix(".json")
        if not report.exists():
            return {}
        try:
            return dict(json.loads(report.read_text(encoding="utf-8")))
        except ValueError as error:
            advice = "delete it and the .npz beside it, and the take is fitted again"
            raise ValueError(f"{report} is damaged ({error}): {advice}") from error

    def scene(self, take: Take) -> Scene | None:
        """The fitted take; None: it could not be used, or has not been fitted."""
        return Scene.load(self.file(take)) if self.file(take).exists() else None

    def lacking(self, takes: Sequence[Take]) -> list[Take]:
        """Takes that have neither a fit nor an error yet."""
        return [take for take in takes if not (self.file(take).exists() or "error" in self.report(take))]

    def fill(self, title: str, takes: Sequence[Take]) -> dict[str, str]:
        """Fit the takes that are lacking. Returns why takes cannot be used, by name.

        Raises:
            CannotWrite: the disk is full, or the folder does not take files.
        """
        if todo := self.lacking(takes):
            with writing(self.folder, ADVICE):
                self.folder.mkdir(parents=True, exist_ok=True)
            rank_zero_info(f"{title}: fitting {len(todo)} takes to body {self.body.id} once, into {self.folder}")
            size, before = sizes(todo), 0
            # The fit's tensors are so small that threads cost more than they give, many times more on a busy machine.
            with one_thread(), progress_bar() as tell:
                for take in todo:
                    self._fill_one(take, lambda n, b, s=before: tell(n, s + b, sum(size.values())), size[take.name])  # type: ignore[misc]
                    before += size[take.name]
        return {take.name: str(report["error"]) for take in takes if "error" in (report := self.report(take))}

    def _fill_one(self, take: Take, tell: Callable[[str, int], None], size: int) -> None:
        target = self.file(take)
        try:
            scene, report = self.fit(take, lambda done, steps: tell(take.name, size * done // steps))
        except ValueError as error:
            report = {"error": str(error)}
        else:
            with TemporaryDirectory() as folder:
                content = scene.replace(names=(take.name,)).save(Path(folder) / "scene.npz").read_bytes()
            write_whole(self.folder, target.name, content, advice=ADVICE)
        text = json.dumps({"take": take.name, **report}, indent=1).encode()
        write_whole(self.folder, target.with_suffix(".json").name, text, advice=ADVICE)
        tell(take.name, size)
