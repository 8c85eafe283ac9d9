"""Equations of the paper, word by word, for tests of what implements them."""

from torch import Tensor

from magnet.motion.frames import inverse, partners


def propagate_pairwise(T_self_partner: Tensor, deltas: Tensor) -> Tensor:
    """Each frame's pairwise transform as the frame before and the deltas imply it (right side of paper Eq. 11).

    T_self_partner (..., T, P, P - 1, 4, 4), deltas (..., T, P, 4, 4) -> (..., T - 1, P, P - 1, 4, 4),
    to be compared with frames 1 to T - 1. On real motion the two are equal.
    """
    now = deltas[..., 1:, :, :, :]
    step_partner = now[..., partners(now.shape[-3], now.device), :, :]
    return inverse(now)[..., None, :, :] @ T_self_partner[..., :-1, :, :, :, :] @ step_partner
