"""Parts of `benchmarks/data_throughput.py`: who decodes, and the download that it makes up."""

from argparse import Namespace
from pathlib import Path

import pytest

from magnet.datamodules.fakes import dd100
from magnet.datamodules.store.mapped import MappedStore
from tests.scripts import module_at

throughput = module_at(Path(__file__).parents[1] / "benchmarks" / "data_throughput.py")
GIVEN = Namespace(body=None, batch_size=4, read_ahead=0, device="cpu", seconds=0.1, step_ms=0.0, fit_steps=0)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux, which tells of memory by kind")
@pytest.mark.parametrize(("way", "decoded"), [("mapped", True), ("for a GPU", False)])
def test_a_cpu_decodes_nothing_for_a_gpu(way: str, decoded: bool, tmp_path: Path, monkeypatch) -> None:
    seen, decode = [], MappedStore.decoded
    monkeypatch.setattr(MappedStore, "decoded", lambda *given: seen.append(way) or decode(*given))
    monkeypatch.setattr("torch.set_num_threads", lambda _: None)
    throughput.make(tmp_path / "store", 5000)
    assert throughput.measure(GIVEN, way, tmp_path / "store")["windows/s"] > 0
    assert bool(seen) == decoded


def test_a_store_is_prepared_from_a_made_up_download(tmp_path: Path) -> None:
    frames = 120 * len(dd100.NAMES) * 2
    throughput.through_prepare(tmp_path / "download", tmp_path / "store", frames, workers=1, take_frames=120)
    assert 0 < throughput.rows(tmp_path / "store") <= frames
    assert (tmp_path / "store" / "body.npz").is_file()
