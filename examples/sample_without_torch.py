"""Two people from nothing without torch, by `magnet export-model duet.onnx --without_posterior` and then this."""

import json
import sys
from itertools import pairwise

import numpy as np
import onnxruntime


def sample(network, people=2, steps=30, seed=0):
    """Clean tokens (1, N, P, D) by DDIM: every token at one level, from pure noise to none."""
    (_, N, P, D), rng = network.get_inputs()[0].shape, np.random.default_rng(seed)
    alpha = np.array(json.loads(network.get_modelmeta().custom_metadata_map["alpha_bar"]), np.float32)
    tokens, present = rng.standard_normal((1, N, P, D), np.float32), np.arange(P)[None] < people
    for now, after in pairwise(np.linspace(len(alpha) - 1, 0, steps + 1).round().astype(np.int64)):
        clean = network.run(None, {"noisy": tokens, "levels": np.full((1, N, P), now), "present": present})[0]
        noise = (tokens - np.sqrt(alpha[now]) * clean) / np.sqrt(1 - alpha[now])
        tokens = np.sqrt(alpha[after]) * clean + np.sqrt(1 - alpha[after]) * noise
    return tokens


def planar(nine):
    """Heading and place of transforms in 9-D, as complex numbers: cos + i sin of the yaw, z + i x. (..., 9)"""
    turn = nine[..., 0] - 1j * nine[..., 2]
    return turn / abs(turn), nine[..., 8] + 1j * nine[..., 6]


def matrices(six):
    """The rotations whose first two columns are nearest. (..., 6) -> (..., 3, 3)"""
    x = six[..., :3] / np.linalg.norm(six[..., :3], axis=-1, keepdims=True)
    y = six[..., 3:] - (x * six[..., 3:]).sum(-1, keepdims=True) * x
    return np.stack([x, y := y / np.linalg.norm(y, axis=-1, keepdims=True), np.cross(x, y)], -1)


def axis_angle(R):
    around = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1) / 2
    sine = np.linalg.norm(around, axis=-1, keepdims=True).clip(1e-9)
    return around / sine * np.arctan2(sine, (np.trace(R, axis1=-2, axis2=-1)[..., None] - 1) / 2)


def main(model="duet.onnx", out="dance.npz", people=2):
    network, decoder = (onnxruntime.InferenceSession(model.replace(".onnx", end)) for end in (".onnx", "_decoder.onnx"))
    betas, poses, places = np.zeros((1, (tokens := sample(network, people)).shape[2], 10), np.float32), [], []
    pose, deltas, pairs = (each[0] for each in decoder.run(None, {"tokens": tokens, "betas": betas}))
    for p in range(people):  # the first one starts at the origin, the others where that one sees them
        (heading, place), (turn, step) = planar(pairs[0, 0, p - 1]) if p else (1, 0), planar(deltas[1:, p])
        turn = np.append(heading, heading * np.cumprod(turn))
        place = np.append(place, place + np.cumsum(turn[:-1] * step))
        about = matrices(np.stack([turn.real, 0 * turn.real, -turn.imag, *np.outer([0, 1, 0], abs(turn))], -1))
        local = matrices(np.concatenate([pose[:, p, 126:132], pose[:, p, :126]], -1).reshape(-1, 22, 6))
        local[:, 0] = about @ local[:, 0]
        poses.append(np.pad(axis_angle(local).reshape(-1, 66), ((0, 0), (0, 99))))  # fingers, jaw and eyes at rest
        places.append((about @ pose[:, p, 132:, None])[..., 0] + np.stack([place.imag, 0 * place.imag, place.real], -1))
    trans = np.subtract(places, (0.003, -0.351, 0.012))  # without the rest pelvis of SMPL-X's mean shape
    np.savez(out, poses=poses, trans=trans, betas=betas[0, :people], mocap_frame_rate=30.0)


if __name__ == "__main__":
    main(*sys.argv[1:3])
