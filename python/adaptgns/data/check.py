"""Reads a split once and tells what is wrong with it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from adaptgns.data.errors import DataError, DataWarning

if TYPE_CHECKING:
    from collections.abc import Iterator

    from adaptgns.data.metadata import Metadata
    from adaptgns.data.trajectories import Trajectories

_BLOCK_VALUES = 1 << 18
"""Numbers looked at together, so that a trajectory of any length fits."""

_TOLERANCE = 1e-6
"""Of the extent: float32 positions clamped to a wall may lie this much beyond its decimal."""


@dataclass(frozen=True)
class Problem:
    """Something wrong with the data; the message names file, trajectory and frame.

    Attributes:
        message: what is where, and what is accepted.
        fatal: whether the data can't be used, as against being used with suspicion.
    """

    message: str
    fatal: bool


def check_split(trajectories: Trajectories, metadata: Metadata) -> tuple[int, ...]:
    """Reads all of a split and raises or warns about what is wrong with its contents.

    Returns:
        The particle types that occur, ascending.

    Raises:
        DataError: a trajectory is damaged or not finite.

    Warns:
        DataWarning: particles lie outside the bounds.
    """
    types: set[int] = set()
    for problem in find_problems(trajectories, metadata, types):
        if problem.fatal:
            raise DataError(problem.message)
        warnings.warn(problem.message, DataWarning, stacklevel=2)
    return tuple(sorted(types))


def find_problems(
    trajectories: Trajectories, metadata: Metadata, types: set[int] | None = None
) -> Iterator[Problem]:
    """All that `check_split` would tell: one problem per unusable trajectory, then one for the
    particles outside the bounds, with their number and the first of them. The particle types that
    occur are added to `types`."""
    outside = _Outside(metadata)
    for index, frames in enumerate(trajectories.lengths.tolist()):
        values = int(trajectories.particle_counts[index]) * trajectories.dim
        step = max(_BLOCK_VALUES // values, 1)
        try:
            for start in range(0, frames, step):
                block = trajectories.window(index, start, min(start + step, frames))
                outside.look_at(block.name, start, block.positions, block.particle_type)
                if types is not None and start == 0:
                    types.update(np.unique(block.particle_type).tolist())
        except DataError as error:
            yield Problem(str(error), fatal=True)
    if outside.count:
        yield Problem(f"{trajectories.path}: {outside}", fatal=False)


class _Outside:
    """Counts non-kinematic particles beyond the bounds, along axes that aren't periodic."""

    def __init__(self, metadata: Metadata) -> None:
        low, high = np.array(metadata.bounds).T
        slack = _TOLERANCE * (high - low)
        wraps = np.array(metadata.periodic)
        self._low = np.where(wraps, -np.inf, low - slack)
        self._high = np.where(wraps, np.inf, high + slack)
        self._bounds = metadata.bounds
        self._kinematic = list(metadata.kinematic_types)
        self._seen = 0
        self._trajectories: dict[str, None] = {}
        self._first = ""
        self._farthest = 0.0
        self.count = 0

    def look_at(
        self,
        name: str,
        start: int,
        positions: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
        particle_type: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    ) -> None:
        moving = np.flatnonzero(~np.isin(particle_type, self._kinematic))
        self._seen += positions.shape[0] * len(moving)
        own = positions[:, moving]
        beyond = ((own < self._low) | (own > self._high)).any(axis=2)
        if not beyond.any():
            return
        if not self.count:
            frame, place = np.argwhere(beyond)[0]
            self._first = (
                f"trajectory {name}: frame {start + frame}: particle {moving[place]} at "
                f"{own[frame, place].tolist()}"
            )
        strays = own[beyond]
        excess = np.maximum(self._low - strays, strays - self._high).max()
        self._farthest = max(self._farthest, float(excess))
        self.count += int(beyond.sum())
        self._trajectories[name] = None

    def __str__(self) -> str:
        bounds = [list(axis) for axis in self._bounds]
        return (
            f"{self.count:,} of {self._seen:,} positions, in {len(self._trajectories)} "
            f"trajectories, lie outside the bounds {bounds} by up to {self._farthest:.2g}; first "
            f"{self._first}"
        )
