"""Scenes as VRM animations, which play on any VRM avatar: bones by their roles, no mesh, a file a person."""

from __future__ import annotations

from pathlib import Path

from magnet.body import Body
from magnet.export.bones import bone_names
from magnet.export.bvh import paths_of
from magnet.export.glb import FLOAT, Gltf, animation, frame_times, moved, slots_to_write, standing
from magnet.files import whole
from magnet.motion.scene import BODY_JOINTS, Scene

EXTENSION = "VRMC_vrm_animation"


def save_vrma(scene: Scene, path: str | Path, body: Body) -> list[Path]:
    """Write the people of one scene (B = 1) as VRM animations (VRMC_vrm_animation 1.0), a keyframe for every frame.

    Metres, y up; at rest everybody stands in the T pose and faces +z. Players scale the path of the hips by how high an
    avatar's are, so couples of other heights end nearer to or farther from each other.

    Returns:
        The paths written: out_person0.vrma ..., or the path for one person.

    Raises:
        ValueError: more than one scene, nobody present, no frames, or another body's.
    """
    slots = slots_to_write(scene, body)
    paths = paths_of(Path(path), slots)
    for slot, place in zip(slots, paths, strict=True):
        gltf = Gltf()
        times = gltf.accessor(frame_times(scene.frames, scene.fps), FLOAT, "SCALAR", bounds=True)
        hips = gltf.bones(standing(body, scene.betas[0, slot].detach().cpu().float()), "vrm")
        gltf.document["scenes"][0]["nodes"].append(hips)
        clip = animation("motion")
        gltf.animate(clip, times, range(hips, hips + BODY_JOINTS), *moved(scene, slot))
        gltf.document["animations"].append(clip)
        roles = {name: {"node": hips + j} for j, name in enumerate(bone_names("vrm"))}
        gltf.document["extensionsUsed"] = [EXTENSION]
        gltf.document["extensions"] = {EXTENSION: {"specVersion": "1.0", "humanoid": {"humanBones": roles}}}
        with whole(place) as part:
            part.write_bytes(gltf.packed())
    return paths
