"""Marks in the viewer's scene."""

import numpy as np

from magnet.viewer.scenery import Spots, ball


def test_marks_that_are_not_needed_are_too_small_to_be_seen(server) -> None:
    spots = Spots(server, "/spots", ball(1.0), 5, None)
    assert spots.batch.batched_scales.max() < 1e-5
    for shown in (3, 1, 0):
        spots.show(np.ones((shown, 3)), np.zeros(3), 0.5)
        assert (spots.batch.batched_scales[:shown] == 0.5).all() and spots.batch.batched_scales[shown:].max() < 1e-5
