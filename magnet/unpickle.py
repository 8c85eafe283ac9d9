"""Reads untrusted pickles without running code in them; any damage is a `DataError`.

A pickle may hold numpy arrays and numbers, text, bytes, numbers, None, dict, list, tuple and set; a defaultdict becomes
a dict, and anything else that it names is refused. Arrays are rebuilt here, from bytes whose number must fit, so that a
damaged header neither reserves memory nor reaches numpy's own unpickling. What joblib wrote is read, too.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from magnet.errors import DataError
from magnet.files import Refused, regular

AGAIN = "download or copy it again"
KINDS = "?bhilqpBHILQPefdgFDGSU"
"""numpy's type letters that are plain numbers or text."""
DEEPEST = 100
Also = Callable[[str, str], Any]


def contents(path: str | Path) -> bytes:
    """All bytes of a file.

    Raises:
        DataError: it is not there or cannot be read.
    """
    try:
        return regular(Path(path)).read_bytes()
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file; is the download complete?") from error
    except Refused as error:
        raise DataError(str(error)) from error
    except (OSError, MemoryError) as error:
        raise DataError(f"{path}: cannot be read ({_said(error)}); {AGAIN}") from error


def load_pickle(path: str | Path) -> Any:
    """What a pickle holds, of any protocol; text of Python 2 is read as latin-1 and bytes keys become str.

    Raises:
        DataError: the file is damaged, or names a class or function that is not admitted: names it.
    """
    return unpickled(contents(path), str(path))


def load_object_npy(path: str | Path) -> Any:
    """What an npy file with a pickled object holds, `array.item()` where the array has no dimensions.

    Raises:
        DataError: as `load_pickle`.
    """
    found = npy(contents(path), str(path))
    if isinstance(found, np.ndarray) and found.dtype.char == "O" and found.ndim == 0:
        return found.item()
    return found


def mapping(where: object, held: Any) -> Mapping[str, Any]:
    """What a file holds, when it is a dict with text keys.

    Raises:
        DataError: it is not.
    """
    if not isinstance(held, Mapping) or not all(isinstance(key, str) for key in held):
        what = f"an array {held.shape}" if isinstance(held, np.ndarray) else f"a {type(held).__name__}"
        raise DataError(f"{where}: holds {what}, expected a dict of named arrays; is it another file of the data set?")
    return held


# -- npy ---------------------------------------------------------------------------------------


def npy(data: bytes, where: str) -> NDArray:
    """The array in the bytes of an npy file; one of objects goes through the restricted unpickler.

    Raises:
        DataError: damaged or refused; begins with `where`.
    """
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged text, and of headers that Python 2 wrote
            shape, fortran, dtype = read(file)
    except Exception as error:  # the header is a Python literal: its parser raises what it likes
        raise DataError(f"{where}: not a readable npy array ({_said(error)}); {AGAIN}") from error
    if dtype.char == "O":
        found = unpickled(data[file.tell() :], where)
        if not isinstance(found, np.ndarray) or found.dtype.char != "O" or found.shape != tuple(shape):
            raise DataError(f"{where}: its header says an array of objects, the rest is none; {AGAIN}")
        return found
    return _array(data[file.tell() :], dtype, tuple(shape), fortran, where)


def _array(data: bytes, dtype: np.dtype, shape: tuple[int, ...], fortran: bool, where: str) -> NDArray:
    if dtype.hasobject or dtype.names or dtype.subdtype or dtype.char not in KINDS or dtype.itemsize == 0:
        raise DataError(f"{where}: holds an array of {dtype}, expected plain numbers or text")
    if not all(isinstance(n, int) and n >= 0 for n in shape) or math.prod(shape) * dtype.itemsize != len(data):
        raise DataError(
            f"{where}: {len(data)} bytes follow the header of a {dtype} array of shape {shape}, which takes"
            f" {math.prod(shape) * dtype.itemsize}: cut short or damaged; {AGAIN}"
        )
    try:
        return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
    except Exception as error:  # absurd shapes of empty arrays
        raise DataError(f"{where}: no array of shape {shape} ({_said(error)}); {AGAIN}") from error


# -- pickle ------------------------------------------------------------------------------------


