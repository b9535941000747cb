"""GNS `.npz` files: one object array per trajectory, or all of them in one named `gns_data`.

A trajectory is `(positions [T, N, d], particle_type [N] or an int)` with an optional third entry,
`material_property [N]`. The members hold pickles, which `restricted_pickle` reads without running.
"""

from __future__ import annotations

import pickle
import pickletools
import zipfile
import zlib
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from adaptgns.data import restricted_pickle
from adaptgns.data.cache import CACHE_BYTES, TrajectoryCache
from adaptgns.data.errors import DataError
from adaptgns.data.trajectory import (
    Shape,
    Trajectory,
    check_type_range,
    material_properties,
    particle_types,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_BUNDLE = "gns_data"

_PEEK_BYTES = 4096
"""Enough for a pickle's opcodes up to the first array's numbers (about 300 bytes)."""

_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    pickle.UnpicklingError,
    EOFError,
    OSError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    MemoryError,
    OverflowError,
)
"""What zipfile and the unpickler raise for bytes that aren't what they should be."""


class NpzSource:
    """Trajectories of a GNS `.npz`; each is read whole on first use and kept while memory allows.

    Files with one member per trajectory are opened without reading positions. A `gns_data` file
    is one pickle and can only be read, and held, whole.
    """

    def __init__(self, path: Path, *, cache_bytes: int = CACHE_BYTES) -> None:
        self.path = path
        self._cache_bytes = cache_bytes
        with self._archive() as archive:
            members = [name for name in archive.namelist() if name.endswith(".npy")]
        if not members:
            raise DataError(f"{path}: holds no .npy member, so no trajectory")
        self._bundled = members == [f"{_BUNDLE}.npy"]
        self._members = members
        self.shapes: tuple[Shape, ...] = ()
        self._forget()
        if self._bundled:
            loaded = self._load_bundle()
            self.shapes = tuple(_shape(trajectory) for trajectory in loaded)
        else:
            self.shapes = tuple(self._peek(index) for index in range(len(members)))

    def read(self, index: int, start: int, stop: int) -> Trajectory:
        whole = self._load_bundle()[index] if self._bundled else self._cache[index]
        material = whole.material_property
        return Trajectory(
            name=whole.name,
            positions=whole.positions[start:stop].copy(),
            particle_type=whole.particle_type.copy(),
            material_property=None if material is None else material.copy(),
        )

    def material_properties(self) -> int:
        first = self._load_bundle()[0] if self._bundled else self._cache[0]
        return 0 if first.material_property is None else first.material_property.shape[1]

    def __getstate__(self) -> dict[str, Any]:
        kept = {"path", "shapes", "_bundled", "_cache_bytes", "_members"}
        return {name: value for name, value in vars(self).items() if name in kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._forget()

    def _forget(self) -> None:
        self._cache = TrajectoryCache(self._load_member, self._cache_bytes)
        self._bundle: list[Trajectory] | None = None

    @contextmanager
    def _archive(self) -> Iterator[zipfile.ZipFile]:
        try:
            archive = zipfile.ZipFile(self.path)
        except FileNotFoundError:
            raise DataError(f"{self.path}: there is no such file") from None
        except _DAMAGE as error:
            raise DataError(
                f"{self.path}: not a readable npz (zip) file of {self.path.stat().st_size} bytes: "
                f"{error}; copy or download it again"
            ) from error
        with archive:
            yield archive

    @contextmanager
    def _member(self, name: str) -> Iterator[tuple[IO[bytes], tuple[int, ...]]]:
        """A member's stream, past its header, and the shape of its object array."""
        where = f"{self.path}: {name}"
        with self._archive() as archive:
            try:
                with archive.open(name) as stream:
                    version = np.lib.format.read_magic(stream)
                    header = (
                        np.lib.format.read_array_header_1_0
                        if version == (1, 0)
                        else np.lib.format.read_array_header_2_0
                    )
                    shape, _, dtype = header(stream)
                    if not dtype.hasobject:
                        raise DataError(
                            f"{where}: an array of dtype {dtype} and shape {list(shape)}; an "
                            "object array (positions, particle_type[, material_property]) is "
                            "accepted"
                        )
                    yield stream, shape
            except DataError:
                raise
            except restricted_pickle.RefusedPickleError as error:
                raise DataError(f"{where}: refused, since it asks for {error}") from None
            except _DAMAGE as error:
                offset = archive.getinfo(name).header_offset
                raise DataError(
                    f"{where} (at byte {offset}): damaged or truncated: {type(error).__name__}: "
                    f"{error}; copy or download it again"
                ) from error

    def _load(self, name: str) -> Any:
        with self._member(name) as (stream, _):
            value = restricted_pickle.load(stream)
            # Reading to the end is what makes zipfile compare the checksum.
            if stream.read(1):
                raise DataError(f"{self.path}: {name}: bytes follow the end of the array")
            return value

    def _load_member(self, index: int) -> Trajectory:
        name = self._members[index]
        trajectory = _trajectory(self._load(name), _stem(name), f"{self.path}: {_stem(name)}")
        if self.shapes and _shape(trajectory) != self.shapes[index]:
            raise DataError(f"{self.path}: {name}: changed since the file was opened")
        return trajectory

    def _load_bundle(self) -> list[Trajectory]:
        if self._bundle is None:
            rows = self._load(self._members[0])
            if not isinstance(rows, np.ndarray) or rows.ndim not in {1, 2}:
                raise DataError(f"{self.path}: {_BUNDLE} isn't an array of trajectories")
            self._bundle = [
                _trajectory(row, str(i), f"{self.path}: trajectory {i}")
                for i, row in enumerate(rows)
            ]
        return self._bundle

    def _peek(self, index: int) -> Shape:
        """The shape of a member's positions, from the first bytes of its pickle where possible."""
        name = self._members[index]
        with self._member(name) as (stream, _):
            shape = _first_array_shape(stream.read(_PEEK_BYTES))
        if shape is None:
            return _shape(self._cache[index])
        frames, particles, dim = shape
        return Shape(_stem(name), frames, particles, dim)


def _first_array_shape(head: bytes) -> tuple[int, int, int] | None:
    """The first three-dimensional shape in a pickle's opcodes: `(T, N, d)` of the positions.

    The opcodes are only listed, never run. None where the head has no such tuple.
    """
    recent: list[int | None] = []
    try:
        for opcode, argument, _ in pickletools.genops(head):
            if opcode.name == "TUPLE3" and len(recent) >= 3:
                frames, particles, dim = recent[-3:]
                if frames is not None and particles is not None and dim is not None:
                    return frames, particles, dim
            is_integer = opcode.name in {"BININT", "BININT1", "BININT2", "LONG1"}
            recent.append(argument if is_integer else None)
    except ValueError:
        pass  # the head ends inside an argument
    return None


def _stem(member: str) -> str:
    return member.removesuffix(".npy")


def _shape(trajectory: Trajectory) -> Shape:
    return Shape(trajectory.name, *trajectory.positions.shape)


def _trajectory(value: Any, name: str, where: str) -> Trajectory:
    if isinstance(value, np.ndarray) and value.shape == ():
        value = value.item()
    entries = list(value) if isinstance(value, (np.ndarray, tuple, list)) else []
    if len(entries) not in {2, 3}:
        raise DataError(
            f"{where}: {len(entries)} entries; (positions, particle_type) or (positions, "
            "particle_type, material_property) are accepted"
        )
    positions = np.asarray(entries[0])
    if positions.ndim != 3 or positions.dtype.kind != "f":
        raise DataError(
            f"{where}: positions have shape {list(positions.shape)} and dtype {positions.dtype}; "
            "floating [T, N, d] is accepted"
        )
    particles = positions.shape[1]
    types = particle_types(entries[1], particles, where)
    check_type_range(types, where)
    material = material_properties(entries[2], particles, where) if len(entries) == 3 else None
    return Trajectory(name, positions.astype(np.float32, copy=False), types, material)
