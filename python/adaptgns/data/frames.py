"""Folders of VTK, VTU or PLY files, one per frame, read through meshio (the extra `formats`).

The points are the particles. Point data that mean something here: `particle_type`,
`material_property`, and one of `particle_id`, `id`, `ids`, `Idp` (DualSPHysics), by which particles
are ordered, since solvers that sort particles in space write them in another order every time.
"""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from adaptgns.data.errors import DataError
from adaptgns.data.trajectory import (
    Shape,
    Trajectory,
    check_finite,
    check_shape,
    check_type_range,
    material_properties,
    particle_types,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

SUFFIXES = (".vtk", ".vtu", ".ply")

_IDS = ("particle_id", "id", "ids", "Idp")

_PLY_HEADER_BYTES = 1 << 16


def holds_frames(folder: Path) -> bool:
    """Whether there are frames in `folder`."""
    return folder.is_dir() and any(path.suffix in SUFFIXES for path in folder.iterdir())


class FrameFolders:
    """One trajectory from a folder of frames, or one from each of its subfolders, by name.

    Frames are ordered by the last number in their names. Positions are narrowed to float32.

    Attributes:
        path: the folder.
    """

    def __init__(
        self, path: Path, *, dim: Literal[2, 3] | None = None, flatten: bool = False
    ) -> None:
        """With `dim` None, a trajectory is two-dimensional if z is 0 in its first frame.
        Two-dimensional data whose z is not 0 are refused unless `flatten` leaves it out.

        Raises:
            DataError: there are no frames.
        """
        self.path = path
        self._dim = dim
        self._flatten = flatten
        subfolders = sorted(entry for entry in path.iterdir() if holds_frames(entry))
        self._folders = [path] if holds_frames(path) else subfolders
        if not self._folders:
            raise DataError(f"{path}: no {', '.join(SUFFIXES)} files, nor folders that hold some")

    def __len__(self) -> int:
        return len(self._folders)

    def __iter__(self) -> Iterator[Trajectory]:
        return (_trajectory(folder, self._dim, self._flatten) for folder in self._folders)


def _trajectory(folder: Path, dim: int | None, flatten: bool) -> Trajectory:
    paths = _ordered(folder)
    first = _read(paths[0])
    dim = dim or (3 if first.points[:, 2].any() else 2)
    particles = len(first.points)
    check_shape(Shape(folder.name, len(paths), particles, dim), str(folder))
    positions = np.empty((len(paths), particles, dim), dtype=np.float32)
    for frame, path in enumerate(paths):
        snapshot = first if frame == 0 else _read(path)
        _check_alike(snapshot, first, path, paths[0])
        if dim == 2 and not flatten and snapshot.points[:, 2].any():
            raise DataError(
                f"{path}: z isn't 0, but the data have two dimensions by {paths[0].name} or by "
                "their metadata.json; say --dim 3, or --dim 2 to leave z out"
            )
        positions[frame] = snapshot.points[:, :dim]
    where = str(folder)
    types = particle_types(first.types, particles, where)
    check_type_range(types, where)
    material = first.material
    if material is not None:
        material = material_properties(material, particles, where)
    trajectory = Trajectory(folder.name, positions, types, material)
    check_finite(trajectory, 0, where)
    return trajectory


class _Frame:
    """The particles of one file, ordered by their ids where it has some."""

    def __init__(self, points: npt.NDArray[Any], data: dict[str, npt.NDArray[Any]]) -> None:
        name = next((name for name in _IDS if name in data), None)
        ids = np.arange(len(points)) if name is None else np.asarray(data[name]).ravel()
        order = np.argsort(ids, kind="stable")
        self.ids = ids[order]
        self.points = points[order]
        self.types = np.zeros(len(points), np.int64)
        if "particle_type" in data:
            # Formats without integer arrays hold the types as floats.
            self.types = _integers(np.asarray(data["particle_type"]).ravel()[order])
        material = data.get("material_property")
        self.material = None if material is None else np.asarray(material)[order]


def _integers(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    whole = values.astype(np.int64)
    return whole if (whole == values).all() else values


def _ordered(folder: Path) -> list[Path]:
    paths = [path for path in folder.iterdir() if path.suffix in SUFFIXES]
    suffixes = {path.suffix for path in paths}
    if len(suffixes) > 1:
        raise DataError(
            f"{folder}: frames in {', '.join(sorted(suffixes))}; one format is accepted"
        )
    numbers: dict[int, Path] = {}
    for path in sorted(paths):
        found = re.findall(r"\d+", path.stem)
        if not found:
            raise DataError(f"{path}: no number in its name; frames are ordered by the last one")
        other = numbers.setdefault(int(found[-1]), path)
        if other is not path:
            raise DataError(f"{path}: the same frame number as {other.name}")
    ordered = sorted(numbers)
    steps = Counter(after - before for before, after in pairwise(ordered))
    for before, after in pairwise(ordered):
        if after - before != (usual := steps.most_common(1)[0][0]):
            raise DataError(
                f"{folder}: frame {after} follows frame {before}, elsewhere they are {usual} "
                "apart; frames evenly apart in time are accepted, so one may be missing"
            )
    return [numbers[number] for number in ordered]


def _read(path: Path) -> _Frame:
    try:
        import meshio  # noqa: PLC0415 - an optional dependency
    except ImportError as error:
        raise DataError(
            f"{path}: reading it needs meshio; pip install 'adaptgns[formats]'"
        ) from error
    size = path.stat().st_size
    if path.suffix == ".ply":
        with path.open("rb") as file:
            # meshio looks for the end of a header forever.
            if b"end_header" not in file.read(_PLY_HEADER_BYTES):
                raise DataError(
                    f"{path}: no PLY header in its {size} bytes; write or copy it again"
                )
    try:
        # meshio.read would end the process for a file that it can't read.
        mesh = getattr(meshio, path.suffix[1:]).read(path)
        points = np.asarray(mesh.points, dtype=np.float64)
        frame = _Frame(np.pad(points, ((0, 0), (0, 3 - points.shape[1]))), mesh.point_data)
    except Exception as error:  # of many kinds, for bytes that aren't what they should be
        raise DataError(
            f"{path}: damaged, cut off at byte {size}, or of a kind that meshio doesn't read "
            f"({type(error).__name__}: {error}); write or copy it again"
        ) from error
    if not len(frame.points):
        raise DataError(f"{path}: no points")
    return frame


def _check_alike(frame: _Frame, first: _Frame, path: Path, first_path: Path) -> None:
    if len(frame.points) != len(first.points):
        raise DataError(
            f"{path}: {len(frame.points)} particles, {first_path.name} has {len(first.points)}; a "
            "trajectory keeps its particles"
        )
    if (frame.ids != first.ids).any():
        raise DataError(f"{path}: other particle ids than {first_path.name} has")
    if (frame.types != first.types).any():
        raise DataError(f"{path}: other particle types than {first_path.name} has")
