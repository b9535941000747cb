"""The native store: HDF5 in LagrangeBench's layout.

One group per trajectory (`00000`, `00001`, ...) with `position` float32 `[T, N, d]`,
`particle_type` `[N]` and optionally `material_property` `[N]` or `[N, P]` and `step_context`
`[T, C]`. Files written here
keep positions contiguous and uncompressed, so that a window of frames is one read at a known
offset; LagrangeBench's own are compressed in chunks, and read just as well.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import h5py

from adaptgns.atomic import publish
from adaptgns.data.errors import DataError
from adaptgns.data.trajectory import (
    Shape,
    Trajectory,
    check_finite,
    check_shape,
    check_type_range,
    particle_types,
)

if TYPE_CHECKING:
    from collections.abc import Iterable
    from types import TracebackType

_ORIGIN = "adaptgns_origin"
"""Attribute of the file that says what made it; other readers don't look at it."""


class StoreWriter:
    """Streams trajectories into one HDF5 file, which gets its name only once it is whole.

    Used as a context manager: leaving it normally publishes the file; leaving it by an exception
    removes what was written. A killed process leaves only `partial_path(path)` behind.
    """

    def __init__(self, path: Path, *, origin: str | None = None) -> None:
        """Starts a file.

        Args:
            path: where the finished file goes; replaced if it exists.
            origin: what made the data, to be read back by `read_origin`.

        Raises:
            DataError: another process is writing the same file.
            OSError: the folder can't be written, or the disk is full.
        """
        self.path = Path(path)
        self._partial = partial_path(self.path)
        self._written = 0
        _remove_abandoned(self._partial)
        try:
            # Not "w", which would empty the file of another process before finding it locked.
            self._file = h5py.File(self._partial, "x")
            if origin is not None:
                self._file.attrs[_ORIGIN] = origin
        except FileExistsError as error:
            raise DataError(f"{self._partial}: another process is writing it") from error
        except BaseException:  # an interruption, too
            self._partial.unlink(missing_ok=True)
            raise

    def append(self, trajectory: Trajectory) -> None:
        """Adds a trajectory; its group is numbered, whatever its name.

        Raises:
            DataError: the trajectory couldn't be read back (too short, not finite, ...).
            OSError: the disk is full.
        """
        group = f"{self._written:05d}"
        where = f"{self.path}: trajectory {group}"
        if trajectory.positions.ndim != 3:
            raise DataError(
                f"{where}: positions have the shape {list(trajectory.positions.shape)}; "
                "[T, N, d] is accepted"
            )
        check_shape(Shape(group, *trajectory.positions.shape), where)
        check_finite(trajectory, 0, where)
        types = particle_types(trajectory.particle_type, trajectory.positions.shape[1], where)
        check_type_range(types, where)
        members = self._file.create_group(group)
        members.create_dataset("position", data=trajectory.positions, dtype="<f4")
        members.create_dataset("particle_type", data=types)
        if trajectory.material_property is not None:
            members.create_dataset("material_property", data=trajectory.material_property)
        if trajectory.step_context is not None:
            members.create_dataset("step_context", data=trajectory.step_context)
        self._written += 1

    def __enter__(self) -> StoreWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._file.close()
                publish(self._partial, self.path)
                return
            # On a full disk closing fails as well; the file is thrown away in any case.
            with suppress(OSError, RuntimeError):
                self._file.close()
        finally:
            self._partial.unlink(missing_ok=True)


def _remove_abandoned(partial: Path) -> None:
    """Removes what a killed process left, unless the process lives and holds HDF5's lock."""
    if not partial.exists():
        return
    try:
        h5py.File(partial, "r+").close()
    except BlockingIOError as error:
        raise DataError(f"{partial}: another process is writing it") from error
    except OSError:
        pass  # no whole HDF5 file, as is to be expected
    partial.unlink()


def write_split(path: Path, trajectories: Iterable[Trajectory]) -> None:
    """Writes trajectories to `path`, whole or not at all, holding one of them at a time.

    Raises:
        DataError: a trajectory that couldn't be read back.
        OSError: the disk is full.
    """
    with StoreWriter(path) as writer:
        for trajectory in trajectories:
            writer.append(trajectory)


def partial_path(path: Path) -> Path:
    """Where a file is while it is being written."""
    return path.with_name(f"{path.name}.partial")


def read_origin(path: Path) -> str | None:
    """What made the file, if it says so; None for foreign and unreadable files."""
    try:
        with h5py.File(path, "r") as file:
            origin = file.attrs.get(_ORIGIN)
    except OSError:
        return None
    return origin if isinstance(origin, str) else None
