"""An add-on for Blender (4.2 and later): selected people go on together, get a partner, or new ones come from nothing.

Selected armatures are written as GLB, `magnet` runs as a process of its own while Blender goes on, and what it made is
brought in as new objects in a collection of their own. docs/blender.md shows how to install and use it.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import bpy

bl_info = {
    "name": "magnet: people who move together",
    "location": "3D Viewport > Sidebar > magnet",
    "blender": (4, 2, 0),
    "category": "Animation",
}

RATE = 30.0  # frames a second of what magnet makes
TEXT = "magnet"  # the text in Blender's text editor that holds what the program said


class Way(NamedTuple):
    """Something that magnet does with people."""

    label: str
    description: str
    words: str  # of the command, behind the files
    least: int  # people who must be selected
    until_now: bool = False  # read up to the current frame, and not to the scene's last
    frames: bool = False  # frames are made behind those that are read


WAYS = {
    "go_on": Way("Go on", "Selected people go on after the current frame", "--task joint_future", 1, True, True),
    "answer": Way(
        "Answer", "The active person answers the others from now on", "--task motion_control --task.target [0]", 2
    ),
    "partner": Way("Add a partner", "Somebody new, from the first frame to the last", "--task partner_inpainting", 1),
    "again": Way("Make anew", "The active person anew, to fit the others", "--task partner_inpainting", 2),
    "new": Way("From nothing", "New people, whoever is selected", "", 0, True, True),
    "refine": Way("Refine", "Who is selected, out of each other's bodies, with feet that stand", "--apart firm", 1),
}


class Settings(bpy.types.PropertyGroup):
    way: bpy.props.EnumProperty(name="", items=[(name, way.label, way.description) for name, way in WAYS.items()])
    frames: bpy.props.IntProperty(name="Frames", description="Frames of this scene to make", default=120, min=1)
    people: bpy.props.IntProperty(name="People", description="New people", default=2, min=1, max=200, soft_max=4)
    seed: bpy.props.IntProperty(name="Seed", description="Another seed, another result", default=1, min=0)
    characters: bpy.props.BoolProperty(name="On these characters", description="On copies of them", default=True)
    hide: bpy.props.BoolProperty(name="Hide what was selected", description="Copies stand in it", default=True)
    more: bpy.props.StringProperty(name="Options", description="Of the command, such as --sampler.settle firm")


class Preferences(bpy.types.AddonPreferences):
    bl_idname = __name__
    program: bpy.props.StringProperty(name="magnet", description="As CLONE/.venv/bin/magnet", subtype="FILE_PATH")

    def draw(self, context: Any) -> None:
        self.layout.prop(self, "program")
        self.layout.label(text=f"empty: {shutil.which('magnet') or 'magnet, which is not on the path'}")


# -- what is asked of the program ---------------------------------------------------------------


def commands(program: str, files: list[str], settings: Any, context: int, fps: float, folder: Path) -> list[list[str]]:
    """Commands that run one after the other, for people in files; `context` frames at rate `fps` lead to the last."""
    way, name = WAYS[settings.way], settings.way
    more = shlex.split(settings.more.replace("\\", "\\\\"))  # a \ stays one, for paths on Windows
    made = folder / ("made.npz" if settings.characters and files else "made.glb")
    if name == "refine":
        first = [program, "refine", *files, str(made), *way.words.split(), *more]
    else:
        first = [program, "predict", *files, "--out", str(made), "--seed", str(settings.seed), *way.words.split()]
        first += ["--people", str(settings.people)] * (name == "new")
        first += ["--people", str(len(files) + 1)] * (name == "partner")
        first += ["--frames", str(max(round(settings.frames * RATE / fps), 1))] * way.frames
        first += ["--context", str(round((context - 1) * RATE / fps) + 1)] * (name == "answer")
        first += more
    if made.suffix == ".glb":
        return [first]
    rigs = [*files, files[-1]] if name == "partner" else files
    return [first, [program, "export", str(made), str(folder / "made.glb"), "--rig", *rigs]]


class Run:
    """Commands that run one after the other as processes of their own."""

    def __init__(self, commands: list[list[str]], folder: Path) -> None:
        self.left, self.log, self.process = list(commands), folder / "log.txt", None

    def done(self) -> bool:
        """Begin the next command where none runs; True once all have ended. RuntimeError: one failed, and why."""
        if self.process is not None:
            if self.process.poll() is None:
                return False
            if self.process.returncode:
                raise RuntimeError((self.said() or [f"magnet ended with {self.process.returncode}"])[-1])
            self.process = None
        if not self.left:
            return True
        # Without what would send another Python to Blender's own packages; on Windows, without a window.
        env = {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "PYTHONPATH")}
        how = {"env": env, "cwd": self.log.parent, "creationflags": getattr(subprocess, "CREATE_NO_WINDOW", 0)}
        with self.log.open("a", encoding="utf-8") as log:
            try:
                self.process = subprocess.Popen(self.left.pop(0), stdout=log, stderr=subprocess.STDOUT, **how)
            except OSError as error:
                raise RuntimeError(f"{error}: say in the add-on's preferences where magnet is") from error
        return False

    def said(self) -> list[str]:
        """Lines that were said so far; of one that was written over, what it says now."""
        text = self.log.read_text(encoding="utf-8", errors="replace") if self.log.exists() else ""
        return [line.strip().split("\r")[-1].strip() for line in text.split("\n") if line.strip()]

    def stop(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            self.process.wait()


# -- to and from Blender ------------------------------------------------------------------------


def armature_of(thing: Any) -> Any:
    return thing if thing is None or thing.type == "ARMATURE" else thing.find_armature()


def people_of(context: Any) -> list[Any]:
    """Armatures that are selected, or whose mesh is; that of the active object first, the others by name."""
    found = {armature_of(thing) for thing in context.selected_objects} - {None}
    first = armature_of(context.active_object)
    return sorted(found, key=lambda thing: (thing != first, thing.name))


def meshes_of(context: Any, person: Any) -> list[Any]:
    """Meshes that hang on an armature or that it bends: those that are seen or, where none is, all."""
    below = set(person.children_recursive)
    meshes = [each for each in context.scene.objects if each.type == "MESH"]
    own = [each for each in meshes if each in below or each.find_armature() == person]
    return [each for each in own if each.visible_get()] or own


def loose(person: Any) -> bool:
    """Whether deform bones hang on controls and not on each other, as Rigify's do: no copy could bend as one."""
    bones = [bone for bone in person.data.bones if bone.use_deform and bone.parent is not None]
    return sum(not any(above.use_deform for above in bone.parent_recursive) for bone in bones) > 1


