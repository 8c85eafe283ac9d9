"""A row of a store: one person in one frame, as it lies on disk, and the way there and back.

A rotation is a unit quaternion in four int16: half the size of float16 6-D and sixteen times as fine (0.03 mrad),
so that joints come back within 0.2 mm and no noise is added to accelerations; 188 bytes a frame and person instead
of the 820 that matrices take in memory.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.motion.frames import rigid
from magnet.motion.rotations import to_quat
from magnet.motion.scene import BODY_JOINTS, Scene

SCALE = 32767
ROW = np.dtype([("rotations", "<i2", (BODY_JOINTS, 4)), ("pelvis", "<f4", (3,))])
"""One person in one frame: xyzw quaternions times 32767, the pelvis's in the world, others relative to the parent."""
CACHED = 8192
"""Rotations decoded at a time on a CPU: several times as fast as all at once, whose steps go through memory."""


def encode(scene: Scene) -> NDArray[np.void]:
    """A scene (B = 1) as rows, person after person. -> (P * T,) of `ROW`"""
    rotations = torch.cat([scene.T_world_root[0, :, :, None, :3, :3], scene.body_rot[0]], dim=2)
    quat = to_quat(rotations.double())
    quat = torch.where(quat[..., 3:] < 0, -quat, quat)
    rows = np.zeros((scene.agents, scene.frames), dtype=ROW)
    rows["rotations"] = (SCALE * quat).round().to(torch.int16).transpose(0, 1).numpy()
    rows["pelvis"] = scene.T_world_root[0, :, :, :3, 3].float().transpose(0, 1).numpy()
    return rows.reshape(-1)


def matrices(rotations: Tensor) -> Tensor:
    """Quaternions of any length to rotation matrices; a row comes out the same whatever it is decoded with.

    (..., 4) int16, xyzw -> (..., 3, 3) float32 on the same device
    """
    flat = rotations.reshape(-1, 4)
    nine = nine_at_once(flat) if flat.device.type != "cpu" else torch.from_numpy(_nine(flat.numpy()))
    return nine.view(*rotations.shape[:-1], 3, 3)


def nine_at_once(rotations: Tensor) -> Tensor:
    """(N, 4) -> (N, 9) on any device."""
    q = rotations.T.float()
    x, y, z, w = q
    sx, sy, sz = q[:3] * (2 / (x * x + y * y + z * z + w * w))
    xx, yy, zz, xy, xz, yz = sx * x, sy * y, sz * z, sx * y, sx * z, sy * z
    wx, wy, wz = sx * w, sy * w, sz * w
    rows = [1 - (yy + zz), xy - wz, xz + wy, xy + wz, 1 - (xx + zz), yz - wx, xz - wy, yz + wx, 1 - (xx + yy)]
    return torch.stack(rows, dim=1)


def _nine(rotations: NDArray[np.int16]) -> NDArray[np.float32]:
    """The same, bit for bit, in pieces that fit a CPU's cache; numpy's calls cost a third of torch's."""
    N = len(rotations)
    out = np.empty((N, 9), dtype=np.float32)
    room = np.empty((26, min(CACHED, N)), dtype=np.float32)
    for begin in range(0, N, CACHED):
        end = min(begin + CACHED, N)
        q, scaled, sx, sy, sz, R = np.split(room[:, : end - begin], (4, 8, 12, 15, 17))
        np.copyto(q, rotations[begin:end].T)
        np.multiply(q, q, out=scaled)
        s = R[0]
        np.add(scaled[0], scaled[1], out=s)
        s += scaled[2]
        s += scaled[3]
        np.divide(2, s, out=s)
        np.multiply(q[:3], s, out=scaled[:3])
        np.multiply(q, scaled[0], out=sx)
        np.multiply(q[1:], scaled[1], out=sy)
        np.multiply(q[2:], scaled[2], out=sz)
        (xx, xy, xz, wx), (yy, yz, wy), (zz, wz) = sx, sy, sz
        for entry, one, other in ((3, xy, wz), (2, xz, wy), (7, yz, wx), (0, yy, zz), (4, xx, zz), (8, xx, yy)):
            np.add(one, other, out=R[entry])
        for entry, one, other in ((1, xy, wz), (6, xz, wy), (5, yz, wx), (0, 1, R[0]), (4, 1, R[4]), (8, 1, R[8])):
            np.subtract(one, other, out=R[entry])
        np.copyto(out[begin:end], R.T)
    return out


def scene_of(rows: NDArray[np.void], betas: NDArray[np.float32], body: str, fps: float, name: str = "") -> Scene:
    """Decode rows (P, T) of `ROW`, of people with shapes (P, 10), to a scene (B = 1)."""
    body_rot, T_world_root = decode(*(torch.from_numpy(rows[key].copy()) for key in ("rotations", "pelvis")))
    return Scene(
        body_rot=body_rot.transpose(0, 1)[None],
        T_world_root=T_world_root.transpose(0, 1)[None],
        betas=torch.from_numpy(np.array(betas))[None],
        present=torch.ones(1, len(rows), dtype=torch.bool),
        fps=fps,
        body=body,
        names=(name,) if name else (),
    )


def decode(rotations: Tensor, pelvis: Tensor) -> tuple[Tensor, Tensor]:
    """body_rot (..., 21, 3, 3) and T_world_root (..., 4, 4) of rows' (..., 22, 4) int16 and (..., 3) float32."""
    return matrices(rotations[..., 1:, :]), rigid(matrices(rotations[..., 0, :]), pelvis)
