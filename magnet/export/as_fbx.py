"""Run by Blender's Python, which knows nothing of magnet: a GLB as FBX, with every keyframe.

python as_fbx.py -- IN.glb OUT.fbx FPS

IN has the whole number of frames a second that is next to FPS; OUT has one take of everybody.
"""

from __future__ import annotations

import sys
from typing import Any


def main(glb: str, fbx: str, fps: str) -> None:
    import bpy

    blender: Any = bpy
    blender.ops.wm.read_factory_settings(use_empty=True)
    scene = blender.context.scene
    scene.name = "motion"  # of which a take of everybody is named
    scene.render.fps = max(round(float(fps)), 1)
    blender.ops.import_scene.gltf(filepath=glb)  # which would take frames of a broken rate for longer than they are
    scene.render.fps_base = scene.render.fps / float(fps)
    bones = [bone for thing in blender.data.objects if thing.pose is not None for bone in thing.pose.bones]
    for shape in {bone.custom_shape for bone in bones if bone.custom_shape}:  # a ball that Blender draws for bones
        blender.data.objects.remove(shape)
    scene.frame_start, scene.frame_end = 0, max(round(action.frame_range[1]) for action in blender.data.actions)
    # Blender's defaults leave keyframes out, which moved joints by 5 mm, and make a take of each person.
    blender.ops.export_scene.fbx(
        filepath=fbx,
        object_types={"ARMATURE", "MESH"},
        add_leaf_bones=False,
        bake_anim_simplify_factor=0.0,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
    )


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
