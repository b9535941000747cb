"""Reads the native store (layout: `adaptgns.data.store`), LagrangeBench's files included."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import numpy.typing as npt

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

_PADDING = -1
"""LagrangeBench's particle type for rows that only fill up an array."""


@dataclass(frozen=True)
class _Entry:
    """A trajectory's place in the file and everything of it but the positions."""

    group: str
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    offset: int | None
    real: npt.NDArray[np.bool_] | None
    particle_type: npt.NDArray[np.int64]
    material_property: npt.NDArray[np.float32] | None

    @property
    def nbytes(self) -> int:
        return int(np.prod(self.shape)) * self.dtype.itemsize


class StoreSource:
    """Trajectories of one HDF5 file; no handle is held between reads.

    Contiguous positions are read straight from their offset, which costs one system call and
    needs no HDF5 library state (safe after a fork, and in threads). Chunked ones are read whole
    and kept, or frame by frame where one trajectory exceeds the cache.
    """

    def __init__(self, path: Path, *, cache_bytes: int = CACHE_BYTES) -> None:
        self.path = path
        self._cache_bytes = cache_bytes
        with self._file() as file:
            self._entries = [self._entry(file, name) for name in sorted(file)]
        self.shapes = tuple(
            Shape(entry.group, entry.shape[0], len(entry.particle_type), entry.shape[2])
            for entry in self._entries
        )
        self._cache = TrajectoryCache(self._load, self._cache_bytes)

    def read(self, index: int, start: int, stop: int) -> Trajectory:
        entry = self._entries[index]
        if entry.offset is not None:
            positions = self._read_contiguous(entry, start, stop)
        elif entry.nbytes <= CACHE_BYTES:
            positions = self._cache[index].positions[start:stop].copy()
        else:
            positions = self._read_chunked(entry, start, stop)
        material = entry.material_property
        return Trajectory(
            name=entry.group,
            positions=positions,
            particle_type=entry.particle_type.copy(),
            material_property=None if material is None else material.copy(),
        )

    def material_properties(self) -> int:
        material = self._entries[0].material_property
        return 0 if material is None else material.shape[1]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_cache"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._cache = TrajectoryCache(self._load, self._cache_bytes)

    @contextmanager
    def _file(self) -> Iterator[h5py.File]:
        try:
            with h5py.File(self.path, "r") as file:
                yield file
        except DataError:
            raise
        except FileNotFoundError:
            raise DataError(f"{self.path}: there is no such file") from None
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise DataError(f"{self.path}: damaged, truncated or not HDF5: {error}") from error

    def _entry(self, file: h5py.File, group: str) -> _Entry:
        where = f"{self.path}: trajectory {group}"
        members = file[group]
        if not isinstance(members, h5py.Group):
            raise DataError(f"{where}: a data set; a group per trajectory is accepted")
        for required in ("position", "particle_type"):
            if not isinstance(members.get(required), h5py.Dataset):
                raise DataError(f"{where}: no {required}; the group holds {sorted(members)}")
        position = members["position"]
        if position.ndim != 3 or position.dtype.kind != "f":
            raise DataError(
                f"{where}: position has shape {list(position.shape)} and dtype {position.dtype}; "
                "floating [T, N, d] is accepted"
            )
        particles = position.shape[1]
        types = particle_types(members["particle_type"][()], particles, where)
        material = None
        if "material_property" in members:
            material = material_properties(members["material_property"][()], particles, where)
        real = types != _PADDING
        if not real.all():
            types = types[real]
            material = None if material is None else material[real]
        check_type_range(types, where)
        entry = _Entry(
            group=group,
            shape=position.shape,
            dtype=position.dtype,
            offset=position.id.get_offset(),
            real=None if real.all() else real,
            particle_type=types,
            material_property=material,
        )
        if entry.offset is not None and entry.offset + entry.nbytes > self.path.stat().st_size:
            raise DataError(f"{where}: the file ends before its positions do; it is truncated")
        return entry

    def _load(self, index: int) -> Trajectory:
        entry = self._entries[index]
        positions = self._read_chunked(entry, 0, entry.shape[0])
        return Trajectory(entry.group, positions, entry.particle_type, entry.material_property)

    def _read_contiguous(self, entry: _Entry, start: int, stop: int) -> npt.NDArray[np.float32]:
        _, particles, dim = entry.shape
        per_frame = particles * dim
        assert entry.offset is not None
        try:
            flat = np.fromfile(
                self.path,
                dtype=entry.dtype,
                count=(stop - start) * per_frame,
                offset=entry.offset + start * per_frame * entry.dtype.itemsize,
            )
        except OSError as error:
            raise DataError(f"{self.path}: trajectory {entry.group}: {error}") from error
        if flat.size != (stop - start) * per_frame:
            raise DataError(
                f"{self.path}: trajectory {entry.group}: frame {start + flat.size // per_frame}: "
                "the file ends here; it is truncated"
            )
        return _clean(flat.reshape(stop - start, particles, dim), entry)

    def _read_chunked(self, entry: _Entry, start: int, stop: int) -> npt.NDArray[np.float32]:
        with self._file() as file:
            return _clean(file[entry.group]["position"][start:stop], entry)


def _clean(positions: npt.NDArray[Any], entry: _Entry) -> npt.NDArray[np.float32]:
    """Native float32, without padding rows."""
    if entry.real is not None:
        positions = positions[:, entry.real]
    return positions.astype(np.float32, copy=False)
