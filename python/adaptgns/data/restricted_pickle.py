"""Reads the pickles inside `.npy` object arrays without ever running what they ask for.

A pickle is a program; the ones numpy writes call a handful of constructors. Here each of those
names resolves to a stand-in defined in this file, and every other name is refused, so that not
even numpy's own `__setstate__` (which trusts the flags it is given) sees foreign bytes. The
stand-ins only record; arrays are then built with `numpy.frombuffer` from plain numeric dtypes.
"""

from __future__ import annotations

import math
import pickle
from typing import IO, Any, NoReturn

import numpy as np
import numpy.typing as npt


class RefusedPickleError(Exception):
    """The pickle asks for something that numpy's arrays of numbers don't need."""


class _Dtype:
    """Stands for `numpy.dtype(code, align, copy)`."""

    def __init__(self, code: str, *_: object) -> None:
        if not isinstance(code, str):
            raise RefusedPickleError(f"a dtype made from {type(code).__name__}")
        self._code = code
        self._endian = "|"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._endian = str(state[1])

    @property
    def is_object(self) -> bool:
        return self._code in {"O", "O8", "O4"}

    def to_numpy(self) -> np.dtype[Any]:
        dtype = np.dtype(self._code)
        if dtype.kind not in "fiub" or dtype.hasobject:
            raise RefusedPickleError(f"an array of dtype {self._code!r}, which isn't a number")
        return np.dtype(f"{self._endian}{dtype.str[1:]}") if self._endian in "<>" else dtype


class _Array:
    """Stands for `numpy.ndarray`; filled by `__setstate__`, as numpy's own pickles do."""

    def __init__(self) -> None:
        self._state: tuple[tuple[int, ...], _Dtype, bool, Any] | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        shape, dtype, fortran, data = state[-4:]
        if not isinstance(dtype, _Dtype) or not isinstance(shape, tuple):
            raise RefusedPickleError("an array state of an unknown form")
        self._state = (tuple(int(n) for n in shape), dtype, bool(fortran), data)

    def to_numpy(self) -> npt.NDArray[Any]:
        """The array; object arrays hold values already freed of stand-ins."""
        if self._state is None:
            raise RefusedPickleError("an array without contents")
        shape, dtype, fortran, data = self._state
        if not dtype.is_object:
            flat = np.frombuffer(data, dtype=dtype.to_numpy())
            return flat.reshape(shape, order="F" if fortran else "C")
        if not isinstance(data, list) or len(data) != math.prod(shape):
            raise RefusedPickleError("an object array whose list doesn't fit its shape")
        objects = np.empty(len(data), dtype=object)
        for position, value in enumerate(data):
            objects[position] = _resolve(value)
        return objects.reshape(shape, order="F" if fortran else "C")


def _reconstruct(*_: object) -> _Array:
    return _Array()


def _from_buffer(data: Any, dtype: _Dtype, shape: tuple[int, ...], order: str) -> _Array:
    array = _Array()
    array.__setstate__((shape, dtype, order == "F", data))
    return array


def _scalar(dtype: _Dtype, data: bytes) -> Any:
    return np.frombuffer(data, dtype=dtype.to_numpy(), count=1)[0]


def _encode(text: str, encoding: str) -> bytes:
    """Protocols 0 to 2 carry bytes as Latin-1 text."""
    if encoding != "latin1":
        raise RefusedPickleError(f"text encoded as {encoding!r}")
    return text.encode("latin1")


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _encode,
    **{
        (f"numpy.{core}.{module}", name): stand_in
        for core in ("core", "_core")
        for module, name, stand_in in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _from_buffer),
        )
    },
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ALLOWED[module, name]
        except KeyError:
            raise RefusedPickleError(
                f"the global {module}.{name}; only numpy arrays of numbers, tuples, lists, "
                "ints and floats are accepted"
            ) from None

    def persistent_load(self, pid: object) -> NoReturn:
        raise RefusedPickleError("an object kept outside the file")


def _resolve(value: Any) -> Any:
    if isinstance(value, _Array):
        return value.to_numpy()
    if isinstance(value, (list, tuple)):
        return type(value)(_resolve(item) for item in value)
    if isinstance(value, (int, float, np.number)):
        return value
    raise RefusedPickleError(f"a value of type {type(value).__name__.lstrip('_')}")


def load(stream: IO[bytes]) -> Any:
    """The value pickled at the stream's position, made of arrays, tuples, lists and numbers.

    Raises `RefusedPickleError`, naming what was asked for, or whatever the standard library's
    unpickler raises for a damaged stream (`pickle.UnpicklingError`, `EOFError`, `ValueError`,
    `TypeError`, ...).
    """
    return _resolve(_Unpickler(stream).load())
