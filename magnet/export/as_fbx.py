"""Run by Blender's Python, which knows nothing of magnet: a GLB as FBX, with every keyframe.

python as_fbx.py -- IN.glb OUT.fbx FPS
"""

from __future__ import annotations

import sys
from typing import Any


def main(glb: str, fbx: str, fps: str) -> None:
    import bpy

    blender: Any = bpy
    blender.ops.wm.read_factory_settings(use_empty=True)
    render = blender.context.scene.render
    render.fps, render.fps_base = round(float(fps)), round(float(fps)) / float(fps)
    blender.ops.import_scene.gltf(filepath=glb)
    for action in blender.data.actions:  # whole frames: one that is rounded down would lose the last
        first, last = map(round, action.frame_range)
        action.use_frame_range, action.frame_start, action.frame_end = True, first, last
    blender.context.scene.frame_end = max(round(action.frame_range[1]) for action in blender.data.actions)
    # Blender's default leaves keyframes out, which moved joints by 5 mm.
    blender.ops.export_scene.fbx(
        filepath=fbx, object_types={"ARMATURE", "MESH"}, add_leaf_bones=False, bake_anim_simplify_factor=0.0
    )


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
