"""Where `WeightEMA` was, for configurations that name it here."""

from magnet.training.ema import WeightEMA as WeightEMA
