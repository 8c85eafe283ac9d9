"""Body models: from shape numbers, rotations and pelvis poses to joints and vertices.

A body is read from an npz or pickled file with SMPL's keys. Hands, jaw and eyes stay at rest: each joint beyond the 22
moves rigidly with its nearest ancestor among them, to whose skinning weights its own are added.
"""

from __future__ import annotations

import contextlib
import math
import zipfile
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from magnet.body.family import body_files, family_of, title
from magnet.body.joints import PARENTS
from magnet.body.pickles import pickled_arrays
from magnet.files import DAMAGED, load_npz
from magnet.motion.scene import BODY_JOINTS, Scene
from magnet.precision import cpu_by_default
from magnet.waiting import constant

SHAPES = 10
"""Shape numbers of a body; a file may have more, which are ignored."""
MOST_SHAPE = 12.0
"""Standard deviations that no shape number is off the mean; fits of real people stay below 6."""


def _depths() -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
    """For each depth below the pelvis: its joints, and the position of each one's parent one level above."""
    depths: list[tuple[tuple[int, ...], tuple[int, ...]]] = []
    above: tuple[int, ...] = (0,)
    while above:
        here = tuple(j for j, parent in enumerate(PARENTS) if parent in above)
        if here:
            depths.append((here, tuple(above.index(PARENTS[j]) for j in here)))
        above = here
    return tuple(depths)


DEPTHS = _depths()
BY_DEPTH = (0, *(j for joints, _ in DEPTHS for j in joints))
FROM_DEPTH = tuple(BY_DEPTH.index(j) for j in range(BODY_JOINTS))


@lru_cache(maxsize=8)
def _tree(device: torch.device) -> tuple[Tensor, Tensor, tuple[Tensor, ...], Tensor]:
    """Indices of `bone_chain`: each joint's parent; rotations by depth; each depth's parents; from depths to joints."""
    with torch.inference_mode(False):  # or training, later, could not use them
        by_depth = torch.tensor(BY_DEPTH[1:], device=device) - 1
        ups = tuple(torch.tensor(up, device=device) for _, up in DEPTHS)
        return torch.tensor(PARENTS[1:], device=device), by_depth, ups, torch.tensor(FROM_DEPTH, device=device)


