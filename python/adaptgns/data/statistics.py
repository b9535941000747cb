"""Mean and standard deviation of velocities and accelerations, per axis, in one streamed pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from adaptgns.data.errors import DataError
from adaptgns.periodic import minimum_image

if TYPE_CHECKING:
    from collections.abc import Collection

    from adaptgns.data.trajectories import Trajectories

FILE_KEYS = {
    "velocity_mean": "vel_mean",
    "velocity_std": "vel_std",
    "acceleration_mean": "acc_mean",
    "acceleration_std": "acc_std",
}
"""Our names and those that GNS and LagrangeBench both use in `metadata.json`."""

_BLOCK_VALUES = 1 << 18
"""Numbers held in float64 at a time: 2 MiB, which stay in a core's cache."""


@dataclass(frozen=True)
class MotionStatistics:
    """Moments per axis, of `x[t+1] - x[t]` (per frame) and its differences (per frame²).

    The mean and the population standard deviation over all frames and non-kinematic particles.
    """

    velocity_mean: tuple[float, ...]
    velocity_std: tuple[float, ...]
    acceleration_mean: tuple[float, ...]
    acceleration_std: tuple[float, ...]

    def to_file_keys(self) -> dict[str, list[float]]:
        """The moments under the names they have in `metadata.json`."""
        return {key: list(getattr(self, name)) for name, key in FILE_KEYS.items()}


class _Moments:
    """Mean and sum of squared deviations, merged block by block (Chan et al. 1983).

    Unlike sums of squares this doesn't cancel where the mean is large against the deviation.
    """

    def __init__(self, dim: int) -> None:
        self.count = 0
        self.mean = np.zeros(dim)
        self.deviation = np.zeros(dim)

    def add(self, values: npt.NDArray[np.float64]) -> None:
        """Takes in `[..., d]` values."""
        # One row per axis: numpy then sums pairwise, which is faster and rounds less than along
        # the first axis of [..., d].
        rows = values.reshape(-1, values.shape[-1]).T.copy()
        count = rows.shape[1]
        if count == 0:
            return
        mean = rows.mean(axis=1)
        rows -= mean[:, None]
        deviation = np.square(rows, out=rows).sum(axis=1)
        total = self.count + count
        shift = mean - self.mean
        self.deviation += deviation + np.square(shift) * (self.count * count / total)
        self.mean += shift * (count / total)
        self.count = total

    @property
    def std(self) -> npt.NDArray[np.float64]:
        return np.sqrt(self.deviation / self.count)


class MotionAccumulator:
    """Takes in positions and gives their motion statistics."""

    def __init__(
        self, dim: int, *, box: npt.NDArray[np.float64] | None, kinematic_types: Collection[int]
    ) -> None:
        self._box = box
        self._kinematic = list(kinematic_types)
        self._velocity = _Moments(dim)
        self._acceleration = _Moments(dim)

    def add(
        self,
        positions: npt.NDArray[np.float32],
        particle_type: npt.NDArray[np.int64],
        *,
        continues: bool = False,
    ) -> None:
        """Takes in frames `[T, N, d]` of one trajectory.

        With `continues`, the first two frames were the last two of the frames taken in before, so
        that their velocity has been counted.
        """
        kinematic = np.isin(particle_type, self._kinematic)
        own = positions[:, ~kinematic] if kinematic.any() else positions
        velocity = minimum_image(np.subtract(own[1:], own[:-1], dtype=np.float64), self._box)
        self._velocity.add(velocity[1:] if continues else velocity)
        self._acceleration.add(np.diff(velocity, axis=0))

    def finish(self) -> MotionStatistics:
        """The statistics of all frames taken in.

        Raises:
            DataError: there was nothing to measure, because every particle is kinematic.
        """
        if self._acceleration.count == 0:
            raise DataError(
                f"no motion to measure: all particles are of kinematic types {self._kinematic}"
            )
        return MotionStatistics(
            velocity_mean=tuple(self._velocity.mean.tolist()),
            velocity_std=tuple(self._velocity.std.tolist()),
            acceleration_mean=tuple(self._acceleration.mean.tolist()),
            acceleration_std=tuple(self._acceleration.std.tolist()),
        )


def compute_statistics(
    trajectories: Trajectories,
    *,
    box: npt.NDArray[np.float64] | None,
    kinematic_types: Collection[int],
) -> MotionStatistics:
    """The motion statistics of a split, read once, a bounded number of frames at a time.

    Args:
        trajectories: the split, usually `train`.
        box: period lengths, `inf` on open axes (`Metadata.box`); None when nothing is periodic.
        kinematic_types: particle types to leave out.

    Raises:
        DataError: the data is damaged or not finite, or every particle is kinematic.
    """
    motion = MotionAccumulator(trajectories.dim, box=box, kinematic_types=kinematic_types)
    for index, frames in enumerate(trajectories.lengths.tolist()):
        per_frame = int(trajectories.particle_counts[index]) * trajectories.dim
        step = max(_BLOCK_VALUES // per_frame, 1)
        for start in range(0, frames - 2, step):
            block = trajectories.window(index, start, min(start + step + 2, frames))
            motion.add(block.positions, block.particle_type, continues=start > 0)
    try:
        return motion.finish()
    except DataError as error:
        raise DataError(f"{trajectories.path}: {error}") from error
