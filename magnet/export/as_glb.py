"""Run by Blender's Python, which knows nothing of magnet: an FBX as GLB, with a keyframe for every frame.

python as_glb.py -- IN.fbx OUT.glb

An armature of several takes moves as in the first, as Blender sets it; OUT.glb.takes has a line of each other one.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any


def main(fbx: str, glb: str) -> None:
    import bpy

    blender: Any = bpy
    blender.ops.wm.read_factory_settings(use_empty=True)
    blender.ops.import_scene.fbx(filepath=fbx)  # sets the frame rate, too
    blender.context.scene.render.fps_base = 1.0  # by which Blender's glTF multiplies where it should divide
    blender.ops.export_scene.gltf(
        filepath=glb,
        export_format="GLB",
        export_animation_mode="ACTIVE_ACTIONS",
        export_force_sampling=True,
        export_optimize_animation_size=False,
        export_materials="NONE",
        export_morph=False,
    )
    left = []
    for thing in blender.data.objects:
        if thing.type != "ARMATURE" or thing.animation_data is None or thing.animation_data.action is None:
            continue
        kept, own = thing.animation_data.action.name, f"{thing.name}|"
        takes = [action.name for action in blender.data.actions if action.name.startswith(own)]
        left += [(thing.name, kept.removeprefix(own), name.removeprefix(own)) for name in takes if name != kept]
    Path(f"{glb}.takes").write_text("".join("\t".join(words) + "\n" for words in left), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
