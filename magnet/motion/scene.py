"""`Scene`: the one record of motion, whatever its source."""

from __future__ import annotations

import builtins
import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from magnet.checks import require_number
from magnet.files import DAMAGED, load_npz, npz_path, save_npz

BODY_JOINTS = 22
"""The pelvis and the 21 body joints of SMPL-X; hands and face are not modelled."""

FPS = 30.0
"""Frames a second of what models are trained on, and so of what they take and make."""

SCENE_FORMAT = 1

NO_ROTATION = 1e-2
"""A matrix whose R^T R is further from 1 than this, in any number, is none that anything wrote in float32."""

TENSORS = ("body_rot", "T_world_root", "betas", "present", "valid", "given")
"""Fields of a scene that are tensors; the last two may be absent."""


@dataclass(frozen=True)
class Scene:
    """Several people moving together: B scenes of T frames with P agents, metres, y up.

    An absent agent (a free slot) has identity rotations, its pelvis at the origin and zero shape.

    Raises:
        ValueError: a tensor's shape does not fit the others.

    >>> scene = empty_scene(2, 60, 3, like=torch.zeros(()))  # 2 scenes of 60 frames with 3 slots, all free
    >>> scene.select([1]).slice(10, 30).pad_agents(4).T_world_root.shape
    torch.Size([1, 20, 4, 4, 4])
    """

    body_rot: Tensor  # (B, T, P, 21, 3, 3) rotation of each body joint relative to its parent
    T_world_root: Tensor  # (B, T, P, 4, 4) pose of the pelvis *joint* (not SMPL-X's transl) in the world
    betas: Tensor  # (B, P, 10) shape numbers of `body`
    present: Tensor  # (B, P) bool
    fps: float = FPS
    body: str = "open-1"  # id of the body model that `betas` belong to
    valid: Tensor | None = None  # (B, T) bool, False where a frame is padding or was masked; None: all good
    names: tuple[str, ...] = ()  # one label a scene, for reports
    given: Tensor | None = None  # (B, T, P) bool, frames that no model made, as what it was given; None: unsaid

    def __post_init__(self) -> None:
        for field in TENSORS:
            value = getattr(self, field)
            if not isinstance(value, Tensor) and not (value is None and field in ("valid", "given")):
                raise ValueError(f"{field}: got {type(value).__name__}, expected a tensor; torch.from_numpy makes one")
        shape = self.T_world_root.shape
        if len(shape) != 5 or shape[-2:] != (4, 4):
            raise ValueError(f"T_world_root: got {tuple(shape)}, expected (B, T, P, 4, 4)")
        B, T, P = shape[:3]
        expected = {"body_rot": (B, T, P, BODY_JOINTS - 1, 3, 3), "betas": (B, P, 10), "present": (B, P)}
        if self.valid is not None:
            expected["valid"] = (B, T)
        if self.given is not None:
            expected["given"] = (B, T, P)
        for field, want in expected.items():
            got = tuple(getattr(self, field).shape)
            if got != want:
                raise ValueError(f"{field}: got {got}, expected {want} for {B} scenes, {T} frames, {P} agents")
        require_number("fps", self.fps, over=0)
        for field, tensor in self.tensors().items():
            flags = field in ("present", "valid", "given")
            if (tensor.dtype == torch.bool) != flags or not (flags or tensor.is_floating_point()):
                raise ValueError(f"{field}: got {tensor.dtype}, expected {'bool' if flags else 'a float type'}")
        if self.names and len(self.names) != B:
            raise ValueError(f"names: got {len(self.names)} for {B} scenes")

    def __repr__(self) -> str:
        return f"{type(self).__name__} of {self.scenes} x {self.frames} frames, {self.agents} agents, {self.fps:g} fps"

    @property
    def scenes(self) -> int:
        return self.T_world_root.shape[0]

    @property
    def frames(self) -> int:
        return self.T_world_root.shape[1]

    @property
    def agents(self) -> int:
        """Number of slots, absent agents included."""
        return self.T_world_root.shape[2]

    @property
    def device(self) -> torch.device:
        return self.T_world_root.device

    def tensors(self) -> dict[str, Tensor]:
        """The tensor fields that are set, by name."""
        return {f: value for f in TENSORS if (value := getattr(self, f)) is not None}

    def replace(self, **changes: object) -> Self:
        """The scene with other fields.

        `given` is forgotten, unless named, where the number of scenes, frames or agents changes.
        """
        roots = changes.get("T_world_root")
        if isinstance(roots, Tensor) and self.given is not None and roots.shape[:3] != self.given.shape:
            changes.setdefault("given", None)
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]

    def to(self, device: torch.device | str | int) -> Self:
        """The same scene on another device."""
        return self.replace(**{name: value.to(device) for name, value in self.tensors().items()})

    def to_float32(self) -> Self:
        """The same scene in float32, as models take it."""
        floats = {name: value.float() for name, value in self.tensors().items() if value.dtype != torch.bool}
        return self if all(value is getattr(self, name) for name, value in floats.items()) else self.replace(**floats)

    def detached(self) -> Self:
        """The same scene, of which no gradient is taken."""
        floats = {name: value.detach() for name, value in self.tensors().items() if value.requires_grad}
        return self.replace(**floats) if floats else self

    def clone(self) -> Self:
        """The same scene in memory of its own, of which no gradient is taken."""
        return self.replace(**{name: value.detach().clone() for name, value in self.tensors().items()})

    def slice(self, start: int, stop: int | None = None) -> Self:
        """Frames `start:stop` of every scene; negative ones count from the scene's end, and there may be none.

        Raises:
            ValueError: the stop lies before the start.
        """
        part = builtins.slice(start, stop)
        first, behind, _ = part.indices(self.frames)
        if first > behind:
            raise ValueError(f"slice({start}, {stop}) of {self.frames} frames: the stop lies before the start")
        return self.frames_at(part)

    def select(self, scenes: Tensor | Sequence[int] | builtins.slice) -> Self:
        """Some of the B scenes, in the order given."""
        if not isinstance(scenes, builtins.slice):
            empty = not isinstance(scenes, Tensor) and not len(scenes)
            scenes = torch.as_tensor(scenes, device=self.device, dtype=torch.long if empty else None)
            if scenes.dtype == torch.bool:
                scenes = scenes.nonzero()[:, 0]
        changes: dict[str, object] = {name: value[scenes] for name, value in self.tensors().items()}
        if not self.names:  # else a GPU is waited for
            return self.replace(**changes)
        chosen = torch.arange(self.scenes, device=self.device)[scenes].tolist()
        return self.replace(**changes, names=tuple(self.names[i] for i in chosen))

    def repeat(self, samples: int) -> Self:
        """Each scene `samples` times in a row: scene b becomes b * samples ... b * samples + samples - 1."""
        return self.select(torch.arange(self.scenes, device=self.device).repeat_interleave(samples))

    def permute_agents(self, agents: Tensor) -> Self:
        """Agents in another order, one for all scenes. agents: (P,) int"""
        return self.replace(
            body_rot=self.body_rot[:, :, agents],
            T_world_root=self.T_world_root[:, :, agents],
            betas=self.betas[:, agents],
            present=self.present[:, agents],
            given=None if self.given is None else self.given[:, :, agents],
        )

    def people(self) -> Self:
        """Each person present as a scene of its own, (M, T, 1), in the order of scenes and slots; names are dropped."""
        there = self.present
        return self.replace(
            body_rot=self.body_rot.transpose(1, 2)[there].unsqueeze(2),
            T_world_root=self.T_world_root.transpose(1, 2)[there].unsqueeze(2),
            betas=self.betas[there].unsqueeze(1),
            present=there[there].unsqueeze(1),
            names=(),
            valid=None if self.valid is None else self.valid[:, None].expand(-1, self.agents, -1)[there],
            given=None if self.given is None else self.given.transpose(1, 2)[there].unsqueeze(2),
        )

    def pad_frames(self, frames: int) -> Self:
        """The scene with its first and last frame repeated so many times, before and after it."""
        T = self.frames
        return self.frames_at(torch.arange(-frames, T + frames, device=self.device).clamp(0, T - 1))

    def frames_at(self, frames: builtins.slice | Tensor) -> Self:
        """Some of the frames, in the order given. frames (F,) int, or a slice"""
        timed = ("body_rot", "T_world_root", "valid", "given")
        return self.replace(**{name: value[:, frames] for name, value in self.tensors().items() if name in timed})

    def pad_agents(self, agents: int) -> Self:
        """The same people in `agents` slots; the new slots are absent.

        Raises:
            ValueError: the scene has more slots than that.
        """
        extra = agents - self.agents
        if extra < 0:
            more = "a model's max_agents must be at least those of its data"
            raise ValueError(f"the scene has {self.agents} agents, but room was asked for {agents}: {more}")
        if extra == 0:
            return self
        empty = empty_scene(self.scenes, self.frames, extra, self.T_world_root)
        given = None if self.given is None else torch.nn.functional.pad(self.given, (0, extra))
        return self.replace(**{**cat_agents([self, empty]).tensors(), "given": given})

    def absent_at_origin(self) -> Self:
        """The same people; slots in which nobody is stand at the origin, whatever was there."""
        nowhere = torch.eye(4, dtype=self.T_world_root.dtype, device=self.T_world_root.device)
        there = self.present[:, None, :, None, None]
        return self.replace(T_world_root=torch.where(there, self.T_world_root, nowhere))

    def transformed(self, T_new_world: Tensor) -> Self:
        """The same motion seen from another world frame. T_new_world: (4, 4) or (B, 1, 1, 4, 4)"""
        keep = self.present[:, None, :, None, None]
        return self.replace(T_world_root=torch.where(keep, T_new_world @ self.T_world_root, self.T_world_root))

    def with_poses(self, where: Tensor, body_rot: Tensor, T_world_root: Tensor) -> Self:
        """The same with other poses in some places. where: (B, T, P) bool, or what broadcasts to it"""
        where = where[..., None, None]
        return self.replace(
            body_rot=torch.where(where[..., None], body_rot, self.body_rot),
            T_world_root=torch.where(where, T_world_root, self.T_world_root),
        )

    def save(self, path: str | Path) -> Path:
        """Write all B scenes to one npz that needs no unpickling, whose suffix may be left out. Returns its path.

        Raises:
            ValueError: another suffix, whose format a `Scene` cannot write; says what can.
        """
        path = npz_path(path, "Motion.of(scene).save(path) or `magnet export` write other formats")
        meta = {"format": SCENE_FORMAT, "fps": self.fps, "body": self.body, "names": list(self.names)}
        arrays = {name: value.detach().cpu().numpy() for name, value in self.tensors().items()}
        save_npz(path, {"meta": np.array(json.dumps(meta)), **arrays})
        return path

    @staticmethod
    def load(path: str | Path) -> Scene:
        """Read what `save` wrote.

        Raises:
            ValueError: the file is not such a file, of a later format, or has matrices that do not rotate.
        """
        try:
            with load_npz(path) as file:
                meta = json.loads(str(file["meta"]))
                arrays: dict[str, Any] = {name: torch.from_numpy(file[name]) for name in TENSORS if name in file.files}
            version = int(meta["format"])
            arrays |= {"fps": meta["fps"], "body": meta["body"], "names": tuple(meta["names"])}
        except (OSError, KeyError, TypeError, ValueError, *DAMAGED) as error:
            if isinstance(error, FileNotFoundError):
                raise
            raise ValueError(f"{path}: not a scene file ({error}); magnet.read takes other files") from error
        if version > SCENE_FORMAT:
            raise ValueError(f"{path}: scene format {version}, this version reads up to {SCENE_FORMAT}")
        if missing := [name for name in TENSORS[:4] if name not in arrays]:
            raise ValueError(f"{path}: not a scene file (it lacks {', '.join(missing)}); write one with Scene.save")
        try:
            scene = Scene(**arrays)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        require_rotations(scene, str(path))
        return scene