def supported(operator: Any, **options: Any) -> dict[str, Any]:
    """Those options that this Blender's operator has."""
    return {name: value for name, value in options.items() if name in operator.get_rna_type().properties}


def write(context: Any, person: Any, path: Path, first: int, last: int) -> None:
    """A GLB of one armature and its meshes in these frames, as it is seen: constraints and controls included."""
    scene, things = context.scene, [person, *meshes_of(context, person)]
    before = scene.frame_start, scene.frame_end, scene.frame_current
    between, all_of_it = scene.frame_subframe, bpy.data.collections.new("magnet")
    scene.collection.children.link(all_of_it)  # of a collection what is hidden is written, too; of a selection not
    try:
        for thing in things:
            all_of_it.objects.link(thing)
        scene.frame_start, scene.frame_end = first, last
        save = bpy.ops.export_scene.gltf
        options = supported(
            save,
            export_animation_mode="SCENE",
            export_anim_scene_split_object=False,
            export_anim_slide_to_zero=True,
            export_force_sampling=True,
            export_optimize_animation_size=False,
            export_morph_animation=False,
            export_def_bones=any(bone.use_deform for bone in person.data.bones),
        )
        save(filepath=str(path), export_format="GLB", collection=all_of_it.name, **options)
    finally:
        bpy.data.collections.remove(all_of_it)
        scene.frame_start, scene.frame_end = before[:2]
        scene.frame_set(before[2], subframe=between)


def curves(action: Any) -> list[Any]:
    """An action's curves, in Blenders with layers and without."""
    strips = [strip for layer in getattr(action, "layers", ()) for strip in layer.strips]
    bags = [bag for strip in strips for bag in strip.channelbags] if hasattr(action, "layers") else [action]
    return [curve for bag in bags for curve in bag.fcurves]