def unpickled(data: bytes, where: str, also: Also | None = None) -> Any:
    """What the bytes of a pickle hold.

    Args:
        data: the pickle.
        where: what an error begins with.
        also: returns a stand-in for a further class, by module and name, or None to refuse it.

    Raises:
        DataError: damaged or refused; begins with `where`.
    """
    if data.startswith(COMPRESSED):
        raise DataError(
            f"{where}: is compressed, expected a plain pickle. If you trust the file, {BY_HAND['joblib.']} and save "
            "plain arrays"
        )
    also = also or (lambda module, name: None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # damaged text has escapes that mean nothing
            joblib = all(word.encode() in data for word in WRAPPER)
            for opcode, argument, _ in () if joblib else pickletools.genops(data):
                # A damaged memo index would make the unpickler reserve and fill gigabytes.
                if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and int(argument or 0) > len(data):
                    raise DataError(f"{where}: not a whole pickle (entry {argument} in {len(data)} bytes); {AGAIN}")
            held = (_Joblib if joblib else _Restricted)(io.BytesIO(data), where, also).load()
        return _plain(held, where, {}, 0)
    except DataError as error:
        raise error if str(error).startswith(where) else DataError(f"{where}: {error}") from error
    except Exception as error:  # a damaged pickle raises whatever its accidental opcodes lead to
        raise DataError(f"{where}: not a whole pickle ({_said(error)}); {AGAIN}") from error


class StandIn:
    """Stands for a class that is not loaded, and keeps its state until the whole pickle is read."""

    state: Mapping[str, Any] = {}

    def __init__(self, *_: object) -> None:
        """Arguments are not needed."""

    def __setstate__(self, state: Any) -> None:
        self.state = state if isinstance(state, Mapping) else {}

    def real(self, inner: Callable[[Any], Any]) -> Any:
        """The object in plain data.

        Args:
            inner: returns plain data for something in `state`.

        Raises:
            DataError: its state makes no sense.
        """
        raise NotImplementedError


class _Dtype:
    """Stands for numpy.dtype while a pickle is read, because numpy.dtype trusts its state."""

    def __init__(self, code: str | bytes, align: object = False, copy: object = False) -> None:
        self.code = code.decode("latin-1") if isinstance(code, bytes) else str(code)
        self.order = "="

    def __setstate__(self, state: tuple) -> None:
        order, subdtype, names = state[1:4]
        if subdtype is not None or names is not None:
            raise DataError("an array of records, expected plain numbers")
        self.order = order.decode("latin-1") if isinstance(order, bytes) else str(order)

    def real(self) -> np.dtype:
        if self.code[:1] == "O":
            return np.dtype(object)
        dtype = np.dtype(self.code)
        if dtype.names or dtype.subdtype or dtype.char not in KINDS:
            raise DataError(f"an array of {dtype}, expected plain numbers")
        return dtype.newbyteorder(">") if self.order == ">" else dtype


class _Array:
    """Stands for numpy.ndarray until the whole pickle is read."""

    def __init__(self, *_: object) -> None:
        self.state: tuple[tuple[int, ...], _Dtype, bool, Any] | None = None

    def __setstate__(self, state: tuple) -> None:
        shape, dtype, fortran, raw = state[-4:]
        self.state = (tuple(shape), dtype, bool(fortran), raw)


def _from_buffer(raw: Any, dtype: _Dtype, shape: tuple[int, ...], order: str) -> _Array:
    array = _Array()
    array.state = (tuple(shape), dtype, order == "F", raw)
    return array


def _scalar(dtype: _Dtype, raw: Any = b"") -> Any:
    real = dtype.real()
    return raw if real.char == "O" else _array(_bytes(raw), real, (), False, "a number")[()]


def _encode(text: str, encoding: str = "latin-1") -> bytes:
    return text.encode(encoding)


def _bytes(raw: Any) -> bytes:
    if not isinstance(raw, str | bytes | bytearray | memoryview):  # of a number, `bytes` would be so many zeros
        raise DataError(f"not a whole pickle ({type(raw).__name__} in place of an array's bytes); {AGAIN}")
    return raw.encode("latin-1") if isinstance(raw, str) else bytes(raw)


ADMITTED: dict[str, Callable[..., Any]] = {
    "numpy ndarray": _Array,
    "numpy dtype": _Dtype,
    "numpy.core.multiarray _reconstruct": _Array,
    "numpy._core.multiarray _reconstruct": _Array,
    "numpy.core.multiarray scalar": _scalar,
    "numpy._core.multiarray scalar": _scalar,
    "numpy.core.numeric _frombuffer": _from_buffer,
    "numpy._core.numeric _frombuffer": _from_buffer,
    "_codecs encode": _encode,
    "collections OrderedDict": OrderedDict,
    "collections defaultdict": lambda *_: {},
    **{
        f"{module} {name}": call
        for module in ("builtins", "__builtin__")
        for name, call in (
            ("set", set),
            ("frozenset", frozenset),
            ("complex", complex),
            ("bytes", lambda: b""),
            ("dict", lambda: {}),  # what a defaultdict makes of keys that are not there, as list
            ("list", lambda: []),
        )
    },
}
"""Everything that a pickle may name; numpy's are replaced by stand-ins."""
BY_HAND = {
    "joblib.": "open it with joblib.load, as joblib wrote it,",
    "torch.": "load it yourself, make arrays of its tensors by .cpu().numpy()",
}
"""How a trusted file of some packages' classes is opened, by how their modules begin."""
WRAPPER = ("joblib.numpy_pickle", "NumpyArrayWrapper")
"""Module and name of what joblib pickles for an array, whose numbers it writes behind that."""
COMPRESSED = (b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda", b"\x1f\x8b", b"BZh", b"\xfd7zXZ")
"""How the bytes of zlib, gzip, bz2 and xz begin, and those of no pickle."""


class _Call:
    """A function that a pickle may call and, unlike a bare one, not change: its defaults would last."""

    def __init__(self, call: Callable[..., Any]) -> None:
        self.call = call

    def __call__(self, *arguments: Any) -> Any:
        return self.call(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise DataError(f"not a whole pickle (it changes a function); {AGAIN}")


class _Admitting:
    """What both unpicklers let a pickle name."""

    where: str
    also: Also

    def find_class(self, module: str, name: str) -> Any:
        """Only what is admitted."""
        admitted = ADMITTED.get(f"{module} {name}") or self.also(module, name)
        if admitted is None:
            by_hand = next((how for package, how in BY_HAND.items() if module.startswith(package)), "load it yourself")
            raise DataError(
                f"{self.where}: the pickle names {module}.{name}, which is not loaded because a pickle can run code; "
                f"expected numpy arrays, numbers, text, dict, list and tuple. If you trust the file, {by_hand} and "
                "save plain arrays"
            )
        return admitted if isinstance(admitted, type) else _Call(admitted)

    def persistent_load(self, pid: Any) -> Any:
        """Refused."""
        raise DataError(f"{self.where}: the pickle refers to an object outside it ({pid!r}); {AGAIN}")


class _Restricted(_Admitting, pickle.Unpickler):
    def __init__(self, file: io.BytesIO, where: str, also: Also) -> None:
        super().__init__(file, encoding="latin-1")
        self.where, self.also = where, also


class _Joblib(_Admitting, pickle._Unpickler):
    """Reads what joblib wrote: behind the state of a wrapper the numbers of its array follow in the file.

    Opcodes cannot be looked through here: it is Python's unpickler, which fills memory before it reads for bytearrays
    alone, and here for none.
    """

    def __init__(self, file: io.BytesIO, where: str, also: Also) -> None:
        super().__init__(file, encoding="latin-1")
        self.where, self.also, self.file = where, also, file

    def find_class(self, module: str, name: str) -> Any:
        """What is admitted, and the wrapper."""
        own = (module, name) == WRAPPER
        return type("_Wrapped", (_Wrapped,), {"unpickler": self}) if own else super().find_class(module, name)

    def _load_bytes(self) -> None:
        self.append(self.read(int.from_bytes(self.read(8), "little")))  # type: ignore[attr-defined]

    dispatch: ClassVar[dict[int, Any]] = {**pickle._Unpickler.dispatch, pickle.BYTEARRAY8[0]: _load_bytes}


class _Wrapped(StandIn):
    """An array of which joblib has pickled a description, and written the numbers behind it."""

    unpickler: _Joblib

    def __setstate__(self, state: Any) -> None:
        super().__setstate__(state)
        reader, dtype, shape = self.unpickler, self.state["dtype"].real(), tuple(self.state["shape"])
        if dtype.char == "O":
            self.array = _Joblib(reader.file, reader.where, reader.also).load()
            return
        if self.state.get("numpy_array_alignment_bytes") is not None:  # since joblib 1.3: how many bytes to pass over
            reader.file.read(reader.file.read(1)[0])
        count, fortran = math.prod(shape), self.state["order"] == "F"
        self.array = _array(reader.file.read(count * dtype.itemsize), dtype, shape, fortran, reader.where)

    def real(self, inner: Callable[[Any], Any]) -> Any:
        """The array."""
        return self.array if isinstance(self.array, np.ndarray) else inner(self.array)


def _plain(found: Any, where: str, done: dict[int, Any], depth: int) -> Any:
    """Stand-ins replaced by what they stand for, bytes keys by str."""
    if depth > DEEPEST:
        raise DataError(f"{where}: nested more than {DEEPEST} deep; {AGAIN}")
    if id(found) in done:
        return done[id(found)][1]

    def inner(item: Any) -> Any:
        return _plain(item, where, done, depth + 1)

    plain = found
    if isinstance(found, dict):
        plain = {k.decode("latin-1") if isinstance(k, bytes) else inner(k): inner(v) for k, v in found.items()}
    elif isinstance(found, list | tuple | set | frozenset):
        plain = type(found)(inner(item) for item in found)
    elif isinstance(found, _Array):
        plain = _real(found, where, inner)
    elif isinstance(found, StandIn):
        plain = found.real(inner)
    elif not isinstance(found, str | bytes | bool | int | float | complex | np.generic | None):
        raise DataError(f"{where}: the pickle holds a bare {type(found).__name__}; {AGAIN}")
    done[id(found)] = (found, plain)  # the original is kept too, so that no other object gets its id
    return plain


def _real(array: _Array, where: str, inner: Callable[[Any], Any]) -> NDArray:
    if array.state is None:
        raise DataError(f"{where}: an array without data; {AGAIN}")
    shape, stand_in, fortran, raw = array.state
    dtype = stand_in.real()
    if dtype.char != "O":
        return _array(_bytes(raw), dtype, shape, fortran, where)
    if not isinstance(raw, list) or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise DataError(f"{where}: an array of objects that lists none; {AGAIN}")
    if math.prod(shape) != len(raw):
        raise DataError(f"{where}: {len(raw)} objects for an array of shape {shape}; {AGAIN}")
    objects = np.empty(len(raw), dtype=object)
    for k, item in enumerate(raw):
        objects[k] = inner(item)
    return objects.reshape(shape, order="F" if fortran else "C")


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0][:160]
