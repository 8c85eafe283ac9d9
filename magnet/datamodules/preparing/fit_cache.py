"""Cache of whole takes fitted to a body: a file per take, whose name holds a hash of all that it was made from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lightning.pytorch.utilities import rank_zero_info

from magnet.body import Body
from magnet.datamodules.preparing.fit_whole import Fitted, report_of
from magnet.datamodules.preparing.progress import progress_bar
from magnet.datamodules.reading.recording import Take
from magnet.datamodules.store.reader import body_hash
from magnet.files import write_whole, writing
from magnet.motion.scene import Scene
from magnet.threads import one_thread

ADVICE = "give another --data.cache; then run the same command again, which keeps fitted takes"


@dataclass(frozen=True)
class FitCache:
    """Fitted takes of one data set and body, and a report beside each.

    Args:
        folder: where they lie.
        body: that is fitted.
        facts: what a take's fit depends on besides its files and the body's joints.
        fit: fits a take; is told of progress.
    """

    folder: Path
    body: Body
    facts: Callable[[Take], tuple[Any, ...]]
    fit: Callable[[Take, Callable[[int, int], None]], Fitted]

    @cached_property
    def _keys(self) -> dict[str, str]:
        return {}

    def file(self, take: Take) -> Path:
        """Where a fitted take lies or will lie."""
        if take.name not in self._keys:
            key = hashlib.sha256(bytes.fromhex(body_hash(self.body)))
            key.update(repr(self.facts(take)).encode())
            for path in take.files:
                key.update(path.read_bytes() if path.is_file() else b"missing")
            self._keys[take.name] = key.hexdigest()[:16]
        return self.folder / f"{take.name}.{self._keys[take.name]}.npz"

    def report(self, take: Take) -> dict[str, Any]:
        """What became of these very files: `report_of`, or an "error"; empty while that is not known."""
        report = self.file(take).with_suffix(".json")
        return json.loads(report.read_text()) if report.exists() else {}

    def scene(self, take: Take) -> Scene | None:
        """The fitted take; None: it could not be used, or has not been fitted."""
        return Scene.load(self.file(take)) if self.file(take).exists() else None

    def lacking(self, takes: Sequence[Take]) -> list[Take]:
        """Those that have neither a fit nor an error yet."""
        return [take for take in takes if not (self.file(take).exists() or "error" in self.report(take))]

    def fill(self, title: str, takes: Sequence[Take]) -> dict[str, str]:
        """Fit what is lacking. Returns why takes cannot be used, by name.

        Raises:
            CannotWrite: the disk is full, or the folder does not take files.
        """
        if todo := self.lacking(takes):
            with writing(self.folder, ADVICE):
                self.folder.mkdir(parents=True, exist_ok=True)
            rank_zero_info(f"{title}: fitting {len(todo)} takes to body {self.body.id} once, into {self.folder}")
            size = {take.name: 1 + sum(path.stat().st_size for path in take.files if path.is_file()) for take in todo}
            total, before = sum(size.values()), 0
            # The fit's tensors are so small that threads cost more than they give, many times more on a busy machine.
            with one_thread(), progress_bar() as tell:
                for take in todo:
                    name, bytes_of, begun = take.name, size[take.name], before
                    self._fill_one(
                        take,
                        lambda done, steps, n=name, b=bytes_of, s=begun: tell(n, s + b * done // steps, total),  # type: ignore[misc]
                    )
                    before += bytes_of
                    tell(take.name, before, total)
        return {take.name: str(report["error"]) for take in takes if "error" in (report := self.report(take))}

    def _fill_one(self, take: Take, progress: Callable[[int, int], None]) -> None:
        report: dict[str, Any]
        target = self.file(take)
        try:
            fitted = self.fit(take, progress)
        except ValueError as error:
            report = {"take": take.name, "error": str(error)}
        else:
            report = {"take": take.name, **report_of(fitted)}
            scene = fitted.fit.scene.replace(names=(take.name,))
            content = _saved(scene)
            write_whole(self.folder, target.name, content, advice=ADVICE)
        text = json.dumps(report, indent=1).encode()
        write_whole(self.folder, target.with_suffix(".json").name, text, advice=ADVICE)


def _saved(scene: Scene) -> bytes:
    """What `Scene.save` writes."""
    with TemporaryDirectory() as folder:
        return scene.save(Path(folder) / "scene.npz").read_bytes()
