"""A split of a data set: trajectories, read lazily, whatever the format on disk."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from adaptgns.data.errors import DataError
from adaptgns.data.npz import NpzSource
from adaptgns.data.store_source import StoreSource
from adaptgns.data.trajectory import Source, Trajectory, check_finite, check_shape

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["SPELLINGS", "SPLITS", "Trajectories", "Trajectory", "find_split", "open_split"]

SPLITS = ("train", "valid", "test")

SPELLINGS = {"train": ("train",), "valid": ("valid", "val"), "test": ("test",)}
"""The names that a split's file may have."""


class Trajectories:
    """The trajectories of one split, read when asked for.

    Every frame that is read is checked to be finite. Instances hold no open file, so they may be
    pickled to spawned `DataLoader` workers and used in forked ones.

    Attributes:
        path: the file they come from.
        dim: number of spatial dimensions.
        lengths: int64 `[n]`, frames per trajectory.
        particle_counts: int64 `[n]`, particles per trajectory, padding left out.
        names: their names in the file.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.path = source.path
        self.names = tuple(shape.name for shape in source.shapes)
        self.lengths = np.array([shape.frames for shape in source.shapes], dtype=np.int64)
        self.particle_counts = np.array(
            [shape.particles for shape in source.shapes], dtype=np.int64
        )
        if not source.shapes:
            raise DataError(f"{self.path}: holds no trajectory")
        self.dim = source.shapes[0].dim
        for shape in source.shapes:
            where = f"{self.path}: trajectory {shape.name}"
            check_shape(shape, where)
            if shape.dim != self.dim:
                raise DataError(
                    f"{where}: positions have {shape.dim} dimensions, those of trajectory "
                    f"{self.names[0]} have {self.dim}"
                )

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Trajectory:
        index = self._position(index)
        return self.window(index, 0, int(self.lengths[index]))

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[index] for index in range(len(self)))

    def window(self, index: int, start: int, stop: int) -> Trajectory:
        """Frames `start` to `stop - 1` of trajectory `index`; only those are read.

        Raises:
            IndexError: no such trajectory or frames.
            DataError: the file is damaged, a frame holds NaN or infinity, or the trajectory has
                other material properties than the first.
        """
        index = self._position(index)
        if not 0 <= start < stop <= self.lengths[index]:
            raise IndexError(
                f"frames {start} to {stop} of trajectory {self.names[index]}, which has "
                f"{self.lengths[index]}"
            )
        trajectory = self._source.read(index, start, stop)
        check_finite(trajectory, start, f"{self.path}: trajectory {trajectory.name}")
        material = trajectory.material_property
        columns = 0 if material is None else material.shape[1]
        if columns != self.material_properties:
            raise DataError(
                f"{self.path}: trajectory {trajectory.name}: {columns} material properties, "
                f"trajectory {self.names[0]} has {self.material_properties}"
            )
        return trajectory

    @cached_property
    def material_properties(self) -> int:
        """Columns of `material_property` in the first trajectory; 0 where there are none."""
        return self._source.material_properties()

    def _position(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise IndexError(f"trajectory {index} of {len(self)} in {self.path}")
        return index % len(self)


def find_split(folder: Path, split: str) -> Path | None:
    """The file that holds `split` in `folder`: HDF5 before npz, None where there is neither."""
    if split not in SPLITS:
        raise DataError(f"split is {split!r}; {', '.join(SPLITS)} are accepted")
    candidates = [
        folder / f"{spelling}{suffix}"
        for suffix in (".h5", ".npz")
        for spelling in SPELLINGS[split]
    ]
    return next((path for path in candidates if path.is_file()), None)


def open_split(folder: Path, split: str) -> Trajectories:
    """Opens the `train`, `valid` or `test` split of the data set in `folder`.

    Checks the structure (shapes, lengths, dimensions); contents are checked as they are read.

    Raises:
        DataError: no such split, or a damaged or malformed file.
    """
    folder = Path(folder)
    path = find_split(folder, split)
    if path is None:
        raise DataError(f"{folder}: no {split}.h5 or {split}.npz; {_contents(folder)}")
    source: Source = StoreSource(path) if path.suffix == ".h5" else NpzSource(path)
    trajectories = Trajectories(source)
    declared = _declared_dim(folder)
    if declared is not None and declared != trajectories.dim:
        raise DataError(
            f"{path}: trajectory {trajectories.names[0]}: positions have {trajectories.dim} "
            f"dimensions, metadata.json says dim {declared}"
        )
    return trajectories


def _contents(folder: Path) -> str:
    if not folder.is_dir():
        return "there is no such folder" if not folder.exists() else "it isn't a folder"
    names = sorted(entry.name for entry in folder.iterdir())
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    others = any(Path(name).suffix in {".tfrecord", ".vtu", ".vtk", ".ply"} for name in names)
    hint = "; python -m adaptgns.convert reads other kinds" if others else ""
    return f"the folder holds {shown}{hint}" if names else "the folder is empty"


def _declared_dim(folder: Path) -> int | None:
    """`dim` of metadata.json, to compare with; its errors are told by `read_metadata`."""
    try:
        content: Any = json.loads((folder / "metadata.json").read_bytes())
    except (OSError, ValueError):
        return None
    if isinstance(content, dict):
        content = content.get("train", content)
    declared = content.get("dim") if isinstance(content, dict) else None
    return declared if isinstance(declared, int) else None
