"""Run by Blender's Python, which knows nothing of magnet: an FBX as GLB, with a keyframe for every frame.

python as_glb.py -- IN.fbx OUT.glb
"""

from __future__ import annotations

import sys
from typing import Any


def main(fbx: str, glb: str) -> None:
    import bpy

    blender: Any = bpy
    blender.ops.wm.read_factory_settings(use_empty=True)
    blender.ops.import_scene.fbx(filepath=fbx)  # sets the frame rate, too
    blender.ops.export_scene.gltf(
        filepath=glb,
        export_format="GLB",
        export_animation_mode="ACTIVE_ACTIONS",
        export_force_sampling=True,
        export_optimize_animation_size=False,
        export_materials="NONE",
        export_morph=False,
    )


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
