"""What a model must beat: recorded motion put in the place of a prediction, and standing still (paper 4.1)."""

from magnet.baselines.hold_pose import HoldPose
from magnet.baselines.nearest_neighbour import NearestNeighbour
from magnet.baselines.random_sample import RandomSample

__all__ = ["HoldPose", "NearestNeighbour", "RandomSample"]