def require_rotations(scene: Scene, name: str) -> None:
    """Refuse matrices that do not rotate, of people who are there in frames that count; what is not finite passes.

    Raises:
        ValueError: says which is the first.
    """
    root = scene.T_world_root[..., None, :, :].float()
    turns = torch.cat([root[..., :3, :3], scene.body_rot.float()], dim=3)  # (B, T, P, joints, 3, 3)
    off = (turns.mT @ turns - torch.eye(3, dtype=turns.dtype, device=turns.device)).abs().amax(dim=(-2, -1))
    low = (root[..., 3, :] - torch.eye(4, dtype=root.dtype, device=root.device)[3]).abs().amax(dim=-1) > NO_ROTATION
    wrong = ~(off <= NO_ROTATION) & turns.flatten(4).isfinite().all(dim=-1)  # also of what is too large to be squared
    wrong |= (torch.linalg.cross(turns[..., 0], turns[..., 1]) * turns[..., 2]).sum(-1).lt(0)
    wrong[..., :1] |= low
    wrong &= scene.present[:, None, :, None]
    if scene.valid is not None:
        wrong &= scene.valid[:, :, None, None]
    if bool(wrong.any()):
        b, frame, person, joint = wrong.nonzero()[0].tolist()
        field = f"body_rot of joint {joint}" if joint else "T_world_root"
        more = ", whose last row is not 0 0 0 1," if not joint and bool(low[b, frame, person]) else ""
        raise ValueError(f"{name}: {field}{more} is no rotation (scene {b}, frame {frame}, person {person})")


