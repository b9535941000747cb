"""Reads the native store (layout: `adaptgns.data.store`), LagrangeBench's files included."""

from __future__ import annotations

from contextlib import contextmanager, suppress
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

_AGAIN = "copy or download the file again"


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
            self._entries = [self._entry(file, name) for name in sorted(file, key=str)]
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
        with _told(f"{self.path}"), h5py.File(self.path, "r") as file:
            yield file

    def _entry(self, file: h5py.File, group: str) -> _Entry:
        where = f"{self.path}: trajectory {group}"
        with _told(where):
            return self._checked_entry(file, group, where)

    def _checked_entry(self, file: h5py.File, group: str, where: str) -> _Entry:
        members = file[group]
        if not isinstance(members, h5py.Group):
            raise DataError(f"{where}: a data set; a group per trajectory is accepted")
        for required in ("position", "particle_type"):
            if required not in (names := sorted(members, key=str)):
                raise DataError(f"{where}: no {required}; the group holds {names}")
            if not isinstance(members[required], h5py.Dataset):
                raise DataError(f"{where}: {required} is a group; a data set is accepted")
        position = members["position"]
        if position.ndim != 3 or position.dtype.kind != "f":
            raise DataError(
                f"{where}: position has shape {list(position.shape)} and dtype {position.dtype}; "
                "floating [T, N, d] is accepted"
            )
        particles = position.shape[1]
        types = particle_types(_read(members["particle_type"], where), particles, where)
        material = None
        if "material_property" in members:
            raw = _read(members["material_property"], where)
            material = material_properties(raw, particles, where)
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
        if entry.offset is not None:
            end, size = entry.offset + entry.nbytes, self.path.stat().st_size
            if end > size:
                raise DataError(
                    f"{where}: position goes on to byte {end}, but the file ends at byte {size}; "
                    f"it is truncated: {_AGAIN}"
                )
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
                f"the file ends here, at byte {self.path.stat().st_size}; it is truncated: {_AGAIN}"
            )
        return _clean(flat.reshape(stop - start, particles, dim), entry)

    def _read_chunked(self, entry: _Entry, start: int, stop: int) -> npt.NDArray[np.float32]:
        with self._file() as file:
            where = f"{self.path}: trajectory {entry.group}"
            return _clean(_read(file[entry.group]["position"], where, slice(start, stop)), entry)


@contextmanager
def _told(where: str) -> Iterator[None]:
    """Tells what h5py finds wrong, with its place ``where``."""
    try:
        yield
    except DataError:
        raise
    except FileNotFoundError:
        raise DataError(f"{where}: there is no such file") from None
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise DataError(f"{where}: damaged, truncated or not HDF5: {error}; {_AGAIN}") from error


def _read(dataset: h5py.Dataset, where: str, rows: slice | tuple[()] = ()) -> Any:
    """The ``rows`` of ``dataset``, or all of it; DataError that names the damaged part of it."""
    try:
        return dataset[rows]
    except (OSError, RuntimeError) as error:
        name = dataset.name.rpartition("/")[2]
        raise DataError(
            f"{where}: {name}: {_damaged_part(dataset)} can't be read: {error}; {_AGAIN}"
        ) from error


def _damaged_part(dataset: h5py.Dataset) -> str:
    """The first chunk that can't be read, and its bytes in the file, as far as it tells."""
    with suppress(OSError, RuntimeError, ValueError):  # where the index of chunks is damaged, too
        for index in range(dataset.id.get_num_chunks() if dataset.chunks else 0):
            chunk = dataset.id.get_chunk_info(index)
            starts, sizes = chunk.chunk_offset, dataset.chunks
            try:
                dataset[tuple(slice(at, at + size) for at, size in zip(starts, sizes, strict=True))]
            except OSError:
                end = chunk.byte_offset + chunk.size
                return f"the chunk at {list(starts)}, bytes {chunk.byte_offset} to {end},"
    return "part of it"


def _clean(positions: npt.NDArray[Any], entry: _Entry) -> npt.NDArray[np.float32]:
    """Native float32, without padding rows."""
    if entry.real is not None:
        positions = positions[:, entry.real]
    return positions.astype(np.float32, copy=False)