def delay(action: Any, frames: float) -> None:
    """Move an action's keyframes."""
    for curve in curves(action):
        for point in curve.keyframe_points:
            point.co_ui.x += frames  # with its handles


def bring_in(context: Any, files: list[Path], names: list[str], first: int, metres: bool) -> list[Any]:
    """New armatures of GLB files, whose motion begins at frame `first`, in a collection of their own.

    names: of the armatures, in the order of the people; others keep theirs.
    metres: the files hold metres, and not what Blender wrote.
    """
    collection = bpy.data.collections.new("magnet")
    context.scene.collection.children.link(collection)
    new, actions = [], set(bpy.data.actions)
    load, unit = bpy.ops.import_scene.gltf, context.scene.unit_settings
    for path in files:
        before, scale = set(bpy.data.objects), unit.scale_length
        unit.scale_length = scale if metres else 1.0  # the importer goes by it, the exporter does not
        load(filepath=str(path), **supported(load, bone_heuristic="BLENDER", disable_bone_shape=True))
        unit.scale_length = scale
        brought = [thing for thing in bpy.data.objects if thing not in before]
        for thing in brought:
            for home in list(thing.users_collection):
                if home.name != "glTF_not_exported":  # the importer's own, hidden
                    home.objects.unlink(thing)
                    collection.objects.link(thing)
            if thing.animation_data is not None:
                for track in list(thing.animation_data.nla_tracks):
                    thing.animation_data.nla_tracks.remove(track)
        people = [thing for thing in brought if thing.type == "ARMATURE"]
        new += sorted(people, key=lambda thing: (len(thing.name.split(".")[0]), thing.name))  # person_2, person_10
    for thing, name in zip(new, names, strict=False):
        thing.name = name  # with a number behind it, for the name is taken
    last = 0.0
    for action in bpy.data.actions:
        if action not in actions:
            delay(action, first)
            last = max(last, action.frame_range[1])
    context.scene.frame_end = max(context.scene.frame_end, round(last))
    return new


# -- what is pressed ----------------------------------------------------------------------------


def program_of(context: Any) -> str:
    """The program that the preferences name, else the one on the path."""
    addon = context.preferences.addons.get(__name__)
    said = addon.preferences.program if addon is not None else ""
    return bpy.path.abspath(said) if said else shutil.which("magnet") or "magnet"


