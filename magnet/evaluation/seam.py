"""How submitted joints go on from the recorded ones: from another place, person, side, scene or frame it is said.

People's joints move some centimetres from frame to frame. Where a submission begins farther away, but would begin there
if one mistake were undone, it is probably that mistake: its score would look like a bad method's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from magnet.body.joints import MIRROR, PELVIS
from magnet.evaluation.scoring import Sight
from magnet.export.misread import FAST

BRISK = 3.0
"""m/s that nobody's joints have in the mean: dancers of the benchmark come to 1.6."""
FAR = 1.0
"""Metres that nobody begins from where one was, not even in a recording put there for another one."""
SAME = 0.002
"""Metres under which two poses are one, written in half precision too."""
MOVES = 1e-5
"""Metres under which a pose is held from a frame to the next."""

WORLD = "the world of the inputs"


def seam_doubts(joints: Tensor, recorded: Tensor, names: Sequence[str], sight: Sight, fps: float) -> list[str]:
    """What is unlikely of where submitted joints begin, a line each; nothing if they go on as recorded people may.

    Arguments are those of `doubts`.
    """
    scored = sight.generated[0]
    context = recorded.shape[1] - joints.shape[2]
    if not sight.past_is_given:  # who is given may have been written too, and tells whether frames are the right ones
        return _other_frames(joints[..., ~scored, :, :], recorded[..., ~scored, :, :], context)
    last, first = recorded[:, context - 1], joints[:, :, 0]
    if found := _other_frames(joints[..., scored, :, :], recorded[..., scored, :, :], context):
        return found
    near = torch.stack([_away(first, other, scored) for other in last], dim=1)  # (B, B): from the end of each scene
    own = near.diagonal()
    if found := _other_scenes(near, names, BRISK / fps):
        return found
    away = float(own.median())
    said = "people begin {:.2f} m from where they were a frame before"
    begin = said.format(away)
    if away > BRISK / fps:
        undone = {text: float(_each_away(first, pose, scored).median()) for text, pose in _mistakes(last)}
        likely = min(undone, key=lambda text: undone[text])
        if undone[likely] < away / 2:
            return [f"{begin}, {likely}"]
    posed = float(_each_away(_posed(first), _posed(last), scored).median())
    if away > 2 * BRISK / fps and posed < min(BRISK / fps, away / 4):
        place = float((first - last[:, None]).norm(dim=-1)[..., PELVIS][..., scored].median())
        return [f"{said.format(place)}, in the same poses: expected {WORLD}"]
    if away > FAR:
        return [f"{begin}; expected the frames after the context, in {WORLD}"]
    return []


def _mistakes(last: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Poses that people would seem to go on from if a mistake had been made, and how it is told. (B, P, 22, 3)"""
    if last.shape[1] == 2:
        yield "where the other one was: are people in the inputs' order?", last.flip(1)
    yield "and as if left were right: are joints in the inputs' order?", last[..., MIRROR, :]
    for axis, sign in (("x", (-1, 1, 1)), ("z", (1, 1, -1))):
        yield f"and as if {axis} were turned around: expected {WORLD}", last * last.new_tensor(sign)
    x, y, z = last.unbind(-1)
    yield f"and as if x and z were exchanged: expected {WORLD}", torch.stack([z, y, x], dim=-1)
    for angle, turned in ((90, (z, y, -x)), (180, (-x, y, -z)), (270, (-z, y, x))):
        yield f"and as if turned by {angle} degrees: expected {WORLD}", torch.stack(turned, dim=-1)


def _other_frames(joints: Tensor, recorded: Tensor, context: int) -> list[str]:
    """Whether joints begin with a recorded frame before the predicted ones. (B, S, T, P, 22, 3), (B, T', P, 22, 3)"""
    if not joints.shape[3] or joints.shape[2] < 2:
        return []
    everybody = torch.ones(joints.shape[3], dtype=torch.bool)
    for frame in range(context):
        same = _each_away(joints[:, :, 0], recorded[:, frame], everybody) < SAME
        if frame + 1 < context:
            same &= _each_away(joints[:, :, 1], recorded[:, frame + 1], everybody) < SAME
        else:  # a pose that is held begins so, too
            same &= (joints[:, :, 1] - joints[:, :, 0]).norm(dim=-1).mean(dim=(2, 3)).median(dim=1).values > MOVES
        moved = _each_away(recorded[:, None, context], recorded[:, frame], everybody) > SAME
        if bool((same & moved).sum() > moved.sum() / 2):
            last = context + joints.shape[2] - 1
            return [f"begins with frame {frame} of a scene, counted from 0; expected frames {context} to {last}"]
    return []


def _other_scenes(near: Tensor, names: Sequence[str], brisk: float) -> list[str]:
    """Whether some scenes begin where others end, or far from where all others do. near (B, B) metres"""
    own = near.diagonal()
    nearest = near.min(dim=1)
    taken = [b for b in range(len(own)) if own[b] > FAST * brisk / BRISK and nearest.values[b] < brisk]
    if taken:
        scene, other = names[taken[0]], names[int(nearest.indices[taken[0]])]
        more = f", and {len(taken) - 1} more so" if len(taken) > 1 else ""
        return [f"{scene} begins where {other} goes on{more}: are scenes and joints in one order?"]
    far = [b for b in range(len(own)) if own[b] > FAST * brisk / BRISK]
    if far and float(own.median()) < brisk:
        more = f", and {len(far) - 1} more so" if len(far) > 1 else ""
        begin = f"begins {float(own[far[0]]):.2f} m from where people were a frame before"
        return [f"{names[far[0]]} {begin}{more}; other scenes do not"]
    return []


def _posed(joints: Tensor) -> Tensor:
    """From the pelvis. (..., 22, 3)"""
    return joints - joints[..., PELVIS : PELVIS + 1, :]


def _each_away(first: Tensor, pose: Tensor, whom: Tensor) -> Tensor:
    """Mean distance of joints, the median over samples. (B, S, P, 22, 3), (B, P, 22, 3), (P,) bool -> (B,)"""
    return _away(first, pose[:, None], whom)


def _away(first: Tensor, pose: Tensor, whom: Tensor) -> Tensor:
    """The same from one pose, (P, 22, 3), or some that broadcast."""
    return (first - pose).norm(dim=-1).mean(dim=-1)[..., whom].mean(dim=-1).median(dim=1).values
