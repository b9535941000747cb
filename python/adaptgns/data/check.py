"""Reads a split once and tells what is wrong with it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from adaptgns.data.errors import DataError, DataWarning
from adaptgns.data.statistics import FILE_KEYS, MotionAccumulator
from adaptgns.data.trajectories import SPELLINGS
from adaptgns.periodic import minimum_image

if TYPE_CHECKING:
    from collections.abc import Iterator

    from adaptgns.data.metadata import Metadata
    from adaptgns.data.trajectories import Trajectories
    from adaptgns.data.trajectory import Trajectory

_BLOCK_VALUES = 1 << 18
"""Numbers looked at together, so that a trajectory of any length fits."""

_BLOCK_FRAMES = 8
"""Of these at least, since each time the two before are read again."""

_FAR = 3.0
"""Radii in one frame, from which on a particle seems to have jumped."""

_DROWNED = 10.0
"""Spacings of 32-bit numbers that the displacements' standard deviation should have at least."""

_SUSPICIOUS = 2.0
"""Stored and computed standard deviations further apart than this factor are told."""

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
        DataError: a trajectory is damaged, not finite, or all kinematic; or the split has other
            material properties than the metadata.

    Warns:
        DataWarning: what makes them suspicious.
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
    """All that `check_split` would tell: one problem per unusable trajectory, then one for each
    kind of thing that is suspicious. The particle types that occur are added to `types`."""
    path = trajectories.path
    try:
        if (found := trajectories.material_properties) != metadata.material_properties:
            raise DataError(
                f"{path}: particles have {found} material properties, where those of the training "
                f"data have {metadata.material_properties}"
            )
    except DataError as error:
        yield Problem(str(error), fatal=True)
        return
    train = path.stem in SPELLINGS["train"]
    outside, motion = _Outside(metadata), _Motion(metadata, train=train)
    for index, frames in enumerate(trajectories.lengths.tolist()):
        values = int(trajectories.particle_counts[index]) * trajectories.dim
        step = max(_BLOCK_VALUES // values, _BLOCK_FRAMES)
        try:
            for start in range(0, frames, step):
                # Two frames more, for the displacements and their differences.
                block = trajectories.window(index, start, min(start + step + 2, frames))
                if not metadata.mobile(block.particle_type).any():
                    kinematic = ", ".join(map(str, metadata.kinematic_types))
                    raise DataError(
                        f"{path}: trajectory {block.name}: all particles are kinematic (type "
                        f"{kinematic}), so that there is nothing to predict"
                    )
                outside.look_at(block.name, start, block.positions[:step], block.particle_type)
                motion.look_at(start, block)
                if types is not None and start == 0:
                    types.update(np.unique(block.particle_type).tolist())
        except DataError as error:
            yield Problem(str(error), fatal=True)
    suspicions = [*([str(outside)] if outside.count else []), *motion.suspicions()]
    for suspicion in suspicions:
        yield Problem(f"{path}: {suspicion}", fatal=False)
    if train and (force := path.with_name("force.py")).exists():
        yield Problem(
            f"{force}: LagrangeBench takes the force on a particle from here; it is not read, and "
            "one that depends on the place can be learned at the bounds alone",
            fatal=False,
        )


class _Motion:
    """Looks at how particles move that aren't kinematic."""

    def __init__(self, metadata: Metadata, *, train: bool) -> None:
        self._metadata = metadata
        self._statistics: MotionAccumulator | None = None
        if train:
            self._statistics = MotionAccumulator(
                metadata.dim, box=metadata.box, kinematic_types=metadata.kinematic_types
            )
        self._farthest = 0.0
        self._where = ""
        self._largest = np.zeros(metadata.dim, np.float32)
        self._moving: set[int] = set()
        self._types: set[int] = set()

    def look_at(self, start: int, block: Trajectory) -> None:
        """Takes in frames from `start` on, of which the first two may have been the last of those
        before."""
        mobile = self._metadata.mobile(block.particle_type)
        types, positions = block.particle_type[mobile], block.positions[:, mobile]
        self._types.update(np.unique(types).tolist())
        self._largest = np.maximum(self._largest, np.abs(positions).max(axis=(0, 1)))
        if len(positions) < 2:
            return
        displacement = minimum_image(np.diff(positions, axis=0), self._metadata.box)
        squared = np.square(displacement).sum(axis=-1)
        frame, particle = np.unravel_index(np.argmax(squared), squared.shape)
        if (length := float(np.sqrt(squared[frame, particle]))) > self._farthest:
            self._farthest = length
            number = int(np.flatnonzero(mobile)[particle])
            self._where = f"trajectory {block.name}: frame {start + frame + 1}: particle {number}"
        self._moving.update(np.unique(types[squared.any(axis=0)]).tolist())
        if self._statistics is not None and len(block.positions) > 2:
            self._statistics.add(block.positions, block.particle_type, continues=start > 0)

    def suspicions(self) -> Iterator[str]:
        """What is suspicious in all that was taken in."""
        metadata = self._metadata
        if self._farthest > _FAR * metadata.radius:
            yield (
                f"{self._where} is {self._farthest:.3g} from where it was a frame before, "
                f"{self._farthest / metadata.radius:.1f} radii; about one at most is usual. Is an "
                "axis periodic (periodic_boundary_conditions), or are frames too far apart?"
            )
        still = sorted(self._types - self._moving)
        if still and self._moving:
            kinematic = ", ".join(map(str, metadata.kinematic_types)) or "none"
            yield (
                f"particles of type {', '.join(map(str, still))} never move, but kinematic are "
                f"those of type {kinematic}; if they are obstacles, metadata.json should say so "
                "(kinematic_types)"
            )
        spacing, std = np.spacing(self._largest), np.array(metadata.velocity_std)
        axis = int(np.argmax(spacing / std))
        if std[axis] < _DROWNED * spacing[axis]:
            yield (
                f"positions reach {self._largest[axis]:.6g} along axis {axis}, where 32-bit "
                f"numbers are {spacing[axis]:.2g} apart; displacements per frame, of a standard "
                f"deviation of {std[axis]:.2g}, are little but rounding. Put the origin nearer"
            )
        yield from self._stale()

    def _stale(self) -> Iterator[str]:
        """Standard deviations that are not those of the train split."""
        try:
            found = None if self._statistics is None else self._statistics.finish()
        except DataError:
            return  # nothing to compare with
        for name, key in FILE_KEYS.items():
            if found is None or not name.endswith("_std"):
                continue
            stored, own = np.array(getattr(self._metadata, name)), np.array(getattr(found, name))
            # LagrangeBench writes 1 along an axis on which nothing moves.
            moving = (own > 0) & ~((own < 1e-7) & (stored == 1.0))
            apart = np.abs(np.log(stored[moving] / own[moving]))
            if (apart > np.log(_SUSPICIOUS)).any():
                unit = (
                    "length per frame²" if name.startswith("acceleration") else "length per frame"
                )
                yield (
                    f"{key} is {vector_text(stored)} in metadata.json, but {vector_text(own)} here "
                    f"(in {unit}); without the key it is computed anew"
                )


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


def vector_text(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    """Numbers of an axis each, short."""
    return " ".join(f"{value:.3g}" for value in values)
