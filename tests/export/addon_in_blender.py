"""Run by Blender's Python: the add-on does each of its ways with the people of a file, as somebody at a screen would.

    python addon_in_blender.py ADDON.py PROGRAM DUO.glb OUT.json

What it says: of each way the new people, when their motion begins and ends, and how far each is from whom it copies.
"""

import json
import sys
from importlib.util import module_from_spec, spec_from_file_location

import bpy

FIRST, NOW, LAST = 5, 32, 40


def select(*names):
    for thing in bpy.context.view_layer.objects:
        thing.hide_set(False)
        thing.select_set(thing.name in names)
    bpy.context.view_layer.objects.active = bpy.data.objects.get(names[0]) if names else None


def pelvis(thing, frame):
    bpy.context.scene.frame_set(frame)
    return (thing.matrix_world @ thing.pose.bones["pelvis"].head).copy()


def pressed(settings, way, *names, characters=False, more="--sampler.steps 2", now=NOW, hidden=(), **active):
    """What came of a press of the button, or why nothing did."""
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = FIRST, LAST
    scene.frame_set(now)
    if bpy.context.mode == "OBJECT":
        select(*names)
    if active:
        bpy.context.view_layer.objects.active = None
    for name in hidden:
        bpy.data.objects[name].hide_set(True)
    settings.way, settings.characters, settings.more, settings.frames = way, characters, more, 24
    before = set(bpy.data.objects)
    try:
        bpy.ops.magnet.make()
    except RuntimeError as error:
        return {"error": str(error), "left": sorted(thing.name for thing in set(bpy.data.objects) - before)}
    new = list(bpy.context.selected_objects)
    gone = sorted(name for name in names if bpy.data.objects[name].hide_get())
    select(*names)
    return {
        "new": [thing.name for thing in new],
        "frames": [[round(frame, 3) for frame in thing.animation_data.action.frame_range] for thing in new],
        "collection": [thing.users_collection[0].name for thing in new],
        "hidden": gone,
        "meshes": [sum(each.type == "MESH" for each in thing.children_recursive) for thing in new],
        "end": scene.frame_end,
        "away": {
            name: [(pelvis(thing, frame) - pelvis(bpy.data.objects[name], frame)).length for frame in (FIRST, 17, NOW)]
            for thing in new
            for name in names
            if thing.name.split(".")[0] == name
        },
        "said": bpy.data.texts["magnet"].as_string(),
    }


def worn(thing):
    return next(each for each in thing.children_recursive if each.type == "MESH")


def unlike(scene, one, two):
    """Scenes as animators have them: in edit mode, with what is hidden or apart, in another unit."""
    person, found = bpy.data.objects[one], {}
    body, home = worn(person), person.users_collection[0]
    for name, now in (("before", FIRST - 1), ("late", LAST)):
        found[name] = pressed(scene.magnet, "answer", one, two, now=now)
    found["not_active"] = pressed(scene.magnet, "again", one, two, active=None)
    found["quotes"] = pressed(scene.magnet, "go_on", one, more="--ckpt_path 'my model")
    bpy.context.view_layer.objects.active = body
    bpy.ops.object.mode_set(mode="EDIT")
    found["edited"] = pressed(scene.magnet, "go_on", one, characters=True)
    found["mesh_hidden"] = pressed(scene.magnet, "go_on", one, characters=True, hidden=[body.name])
    found["armature_hidden"] = pressed(scene.magnet, "go_on", body.name, characters=True, hidden=[one])
    body.parent = None
    found["apart"] = pressed(scene.magnet, "go_on", one, characters=True)
    away = bpy.data.collections.new("away")
    scene.collection.children.link(away)
    home.objects.unlink(person)
    away.objects.link(person)
    bpy.context.view_layer.layer_collection.children["away"].exclude = True
    found["excluded"] = pressed(scene.magnet, "go_on", body.name, characters=True)
    away.objects.unlink(person)
    home.objects.link(person)
    scene.unit_settings.scale_length = 0.01
    for name in (one, two):
        bpy.data.objects[name].scale = (100.0,) * 3
    found["centimetres"] = pressed(scene.magnet, "go_on", two, one, characters=True)
    found["metres"] = pressed(scene.magnet, "go_on", two, one)
    scene.unit_settings.scale_length = 1.0
    for name in (one, two):
        bpy.data.objects[name].scale = (1.0,) * 3
    return found


def main(addon, program, duo, out):
    spec = spec_from_file_location("magnet_motion", addon)
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # where Blender looks for what its properties' types are
    spec.loader.exec_module(module)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    module.register()
    module.program_of = lambda context: program
    scene = bpy.context.scene
    scene.render.fps = 30
    bpy.ops.import_scene.gltf(filepath=duo)
    one, two = sorted(thing.name for thing in bpy.data.objects if thing.type == "ARMATURE")
    found = {"version": bpy.app.version_string, "people": [one, two]}
    found["go_on"] = pressed(scene.magnet, "go_on", one, two)
    found["characters"] = pressed(scene.magnet, "go_on", two, one, characters=True)
    found["answer"] = pressed(scene.magnet, "answer", one, two)
    found["partner"] = pressed(scene.magnet, "partner", two, characters=True)
    found["again"] = pressed(scene.magnet, "again", two, one)
    found["new"] = pressed(scene.magnet, "new")
    found["refine"] = pressed(scene.magnet, "refine", one, two, more="")
    found["nobody"] = pressed(scene.magnet, "go_on")
    found["wrong"] = pressed(scene.magnet, "go_on", one, more="--task.nonsense 3")
    found |= unlike(scene, one, two)
    arms = bpy.data.objects[one].data  # two deform bones hang on a control now
    for name in ("left_collar", "right_collar"):
        arms.bones[name].use_deform = True
        for above in arms.bones[name].parent_recursive:
            above.use_deform = False
    found["loose"] = pressed(scene.magnet, "go_on", one, characters=True)
    module.program_of = lambda context: "/no/such/magnet"
    found["absent"] = pressed(scene.magnet, "go_on", two)
    module.unregister()
    with open(out, "w", encoding="utf-8") as file:
        json.dump(found, file)


main(*sys.argv[1:])
