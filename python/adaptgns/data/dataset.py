"""Writing a data set of one's own: its splits, its statistics and its metadata."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptgns.atomic import folder_written_whole
from adaptgns.data.errors import DataError
from adaptgns.data.metadata import (
    GNS_KINEMATIC,
    RADIUS_KEY,
    Metadata,
    read_metadata,
    write_metadata,
)
from adaptgns.data.store import write_split
from adaptgns.data.trajectories import SPLITS, find_split, open_split

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from adaptgns.data.trajectory import Trajectory


def write_dataset(
    folder: Path | str,
    splits: Mapping[str, Iterable[Trajectory]],
    *,
    dt: float,
    bounds: Sequence[Sequence[float]],
    radius: float,
    periodic: Sequence[bool] | None = None,
    kinematic_types: Sequence[int] = GNS_KINEMATIC,
) -> Metadata:
    """Writes a data set that every command here reads, and LagrangeBench too.

    Args:
        folder: made here; must not exist, or be empty. It appears whole or not at all.
        splits: trajectories of `train` (needed: the statistics come from it), `valid` and `test`;
            generators are taken one trajectory at a time.
        dt: time between frames, in the data's time unit.
        bounds: `(low, high)` per axis, in the data's length unit.
        radius: connectivity radius, in the data's length unit.
        periodic: per axis, whether `high` is the same place as `low`; None: nowhere.
        kinematic_types: particle types that follow their given trajectory.

    Returns:
        The metadata, with the statistics of `train`.

    Raises:
        DataError: the folder is taken, or a trajectory or an argument can't be.
        OSError: the disk is full or the folder can't be written.
    """
    folder = Path(folder)
    unknown = [name for name in splits if name not in SPLITS]
    if unknown or "train" not in splits:
        raise DataError(
            f"splits are {', '.join(splits) or 'none'}; train is needed, and only "
            f"{', '.join(SPLITS)} are accepted"
        )
    refuse_taken(folder)
    content: dict[str, Any] = {
        "dim": len(bounds),
        "dt": float(dt),
        "write_every": 1,
        "bounds": [list(map(float, axis)) for axis in bounds],
        "periodic_boundary_conditions": [False] * len(bounds)
        if periodic is None
        else [bool(axis) for axis in periodic],
        "kinematic_types": [int(kind) for kind in kinematic_types],
        RADIUS_KEY: float(radius),
    }
    with folder_written_whole(folder) as partial:
        try:
            write_metadata(partial, content)
            for split, trajectories in splits.items():
                write_split(partial / f"{split}.h5", trajectories)
            write_metadata(partial, content | counts(partial))
            return read_metadata(partial)
        except DataError as error:
            raise DataError(str(error).replace(str(partial), str(folder))) from error


def refuse_taken(path: Path) -> None:
    """Raises `DataError` where something is at `path` that could be lost."""
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        raise DataError(f"{path}: exists; choose another name or remove it")


def counts(folder: Path) -> dict[str, Any]:
    """What LagrangeBench wants to know of the splits in `folder`, under its names."""
    found = {split: open_split(folder, split) for split in SPLITS if find_split(folder, split)}
    material = {name: split.material_properties for name, split in found.items()}
    if len(set(material.values())) > 1:
        raise DataError(
            "material properties: "
            + ", ".join(f"{name} has {number}" for name, number in material.items())
            + "; the same number in all splits is accepted"
        )
    content: dict[str, Any] = {
        "num_particles_max": max(int(split.particle_counts.max()) for split in found.values()),
        "material_properties": next(iter(material.values())),
    }
    for name, split in found.items():
        content[f"sequence_length_{name}"] = int(split.lengths.max())
        content[f"num_trajs_{name}"] = len(split)
    return content