class Body(nn.Module):
    """A frozen body model; its tensors are float32 buffers.

    Checkpoints do not store them, because a user's body may not be redistributed, but only the `id`. Input in float64
    is computed in float64, input in half precision in float32.

    Args:
        id: name that scenes and checkpoints carry, so that shape numbers are never used with another body.
        J_template: (22, 3) rest joints at zero shape, metres.
        J_shapedirs: (22, 3, 10) metres that one unit of each shape number adds.
        v_template, shapedirs: (V, 3), (V, 3, 10), the same for the vertices.
        weights: (V, 22) skinning weights; rows sum to one.
        faces: (F, 3) int.
        posedirs: (V, 3, 189) pose correctives, linear in the 21 rotations minus the identity, or None.
        family: "smpl", "smplh" or "smplx", by the file's tree of joints; "": another tree, or unknown.
    """

    J_template: Tensor
    J_shapedirs: Tensor
    v_template: Tensor
    shapedirs: Tensor
    weights: Tensor
    faces: Tensor
    posedirs: Tensor | None

    def __init__(
        self,
        id: str,
        J_template: Tensor,
        J_shapedirs: Tensor,
        v_template: Tensor,
        shapedirs: Tensor,
        weights: Tensor,
        faces: Tensor,
        posedirs: Tensor | None = None,
        family: str = "",
    ) -> None:
        super().__init__()
        self.id, self.family = id, family
        tensors = {
            "J_template": J_template,
            "J_shapedirs": J_shapedirs,
            "v_template": v_template,
            "shapedirs": shapedirs,
            "weights": weights,
            "faces": faces,
            "posedirs": posedirs,
        }
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor, persistent=False)

    def rest_joints(self, betas: Tensor) -> Tensor:
        """Joints in the rest pose, in the body file's own frame. (..., 10) -> (..., 22, 3) metres"""
        betas = _wide(betas)
        return self.J_template.to(betas) + _blend(self.J_shapedirs, betas)

    def forward_kinematics(self, body_rot: Tensor, T_world_root: Tensor, betas: Tensor) -> Tensor:
        """World joints. (..., 21, 3, 3), (..., 4, 4), (..., 10) -> (..., 22, 3) metres

        Leading dimensions broadcast. Differentiable in all three.
        """
        return self.bone_chain(body_rot, T_world_root, self.rest_joints(betas))[1]

    def joints(self, scene: Scene) -> Tensor:
        """World joints of everybody in a scene. -> (B, T, P, 22, 3) metres; absent agents stand at the origin.

        Raises:
            ValueError: the scene's shapes belong to another body.
        """
        self._check(scene)
        return self.forward_kinematics(scene.body_rot, scene.T_world_root, scene.betas[:, None])

    def vertices(self, scene: Scene) -> Tensor:
        """World vertices of everybody in a scene, by linear blend skinning. -> (B, T, P, V, 3) metres

        Raises:
            ValueError: the scene's shapes belong to another body.
        """
        self._check(scene)
        rest_joints = self.rest_joints(scene.betas[:, None])
        R, t = self.bone_chain(scene.body_rot, scene.T_world_root, rest_joints)
        rest = self.v_template.to(rest_joints) + _blend(self.shapedirs, scene.betas[:, None].to(rest_joints))
        with _exact(R):
            if self.posedirs is not None:
                bend = _wide(scene.body_rot) - torch.eye(3, dtype=R.dtype, device=R.device)
                rest = rest + _blend(self.posedirs, bend.flatten(-3))
            # A joint moves a point x of the rest body to R (x - rest joint) + t = R x + shift.
            shift = t - (R @ rest_joints[..., None])[..., 0]
            # Vertices last: every product below runs along long rows.
            blended = torch.cat([R.flatten(-2), shift], dim=-1).transpose(-1, -2) @ self.weights.to(R).T
            turn = blended[..., :9, :].unflatten(-2, (3, 3))
            moved = (turn * rest.transpose(-1, -2)[..., None, :, :]).sum(-2) + blended[..., 9:, :]
            return moved.transpose(-1, -2).contiguous()

    def _check(self, scene: Scene) -> None:
        if scene.body != self.id:
            raise ValueError(
                f"the scene's shape numbers belong to body {scene.body!r}, but this body is {self.id!r}; load the "
                f"scene's own body with load_body, or fit this one to the scene's joints with fit_body"
            )

    def bone_chain(self, body_rot: Tensor, T_world_root: Tensor, rest_joints: Tensor) -> tuple[Tensor, Tensor]:
        """World rotations (..., 22, 3, 3) and positions (..., 22, 3), in one batched product per level of the tree."""
        body_rot, T_world_root = _wide(body_rot), _wide(T_world_root)
        parents, by_depth, ups, order = _tree(rest_joints.device)
        # By tensors that are kept: lists of indices would become tensors at every call, and once more for gradients.
        offset = (rest_joints[..., 1:, :] - rest_joints.index_select(-2, parents))[..., None]
        # NumPy's, because torch's imports SymPy: 34 MiB.
        lead = np.broadcast_shapes(body_rot.shape[:-3], T_world_root.shape[:-2], rest_joints.shape[:-2])
        poses = math.prod(lead)
        step = torch.cat([body_rot.expand(*lead, -1, 3, 3), offset.expand(*lead, -1, 3, 1)], dim=-1)
        # Joints first, so that each depth is one batch of small matrices.
        steps = step.view(poses, len(by_depth), 12).index_select(1, by_depth).transpose(0, 1).reshape(-1, 3, 4)
        with _exact(body_rot):
            level = T_world_root[..., :3, :].expand(*lead, 3, 4).reshape(1, poses, 3, 4)
            levels, place = [level], constant((0.0, 0.0, 0.0, 1.0), level)
            for up, mine in zip(ups, steps.split([len(up) * poses for up in ups]), strict=True):
                above = level.index_select(0, up).view(-1, 3, 4)
                level = torch.baddbmm(above * place, above[..., :3], mine).view(len(up), poses, 3, 4)
                levels.append(level)
            whole = torch.cat(levels).index_select(0, order).transpose(0, 1).view(*lead, len(order), 3, 4)
            return whole[..., :3], whole[..., 3]


def _exact(like: Tensor) -> torch.autocast:
    """No mixed precision: it would round a chain of matrix products to centimetres."""
    return torch.autocast(like.device.type, enabled=False)


