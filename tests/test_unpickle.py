"""The restricted unpickler: plain data comes through, nothing else does, and no damage ends in a bare error."""

from __future__ import annotations

import base64
import bz2
import gzip
import lzma
import pickle
import zlib
from collections import OrderedDict, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.reading.recording import DataError
from magnet.unpickle import load_object_npy, load_pickle

PLAIN: dict[str, Any] = {
    "floats": np.linspace(0.0, 1.0, 6).reshape(2, 3),
    "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
    "big endian": np.arange(3, dtype=">f4"),
    "half": np.arange(3, dtype=np.float16),
    "flags": np.array([True, False]),
    "text": np.array(["one", "three"]),
    "bytes": np.array([b"one", b"three"]),
    "empty": np.zeros((0, 3)),
    "one number": np.array(2.5),
    "objects": np.array([{"inner": np.arange(2)}, None, "x"], dtype=object),
    "scalar": np.float32(1.5),
    "integer": np.int64(4),
    "nested": [1, (2.0, {"three": None}), {4, 5}, frozenset({6}), b"seven", True, 1 + 2j],
    "ordered": OrderedDict(a=1),
    "default": defaultdict(dict, a={"b": 1}),
    "default of lists": defaultdict(list, a=[1]),
}


def same(got: Any, want: Any) -> bool:
    if isinstance(want, np.ndarray):
        alike = type(got) is np.ndarray and got.shape == want.shape and got.dtype == want.dtype
        return alike and all(same(a, b) for a, b in zip(got.ravel().tolist(), want.ravel().tolist(), strict=True))
    if isinstance(want, dict):
        return isinstance(got, dict) and list(got) == list(want) and all(same(got[k], want[k]) for k in want)
    if isinstance(want, list | tuple):
        return type(got) is type(want) and all(same(a, b) for a, b in zip(got, want, strict=True))
    return type(got) is type(want) and got == want


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_comes_back_as_it_was(protocol: int, tmp_path: Path) -> None:
    path = tmp_path / "file.pkl"
    for key, plain in PLAIN.items():
        path.write_bytes(pickle.dumps({key: plain}, protocol=protocol))
        assert same(load_pickle(path)[key], plain), key


def test_an_npy_file_of_a_dict_comes_back_as_the_dict(tmp_path: Path) -> None:
    np.save(tmp_path / "file.npy", PLAIN, allow_pickle=True)  # type: ignore[arg-type]
    assert same(load_object_npy(tmp_path / "file.npy"), PLAIN)


def test_bytes_keys_become_text(tmp_path: Path) -> None:
    (tmp_path / "file.pkl").write_bytes(pickle.dumps({b"poses": {b"inner": 1}}))
    assert load_pickle(tmp_path / "file.pkl") == {"poses": {"inner": 1}}


def test_a_pickle_of_python_2_is_read(tmp_path: Path) -> None:
    # {'poses': numpy.arange(2.0)} as Python 2.7 with numpy 1.16 wrote it, protocol 2.
    data = (
        b"\x80\x02}q\x00U\x05posesq\x01cnumpy.core.multiarray\n_reconstruct\nq\x02cnumpy\nndarray\nq\x03K\x00\x85U\x01b"
        b"\x87Rq\x04(K\x01K\x02\x85cnumpy\ndtype\nq\x05U\x02f8K\x00K\x01\x87Rq\x06(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff"
        b"\xff\xff\xffK\x00tb\x89U\x10" + np.arange(2.0).tobytes() + b"tbs."
    )
    (tmp_path / "file.pkl").write_bytes(data)
    assert load_pickle(tmp_path / "file.pkl")["poses"].tolist() == [0.0, 1.0]


class Spy:
    """Reduces to whatever it is made with."""

    def __init__(self, call: Any, *arguments: Any) -> None:
        self.reduced = (call, arguments)

    def __reduce__(self) -> Any:
        return self.reduced