def empty_scene(scenes: int, frames: int, agents: int, like: Tensor) -> Scene:
    """Slots with nobody in them, with the dtype and device of `like`."""
    eye3 = torch.eye(3, dtype=like.dtype, device=like.device)
    eye4 = torch.eye(4, dtype=like.dtype, device=like.device)
    return Scene(
        body_rot=eye3.expand(scenes, frames, agents, BODY_JOINTS - 1, 3, 3),
        T_world_root=eye4.expand(scenes, frames, agents, 4, 4),
        betas=torch.zeros(scenes, agents, 10, dtype=like.dtype, device=like.device),
        present=torch.zeros(scenes, agents, dtype=torch.bool, device=like.device),
    )


def concatenate(scenes: Sequence[Scene]) -> Scene:
    """Several batches of scenes as one batch; slots are padded to the largest group.

    Raises:
        ValueError: there are none, or frames, fps or body differ.
    """
    _require_alike(scenes, ("frames", "fps", "body"))
    first = scenes[0]
    agents = max(scene.agents for scene in scenes)
    padded = [scene.pad_agents(agents) for scene in scenes]
    valid = None
    if any(scene.valid is not None for scene in scenes):
        valid = torch.cat([all_valid(s) if s.valid is None else s.valid for s in padded])
    given = [s.given for s in padded if s.given is not None]
    named = all(scene.names for scene in scenes)
    return Scene(
        body_rot=torch.cat([s.body_rot for s in padded]),
        T_world_root=torch.cat([s.T_world_root for s in padded]),
        betas=torch.cat([s.betas for s in padded]),
        present=torch.cat([s.present for s in padded]),
        fps=first.fps,
        body=first.body,
        valid=valid,
        names=tuple(name for s in scenes for name in s.names) if named else (),
        given=torch.cat(given) if len(given) == len(padded) else None,
    )