def _wide(tensor: Tensor) -> Tensor:
    return tensor if tensor.dtype == torch.float64 else tensor.float()


def _blend(directions: Tensor, amounts: Tensor) -> Tensor:
    """Directions (N, 3, C) times amounts (..., C), summed. -> (..., N, 3)"""
    with _exact(amounts):
        flat = directions.flatten(0, 1).to(amounts)
        return (amounts @ flat.T).unflatten(-1, (directions.shape[0], 3))


# -- reading a file ----------------------------------------------------------------------------


@cpu_by_default
def load_body(which: str | Path = "open") -> Body:
    """The open body that ships with the package ("open"), or one from a file of SMPL, SMPL-H or SMPL-X: npz or pkl.

    No code in a pickle is run, and chumpy is not needed. The body's id is the file's `body_id`, or else made from its
    name: "smplx-neutral" of SMPLX_NEUTRAL.npz. Each call returns a new module; the file of "open" is read once.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, lacks a key, or a shape does not fit; says which.
    """
    with torch.inference_mode(False):  # Lightning tests in it, whose tensors no later fit could take a gradient through
        return Body(**(open_body_arrays() if str(which) == "open" else _read(Path(which))))


@lru_cache(maxsize=1)
def open_body_arrays() -> dict:
    with torch.inference_mode(False), resources.as_file(resources.files("magnet.body") / "open_body.npz") as path:
        return _read(path)


KEYS = ("v_template", "shapedirs", "weights", "kintree_table", "f")
WANTED = (*KEYS, "J_regressor", "J_template", "J_shapedirs", "posedirs", "body_id")