def ran(path: str) -> None:
    Path(path).write_text("ran", encoding="utf-8")


@pytest.mark.parametrize(
    ("call", "arguments", "named"),
    [
        (eval, ("1",), "eval"),
        (getattr, ("", "join"), "getattr"),
        (np.load, ("file",), "load"),
        (np.frombuffer, (b"12345678",), "frombuffer"),
        (Path, ("x",), "Path"),
        (bytearray, (10,), "bytearray"),
    ],
)
def test_foreign_code_is_refused_by_name(call: Any, arguments: tuple[Any, ...], named: str, tmp_path: Path) -> None:
    (tmp_path / "file.pkl").write_bytes(pickle.dumps([Spy(call, *arguments)]))
    with pytest.raises(DataError, match=rf"file\.pkl: the pickle names .*{named}"):
        load_pickle(tmp_path / "file.pkl")
    np.save(tmp_path / "file.npy", np.array(Spy(call, *arguments), dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match=rf"file\.npy: the pickle names .*{named}"):
        load_object_npy(tmp_path / "file.npy")


def test_refused_code_has_not_run(tmp_path: Path) -> None:
    (tmp_path / "file.pkl").write_bytes(pickle.dumps(Spy(ran, str(tmp_path / "proof"))))
    with pytest.raises(DataError, match="ran"):
        load_pickle(tmp_path / "file.pkl")
    assert not (tmp_path / "proof").exists()


def test_no_pickle_changes_how_the_next_one_is_read(tmp_path: Path) -> None:
    path = tmp_path / "file.pkl"
    # The state of what is pickled as `_codecs.encode`: (None, {"__defaults__": ("utf-16",)}).
    path.write_bytes(b"\x80\x02c_codecs\nencode\nN}X\x0c\x00\x00\x00__defaults__X\x06\x00\x00\x00utf-16\x85s\x86b0N.")
    with pytest.raises(DataError, match="changes a function"):
        load_pickle(path)
    path.write_bytes(b"c_codecs\nencode\n(Va\ntR.")  # encode("a")
    assert load_pickle(path) == b"a"


def test_records_and_wild_sizes_are_refused_without_reserving_them(tmp_path: Path) -> None:
    path = tmp_path / "file.pkl"
    path.write_bytes(pickle.dumps(np.zeros(2, dtype=[("a", "f4")])))
    with pytest.raises(DataError, match="records"):
        load_pickle(path)
    whole = pickle.dumps(np.zeros(70000, dtype=np.uint8), protocol=2)
    path.write_bytes(whole.replace((70000).to_bytes(4, "little"), (2**31 - 1).to_bytes(4, "little"), 1))
    with pytest.raises(DataError, match="2147483647"):
        load_pickle(path)
    # An array of a million bytes, with a million in place of its bytes.
    million = b"I1000000\n"
    path.write_bytes(b"cnumpy.core.numeric\n_frombuffer\n(%bcnumpy\ndtype\n(Vu1\ntR(%btVC\ntR." % (million, million))
    with pytest.raises(DataError, match="int in place of"):
        load_pickle(path)
    path.write_bytes(b"\x80\x02]r\xff\xff\xff\xff.")  # a memo of four thousand million entries
    with pytest.raises(DataError, match="not a whole pickle"):
        load_pickle(path)


def test_deep_nesting_and_shared_parts_end(tmp_path: Path) -> None:
    path, shared, deep = tmp_path / "file.pkl", [0], []
    for _ in range(60):
        shared = [shared, shared]  # 2^60 if every reference were followed
    for _ in range(200):
        deep = [deep]
    path.write_bytes(pickle.dumps(shared))
    load_pickle(path)
    path.write_bytes(pickle.dumps(deep))
    with pytest.raises(DataError, match="deep"):
        load_pickle(path)


@pytest.mark.parametrize("load", [load_pickle, load_object_npy])
def test_every_truncation_is_a_data_error(load: Any, tmp_path: Path) -> None:
    path = tmp_path / "file"
    if load is load_pickle:
        whole = pickle.dumps({"a": np.arange(4.0), "b": [1, "two"]})
    else:
        with path.open("wb") as file:
            np.save(file, {"a": np.arange(4.0)}, allow_pickle=True)  # type: ignore[arg-type]
        whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises(DataError, match=r"file: "):
            load(path)


def test_a_missing_file_and_a_folder_are_data_errors(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        load_pickle(tmp_path / "none.pkl")
    with pytest.raises(DataError, match="is a folder, expected a file"):
        load_object_npy(tmp_path)


JOBLIB = "open it with joblib.load, as joblib wrote it, and save plain arrays"


@pytest.mark.parametrize(
    ("held", "how"),
    [
        (b"cjoblib.numpy_pickle\nAnything\n.", JOBLIB),
        (zlib.compress(b"N."), JOBLIB),
        (zlib.compress(b"N.", 3), JOBLIB),
        (gzip.compress(b"N."), JOBLIB),
        (bz2.compress(b"N."), JOBLIB),
        (lzma.compress(b"N."), JOBLIB),
        (b"ctorch._utils\nAnything\n.", r"make arrays of its tensors by \.cpu\(\)\.numpy\(\) and save plain arrays"),
        (b"cposix\nAnything\n.", "load it yourself and save plain arrays"),
    ],
    ids=["joblib", "zlib", "zlib, level 3", "gzip", "bz2", "xz", "torch", "posix"],
)
def test_what_is_refused_is_said_with_how_a_trusted_file_is_opened(held: bytes, how: str, tmp_path: Path) -> None:
    (tmp_path / "file.pkl").write_bytes(held)
    with pytest.raises(DataError, match=f"If you trust the file, .*{how}"):
        load_pickle(tmp_path / "file.pkl")


JOBLIB_WROTE = {
    2: (
        "eNplUk1v0zAYdhLajLSMQmF8DBjfZBwqgTjsgLShShyI1Em9kAuK4tTFGfl6HUeo0iKVw7ZWyg3DmV/IXxiO2xU2LNuy36/neR97qpeA"
        "HK0EzXYbCKEszUkOenCQ4ijEvaSIs4mXhcGXiFiD+vKOMX/ykflZRpgFxvY3uFRCw3bXZHJe4CDy8xyagUq0kpFfh1tgquI59TMCa47u"
        "GMdwWZlSNiIMLFeT5z60lG3EJzKsvayhbhZccXXpGr+B9fnsBK4OoWM7hkp7C9cGg8GHUznU5iAO17FrSZcfRelXL479DLozd1NaFg0p"
        "Vp4fhZ+TmCTcwxMuu77hdAq8fnpuIDWmu3Lbk1OuqVy/9tymtPCCJWQEN2ktw0YJt2zapCatG9SP4TZdtPUe7tA2XfAPX8Pdmv/mEO5J"
        "/vR/5vcx7c6oomIofB1pyECuWYuFD0jAc3igALdKeLgCPIJH1KKtFdD+DjyugZ4M4emZUIfw7DzcLofnEm6+gJs2fvxetIuqDaVTzwtS"
        "RnpxEfFQSSaqtsdIkCY5Z0XAxXdRNVSkqMzlW0ubg45EX8PiRAyF7WiSnKBG1VAPWafo+ztCclNeo9IOxUVWAs8/Cbvq/ktCngkLA1G1"
        "vDFLY1yMx4TJavZPfUkaaYK2K7149bc47VzUV+CaTqX1BZchAyINPfXpSJzxCbxQytolbJ8pi+q/+nKpbWf1NubyfxR57w8U9iRO"
    ),
    4: (
        "eNqFUs1O3DAQdrKkQFnRbRGIqi+wPTRSqx44IEGFxIFIQXDhVEVx1luH5k+OLRSpSNsDdFfyrZOeeTYegFcIk2S3pOyhI9saOzP5vvlm"
        "JivlPWntGhzjGobaytKc5aC3LlMahdROVJwVXhYG3yMG+rVbX78I4RcXws8yJuA3vP8JdeZarmgQ+TkmW00W6NVk5NexGKStnPsZA8d0"
        "erd4S8UIk7VxhP5IFviFry88jDbHn2E2/QXnMHR62tgH13VPKrTmcIgEql/6UZReeXHsZzDV71qmDZ7nR+G3JGaJ9GghsRxnoKhZVW2p"
        "kwM8DnHhnuC+OyzP5yroF1KJhI2AW21VfI1v8D6SNm+Bb2rjGPiAv9Fm+OmJHt9ZJsd3p/xtjdqvOkaISQzSI+XZAm81pZcskPkS4A3C"
        "8Vct2OleV4sfz7Q4aOBmLdzEKh8W/95pFLG9IBXMjlUkw7YZuu8JFqRJLoUKZNOb5X455AaODAotrNEQ6nUb9H9Ss684FVtdEugzEQag"
        "N7yxSGOqxuNmgoZ/zDlpYgDva1N97Mg7WJa3plPPjsQQl+GDXX5YlG2xOJPFc0FJPXZzSbf/dmez+sdUbj8CNxY2+w=="
    ),
}
"""One file of joblib 1.6.0 by protocol, zlib and base64: joblib.dump of `HELD`, its second array in Fortran's order."""
HELD = {
    1: {
        "poses": np.arange(6, dtype=np.float32).reshape(2, 3),
        "turned": np.arange(4, dtype=np.int16).reshape(2, 2),
        "objects": np.array([np.arange(2, dtype=np.uint8), None], dtype=object),
        "empty": np.zeros((0, 3), dtype=np.float32),
    }
}


def wrote(protocol: int) -> bytes:
    return zlib.decompress(base64.b64decode(JOBLIB_WROTE[protocol]))


@pytest.mark.parametrize("protocol", JOBLIB_WROTE)
def test_what_joblib_wrote_comes_back_as_it_was(protocol: int, tmp_path: Path) -> None:
    path = tmp_path / "file.pkl"
    path.write_bytes(wrote(protocol))
    got = load_pickle(path)[1]
    assert list(got) == list(HELD[1]) and got["objects"][1] is None and same(got["objects"][0], HELD[1]["objects"][0])
    assert all(same(got[name], HELD[1][name]) for name in ("poses", "turned", "empty"))


@pytest.mark.parametrize("protocol", JOBLIB_WROTE)
def test_damage_in_what_joblib_wrote_is_a_data_error_that_names_the_file(protocol: int, tmp_path: Path) -> None:
    path, whole, draw = tmp_path / "file.pkl", wrote(protocol), np.random.default_rng(0)
    damaged = [whole[:size] for size in range(0, len(whole), 3)]
    for _ in range(400):
        bent = bytearray(whole)
        for place in draw.integers(len(whole), size=3):
            bent[place] = draw.integers(256)
        damaged.append(bytes(bent))
    refused = 0
    for data in damaged:
        path.write_bytes(data)
        try:
            load_pickle(path)  # a number of an array may be another and nobody can tell
        except DataError as error:
            refused += 1
            assert str(error).startswith(str(path))
    assert refused > len(damaged) / 2


def test_a_wrapper_of_joblibs_lets_nothing_else_be_named(tmp_path: Path) -> None:
    path = tmp_path / "file.pkl"
    path.write_bytes(wrote(4).replace(b"\x8c\x05numpy\x94\x8c\x07ndarray", b"\x8c\x05posix\x94\x8c\x06system", 1))
    with pytest.raises(DataError, match=r"file\.pkl"):
        load_pickle(path)
    path.write_bytes(b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n0cposix\nsystem\n(S'true'\ntR.")
    with pytest.raises(DataError, match=r"names posix\.system, which is not loaded"):
        load_pickle(path)
