"""Run by Blender's Python, which knows nothing of magnet: where Blender puts bones and vertices of a file.

    python in_blender.py FILE.glb|.bvh|.fbx OUT.json FRAME,FRAME...

Positions are turned from Blender's z up to y up.
"""

import json
import sys
from pathlib import Path

import bpy


def y_up(place):
    return [place[0], place[2], -place[1]]


def opened(path: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 30
    suffix = Path(path).suffix
    if suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=path)
    elif suffix == ".fbx":
        bpy.ops.import_scene.fbx(filepath=path)
    else:
        bpy.ops.import_anim.bvh(filepath=path, axis_forward="-Z", axis_up="Y")


def seen(first: int, frames: list[int]) -> dict:
    people = sorted((o for o in bpy.data.objects if o.type == "ARMATURE"), key=lambda o: o.name)
    found: dict = {"version": bpy.app.version_string, "people": [o.name for o in people], "joints": [], "vertices": []}
    found["last"] = max(action.frame_range[1] for action in bpy.data.actions) - first
    for frame in frames:
        bpy.context.scene.frame_set(first + frame)
        graph = bpy.context.evaluated_depsgraph_get()
        found["joints"].append([{bone.name: y_up(o.matrix_world @ bone.head) for bone in o.pose.bones} for o in people])
        skins = [[m for m in bpy.data.objects if m.type == "MESH" and m.parent == o] for o in people]
        meshes = [m[0].evaluated_get(graph) for m in skins if m]
        found["vertices"].append([[y_up(m.matrix_world @ v.co) for v in m.to_mesh().vertices] for m in meshes])
    return found


def main() -> None:
    path, out, frames = sys.argv[1:]
    opened(path)
    Path(out).write_text(
        json.dumps(seen(0 if path.endswith(".glb") else 1, [int(f) for f in frames.split(",")])), encoding="utf-8"
    )


main()
