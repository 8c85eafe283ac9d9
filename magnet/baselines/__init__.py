"""What a model must beat: recorded motion put in the place of a prediction, standing still (paper 4.1), and a
linear regression."""

from magnet.baselines.nearest_neighbour import NearestNeighbour
from magnet.baselines.predictor import HoldPose, RandomSample
from magnet.baselines.ridge import RidgeRegression
from magnet.baselines.windows import Windows

__all__ = ["HoldPose", "NearestNeighbour", "RandomSample", "RidgeRegression", "Windows"]