def cat_agents(people: Sequence[Scene]) -> Scene:
    """Agents of several scenes side by side in the same world; `given` is dropped, all else is that of the first."""
    return people[0].replace(
        body_rot=torch.cat([person.body_rot for person in people], dim=2),
        T_world_root=torch.cat([person.T_world_root for person in people], dim=2),
        betas=torch.cat([person.betas for person in people], dim=1),
        present=torch.cat([person.present for person in people], dim=1),
        given=None,
    )


def cat_time(pieces: Sequence[Scene]) -> Scene:
    """Consecutive pieces of the same scenes as one; what was given is kept if all of them say it.

    Raises:
        ValueError: there are none, or scenes, slots, fps or body differ.

    >>> scene = empty_scene(1, 60, 2, like=torch.zeros(()))
    >>> cat_time([scene.slice(0, 20), scene.slice(20)]).frames
    60
    """
    _require_alike(pieces, ("scenes", "agents", "fps", "body"))
    if len(pieces) == 1:
        return pieces[0]
    valid = None
    if any(piece.valid is not None for piece in pieces):
        valid = torch.cat([all_valid(p) if p.valid is None else p.valid for p in pieces], dim=1)
    given = [piece.given for piece in pieces if piece.given is not None]
    return pieces[0].replace(
        body_rot=torch.cat([piece.body_rot for piece in pieces], dim=1),
        T_world_root=torch.cat([piece.T_world_root for piece in pieces], dim=1),
        valid=valid,
        given=torch.cat(given, dim=1) if len(given) == len(pieces) else None,
    )


def _require_alike(scenes: Sequence[Scene], fields: Sequence[str]) -> None:
    if not scenes:
        raise ValueError("got no scenes to put together, expected at least one")
    for scene in scenes[1:]:
        for field in fields:
            ours, theirs = getattr(scenes[0], field), getattr(scene, field)
            if abs(ours - theirs) > 1e-3 if field == "fps" else ours != theirs:
                raise ValueError(f"{field} differ: {ours} and {theirs}")


def all_valid(scene: Scene) -> Tensor:
    """(B, T) bool, True throughout."""
    return torch.ones(scene.scenes, scene.frames, dtype=torch.bool, device=scene.device)