def _arrays(path: Path) -> dict[str, NDArray]:
    """The arrays in a file that make a body."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder; {_told(path)}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such body file; give the path of SMPL's or SMPL-X's npz or pkl, or 'open'")
    with path.open("rb") as file:
        zipped = file.read(2) == b"PK"
    if path.suffix.lower() == ".pkl" and not zipped:
        arrays, there = pickled_arrays(path, WANTED)
    else:
        arrays, there = _npz_arrays(path)
    missing = [key for key in KEYS if key not in arrays]
    if "J_regressor" not in arrays and not {"J_template", "J_shapedirs"} <= set(arrays):
        missing.append("J_regressor")
    if missing:
        has = ", ".join(sorted(there))
        raise ValueError(f"{path}: lacks {', '.join(missing)}; it has {has}; expected SMPL's or SMPL-X's npz or pkl")
    return arrays


def _npz_arrays(path: Path) -> tuple[dict[str, NDArray], set[str]]:
    """Wanted arrays of an npz without pickles, and all its keys."""
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not a readable body file (no npz archive, or cut short); download or copy it again")
    name = ""
    try:
        with load_npz(path, WANTED) as file:
            there = set(file.files)
            arrays = {}
            for name in WANTED:
                if name in there:
                    arrays[name] = file[name]
    except (OSError, ValueError, *DAMAGED) as error:
        at = f" at key {name!r}" if name else ""
        raise ValueError(
            f"{path}: not a readable body file{at} ({error}); expected SMPL-X's npz with plain numeric arrays "
            f"(pickles are refused); download or copy it again"
        ) from error
    return arrays, there


def _told(folder: Path, most: int = 8) -> str:
    """Which bodies a folder holds, and how to give one, for a message."""
    found = []
    for path in body_files(folder):
        with contextlib.suppress(ValueError, OSError, LookupError):
            found.append((path, title(family_of(_arrays(path)["kintree_table"][0]))))
    if not found:
        return "it holds no body files (SMPL's or SMPL-X's npz or pkl); give the path of one"
    listed = ", ".join(f"{path.relative_to(folder)} ({what})" for path, what in found[:most])
    more = f" and {len(found) - most} more" if len(found) > most else ""
    neutral = next((path for path, _ in found if "neutral" in path.as_posix().lower()), found[0][0])
    return f"it holds {listed}{more}; give one of them, such as {neutral}, and the folder itself as --bodies"


def _check_shapes(path: Path, arrays: dict[str, NDArray]) -> None:
    V, columns = arrays["v_template"].shape[:1], arrays["shapedirs"].shape[-1:]
    K = arrays["kintree_table"].shape[-1:]
    if (columns or (0,))[0] < SHAPES or (K or (0,))[0] < BODY_JOINTS:
        raise ValueError(
            f"{path}: shapedirs {arrays['shapedirs'].shape} and kintree_table {arrays['kintree_table'].shape}: "
            f"expected (V, 3, at least {SHAPES}) and (2, at least {BODY_JOINTS})"
        )
    J_columns = arrays["J_shapedirs"].shape[-1:] if "J_shapedirs" in arrays else columns
    expected = {
        "v_template": (*V, 3),
        "shapedirs": (*V, 3, *columns),
        "weights": (*V, *K),
        "kintree_table": (2, *K),
        "f": (*arrays["f"].shape[:1], 3),
        "J_regressor": (*K, *V),
        "J_template": (*K, 3),
        "J_shapedirs": (*K, 3, *J_columns),
        "posedirs": (*V, 3, 9 * (K[0] - 1)),
    }
    for name, want in expected.items():
        if name in arrays and arrays[name].shape != want:
            raise ValueError(f"{path}: {name} is {arrays[name].shape}, expected {want}")
    if (J_columns or (0,))[0] < SHAPES:
        raise ValueError(f"{path}: J_shapedirs is {arrays['J_shapedirs'].shape}, expected at least {SHAPES} columns")


def _read(path: Path) -> dict[str, object]:
    arrays = _arrays(path)
    body_id = str(arrays.pop("body_id", path.stem.lower().replace("_", "-")))
    for name, array in arrays.items():
        if array.dtype.kind not in "iuf":
            raise ValueError(f"{path}: {name} holds {array.dtype}, expected numbers")
    _check_shapes(path, arrays)
    V, faces = len(arrays["v_template"]), arrays["f"].astype(np.int64)
    if faces.size and (faces.min() < 0 or faces.max() >= V):
        raise ValueError(f"{path}: f names vertices {faces.min()} to {faces.max()}, but there are {V}")
    double = {name: array.astype(np.float64) for name, array in arrays.items() if name not in ("f", "kintree_table")}
    bad = [name for name, array in double.items() if not np.isfinite(array).all()]
    if bad:
        raise ValueError(f"{path}: {', '.join(bad)} hold NaN or infinity; download or copy it again")
    shapedirs = double["shapedirs"][..., :SHAPES]
    if "J_template" in double and "J_shapedirs" in double:
        J_template, J_shapedirs = double["J_template"], double["J_shapedirs"][..., :SHAPES]
    else:
        J_template = double["J_regressor"] @ double["v_template"]
        J_shapedirs = np.einsum("kv,vcs->kcs", double["J_regressor"], shapedirs)
    posedirs = double.get("posedirs")
    if posedirs is not None:
        posedirs = posedirs[..., : 9 * (BODY_JOINTS - 1)]
    fields = {
        "J_template": J_template[:BODY_JOINTS],
        "J_shapedirs": J_shapedirs[:BODY_JOINTS],
        "v_template": double["v_template"],
        "shapedirs": shapedirs,
        "weights": _fold(path, double["weights"], arrays["kintree_table"]),
        "posedirs": posedirs,
    }
    tensors = {name: None if a is None else torch.from_numpy(a.astype(np.float32)) for name, a in fields.items()}
    family = family_of(arrays["kintree_table"][0].astype(np.int64).tolist())
    return {"id": body_id, "faces": torch.from_numpy(faces), "family": family, **tensors}


def _fold(path: Path, weights: NDArray, kintree_table: NDArray) -> NDArray:
    """Weights of joints beyond the 22, added to their nearest ancestor among them. (V, K) -> (V, 22)"""
    parents = kintree_table[0].astype(np.int64)
    parents[0] = -1  # files write 2^32 - 1
    if tuple(parents[:BODY_JOINTS]) != PARENTS:
        raise ValueError(f"{path}: the first 22 parents are {parents[:BODY_JOINTS].tolist()}, expected {list(PARENTS)}")
    folded = np.zeros((len(weights), BODY_JOINTS))
    for joint in range(len(parents)):
        ancestor = joint
        while ancestor >= BODY_JOINTS:
            if not 0 <= parents[ancestor] < ancestor:
                raise ValueError(f"{path}: joint {ancestor} has parent {parents[ancestor]}, expected an earlier joint")
            ancestor = int(parents[ancestor])
        folded[:, ancestor] += weights[:, joint]
    return folded
