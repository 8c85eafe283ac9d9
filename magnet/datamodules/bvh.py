"""A user's own BVH files of any skeleton: one person a file."""

from __future__ import annotations

from magnet.datamodules.reading.arrays import AGAIN
from magnet.datamodules.reading.own_files import PersonFile
from magnet.datamodules.reading.recording import DataError
from magnet.datamodules.reading.rigs import RigReader, RigTrack
from magnet.datamodules.registry import register_reader
from magnet.export.bvh_read import read_bvh
from magnet.export.smpl_people import gap_note


@register_reader
class BVHReader(RigReader):
    """A folder of BVH files, one person each; names, a pattern or a table say which belong to one scene.

    Units, up axis and which joint is which are found in each file, as `magnet export` finds them.

    Args:
        root: the folder.
        **kwargs: as for RigReader.
    """

    name = "bvh"
    title = "BVH files"
    fake = "magnet.datamodules.fakes.bvh"
    suffixes = (".bvh",)
    layout = (
        ("NAME_{A,B}.bvh", "a person each, of any skeleton; other ways to say who is together are in docs/own.md"),
    )

    def open(self, person_file: PersonFile, alone: bool) -> tuple[list[RigTrack], list[str]]:
        """The person of a file."""
        try:
            file = read_bvh(person_file.file, gaps=True)
        except (ValueError, OSError) as error:
            raise DataError(f"{error}; {AGAIN}") from error
        track = self.track(file)
        return [track], list(gap_note(file.path, track.valid))
