"""Joint positions as a table, for spreadsheets and statistics."""

from __future__ import annotations

import csv
from pathlib import Path

from magnet.body import Body
from magnet.body.joints import JOINT_NAMES
from magnet.files import suffixed, whole
from magnet.motion.scene import Scene

COLUMNS = ("scene", "frame", "time_s", "person", *(f"{name}_{axis}_m" for name in JOINT_NAMES for axis in "xyz"))
"""scene, frame and person count from 0 (a person by slot); time in seconds; world joints in metres, y up."""


def save_csv(scene: Scene, path: str | Path, body: Body) -> Path:
    """Write one row a frame and person present, all B scenes in one table; see `COLUMNS`. Returns the path written.

    >>> import tempfile
    >>> import magnet
    >>> from magnet.body import load_body
    >>> scene = magnet.load("duet", steps=1).generate(people=2, frames=8, seed=0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     table = save_csv(scene, Path(folder) / "scene.csv", load_body()).read_text().splitlines()
    >>> len(table), table[1].split(",")[:4]  # a line of names, then 8 frames of 2 people
    (17, ['0', '0', '0.000000', '0'])
    """
    path = suffixed(path, ".csv")
    with whole(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for b in range(scene.scenes):
            slots = scene.present[b].nonzero()[:, 0].tolist()
            joints = body.joints(scene.select([b]))[0].detach().flatten(-2).double().cpu().numpy()  # (T, P, 66)
            for t, frame in enumerate(joints):
                for p in slots:
                    table.writerow([b, t, f"{t / scene.fps:.6f}", p, *(f"{metres:.5f}" for metres in frame[p])])
    return path
