"""A user's own glTF, VRM and FBX files of any skeletons: everybody of a scene in one file, or one person a file."""

from __future__ import annotations

from collections import Counter

from magnet.datamodules.reading.own import require_alone
from magnet.datamodules.reading.own_files import PersonFile
from magnet.datamodules.reading.recording import DataError
from magnet.datamodules.reading.rigs import RigReader, RigTrack
from magnet.datamodules.registry import register_reader
from magnet.export.rig import people_of
from magnet.export.rig_files import read_rigs


@register_reader
class GLBReader(RigReader):
    """A folder of glTF (.glb, .gltf), VRM animations (.vrma) and FBX files, of one person or several each.

    Names, a pattern or a table say which go together. Units and which joint is which are found in each file, as `magnet
    export` finds them; y is up, as all formats say. FBX is read through Blender.

    Args:
        root: the folder.
        **kwargs: as for RigReader.
    """

    name = "glb"
    title = "GLB, glTF, VRM animation and FBX files"
    fake = "magnet.datamodules.fakes.glb"
    suffixes = (".glb", ".gltf", ".vrma", ".fbx")
    layout = (
        ("NAME.glb", "everybody of a scene, of any skeletons; or a person each, and .gltf, .vrma, .fbx (docs/own.md)"),
    )
    one_person_a_file = False

    def open(self, person_file: PersonFile, alone: bool) -> tuple[list[RigTrack], list[str]]:
        """The people in a file."""
        path = person_file.file
        try:
            people = people_of(read_rigs(path), self.joints)
        except ImportError as error:  # an FBX without Blender
            raise DataError(f"{path}: {error}") from error
        except (ValueError, OSError) as error:
            raise DataError(f"{error}; if it cannot be mended, leave it out") from error
        require_alone(path, len(people), alone)
        notes = dict.fromkeys(note for person in people for note in person.notes)
        return [self.track(person) for person in people], list(notes)

    def summary(self) -> list[str]:
        """Also files that may be two of one motion."""
        files = [each.file for group in self.scenes().values() for each in group.people]
        count = Counter(path.with_suffix("") for path in files)
        twice = [path.name for path in files if count[path.with_suffix("")] > 1]
        if not twice:
            return super().summary()
        same = f"{' and '.join(twice[:2])} differ in their suffix alone"
        return [*super().summary(), f"{same}: if one was made of the other, leave it out: what trains must not test"]