class MAGNET_OT_make(bpy.types.Operator):
    """Let magnet do what is chosen; Esc stops it"""

    bl_idname, bl_label, bl_options = "magnet.make", "Make", {"REGISTER", "UNDO"}

    def begin(self, context: Any) -> str:
        """Write what is selected and start the program. -> what is wrong, or nothing"""
        scene = context.scene
        settings, way = scene.magnet, WAYS[scene.magnet.way]
        people = people_of(context) if way.least else []
        if len(people) < way.least:
            return f"{way.label}: select {way.least} or more armatures; {len(people)} are selected"
        if way.least > 1 and people[0] != armature_of(context.active_object):
            return f"{way.label}: the active object is none of who is selected; click somebody last with Shift"
        self.first = scene.frame_start if way.least else scene.frame_current
        last = scene.frame_current if way.until_now else scene.frame_end
        if way.least and last <= self.first:
            return f"{way.label}: reads the frames {self.first} to {last}; it needs two or more"
        fps, now = scene.render.fps / scene.render.fps_base, scene.frame_current
        if settings.way == "answer" and not self.first + fps / 10 <= now <= last - fps / 7:
            return f"{way.label}: begins in the current frame, {now}, which must lie well within {self.first} to {last}"
        if apart := [person.name for person in people if settings.characters and loose(person)]:
            return f"{apart[0]}: its deform bones hang on controls (Rigify?); leave On these characters out"
        if context.mode != "OBJECT":  # meshes in edit mode cannot be written
            bpy.ops.object.mode_set(mode="OBJECT")
        # Their names: while the program runs objects may go, or be others after an undo.
        self.names, self.metres = [person.name for person in people], not (settings.characters and people)
        self.copied = [each.name for who in people for each in (who, *who.children_recursive, *meshes_of(context, who))]
        self.folder = Path(tempfile.mkdtemp(prefix="magnet-"))
        files = [str(self.folder / f"person{number}.glb") for number in range(len(people))]
        try:
            asked = commands(program_of(context), files, settings, now - self.first + 1, fps, self.folder)
            for person, file in zip(people, files, strict=True):
                write(context, person, Path(file), self.first, last)
        except (RuntimeError, ValueError) as error:  # Blender's exporter; a quotation in Options that does not end
            shutil.rmtree(self.folder, ignore_errors=True)
            return f"{way.label}: {error}"
        self.run = Run(asked, self.folder)
        return ""

    def end(self, context: Any) -> set[str]:
        """Bring in what was made."""
        try:
            if context.mode != "OBJECT":
                bpy.ops.object.mode_set(mode="OBJECT")
            old = [thing for thing in context.view_layer.objects if thing.name in self.copied]
            new = bring_in(context, sorted(self.folder.glob("made*.glb")), self.names, self.first, self.metres)
        finally:
            self.clear()
        for thing in list(context.view_layer.objects):
            thing.select_set(thing in new)
        context.view_layer.objects.active = new[0] if new else None
        for thing in old if context.scene.magnet.hide else ():
            thing.hide_set(True)
        self.report({"INFO"}, f"{len(new)} people from frame {self.first} on; notes: the text {TEXT}")
        return {"FINISHED"}

    def clear(self) -> None:
        """Stop the program if it runs, and keep what it said."""
        self.run.stop()
        said = "\n".join(self.run.said())
        shutil.rmtree(self.folder, ignore_errors=True)
        (bpy.data.texts.get(TEXT) or bpy.data.texts.new(TEXT)).from_string(said)

    def failed(self, why: str, level: str = "ERROR") -> set[str]:
        self.report({level}, why)
        return {"CANCELLED"}

    def execute(self, context: Any) -> set[str]:
        """All of it at once, for scripts: Blender waits."""
        if wrong := self.begin(context):
            return self.failed(wrong)
        try:
            while not self.run.done():
                self.run.process.wait()
        except RuntimeError as error:
            self.clear()
            return self.failed(str(error))
        return self.end(context)

    def invoke(self, context: Any, event: Any) -> set[str]:
        """Begin, and look now and then whether it is done."""
        if wrong := self.begin(context):
            return self.failed(wrong)
        self.timer = context.window_manager.event_timer_add(0.2, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Any, event: Any) -> set[str]:
        if event.type not in ("TIMER", "ESC"):
            return {"PASS_THROUGH"}
        try:
            if event.type == "ESC":
                raise RuntimeError("magnet was stopped")
            done = self.run.done()
        except RuntimeError as error:
            self.leave(context)
            self.clear()
            return self.failed(str(error), "WARNING" if event.type == "ESC" else "ERROR")
        context.workspace.status_text_set(f"magnet (Esc stops it): {(self.run.said() or [''])[-1]}")
        if not done:
            return {"PASS_THROUGH"}
        self.leave(context)
        return self.end(context)

    def cancel(self, context: Any) -> None:
        """Blender ends, or opens another file: the program ends, too."""
        self.clear()

    def leave(self, context: Any) -> None:
        context.window_manager.event_timer_remove(self.timer)
        context.workspace.status_text_set(None)


class MAGNET_PT_panel(bpy.types.Panel):
    bl_label, bl_idname = "magnet", "MAGNET_PT_panel"
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "magnet"

    def draw(self, context: Any) -> None:
        settings, layout, way = context.scene.magnet, self.layout, WAYS[context.scene.magnet.way]
        layout.prop(settings, "way")
        layout.label(text=way.description)
        if way.least:
            names = [person.name for person in people_of(context)]
            layout.label(text=", ".join(names) or "nobody is selected", icon="ARMATURE_DATA")
        else:
            layout.prop(settings, "people")
        if way.frames:
            layout.prop(settings, "frames")
        for name in ("seed", "characters", "hide", "more") if way.least else ("seed", "more"):
            layout.prop(settings, name)
        layout.operator("magnet.make", text=way.label, icon="PLAY")


CLASSES = (Settings, Preferences, MAGNET_OT_make, MAGNET_PT_panel)


def register() -> None:
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.magnet = bpy.props.PointerProperty(type=Settings)


def unregister() -> None:
    del bpy.types.Scene.magnet
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
