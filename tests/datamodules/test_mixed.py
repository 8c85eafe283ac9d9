"""Data sets as one."""

from magnet.datamodules.mixed import Mixed
from magnet.datamodules.synthetic import Synthetic


def test_clips_of_one_name_are_told_apart() -> None:
    """Scenes are paired and counted by their labels."""
    parts = [Synthetic(people=[2], test_clips=2, couplings=["follow"], scene_seed=seed) for seed in (0, 1)]
    data = Mixed(data=parts)
    data.setup("test")
    names = data.store("test").names
    assert len(set(names)) == 4
    assert names[2:] == [f"{name} (2)" for name in names[:2]]
    labels = data.store("test").labels(data.test_windows(), 64)
    assert len(set(labels)) == len(labels)
