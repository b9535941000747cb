"""Writes GNS `.npz` files as geoelements/gns loads them: one object array per trajectory."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from adaptgns.atomic import written_whole
from adaptgns.data.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from adaptgns.data.trajectory import Trajectory


def write_npz(path: Path, trajectories: Iterable[Trajectory]) -> None:
    """Writes trajectories to `path`, whole or not at all, holding one of them at a time.

    Raises:
        DataError: a trajectory with several material properties, of which geoelements takes one.
        OSError: the disk is full.
    """
    with written_whole(Path(path)) as partial, zipfile.ZipFile(partial, "w") as archive:
        for index, trajectory in enumerate(trajectories):
            entries = [trajectory.positions, trajectory.particle_type]
            material = trajectory.material_property
            if material is not None:
                if material.shape[1] != 1:
                    raise DataError(
                        f"{path}: trajectory {trajectory.name}: {material.shape[1]} material "
                        "properties; geoelements/gns, whose format this is, takes at most 1"
                    )
                entries.append(material[:, 0])
            row = np.empty(len(entries), dtype=object)
            row[:] = entries
            with archive.open(f"simulation_trajectory_{index}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, row, allow_pickle=True)
