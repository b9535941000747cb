"""One trajectory, what a file format must offer to be read, and checks that formats share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from adaptgns.data.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

INPUT_FRAMES = 6
"""Positions a model looks at: they make the five last velocities."""

MIN_FRAMES = INPUT_FRAMES + 1
"""The shortest usable trajectory: the input and one target."""

PARTICLE_TYPES = 9
"""Types 0 to 8, the number of rows of the models' type embedding."""


@dataclass(frozen=True)
class Trajectory:
    """One simulation, or some consecutive frames of one.

    Attributes:
        name: the trajectory's name in its file.
        positions: float32 `[T, N, d]`, in the data's length unit.
        particle_type: int64 `[N]`, 0 to 8.
        material_property: float32 `[N, P]`, or None where the data has none.
        step_context: float32 `[T, C]`, quantities of the whole frame in some DeepMind sets; the
            store keeps them, but its readers leave them out, since no model here takes them.
    """

    name: str
    positions: npt.NDArray[np.float32]
    particle_type: npt.NDArray[np.int64]
    material_property: npt.NDArray[np.float32] | None = None
    step_context: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Shape:
    """What is known of a trajectory before its positions are read."""

    name: str
    frames: int
    particles: int
    dim: int


class Source(Protocol):
    """One file of trajectories in some format. Picklable, and usable after a fork."""

    path: Path
    shapes: tuple[Shape, ...]

    def read(self, index: int, start: int, stop: int) -> Trajectory:
        """Frames `start` to `stop - 1`, in arrays that the caller owns."""

    def material_properties(self) -> int:
        """Columns of `material_property`; 0 where there are none."""


def check_shape(shape: Shape, where: str) -> None:
    """Raises `DataError` for a trajectory that no model could use."""
    if shape.frames < MIN_FRAMES:
        raise DataError(
            f"{where}: {shape.frames} frames; at least {MIN_FRAMES} are needed "
            f"({INPUT_FRAMES} as input and 1 as target)"
        )
    if shape.particles < 1:
        raise DataError(f"{where}: no particles")
    if shape.dim not in {2, 3}:
        raise DataError(f"{where}: positions have {shape.dim} dimensions; 2 or 3 are accepted")


def check_finite(trajectory: Trajectory, first_frame: int, where: str) -> None:
    """Raises `DataError` for NaN and infinity, naming the first frame and particle."""
    finite = np.isfinite(trajectory.positions)
    if not finite.all():
        frame, particle = np.argwhere(~finite)[0, :2]
        raise DataError(
            f"{where}: frame {first_frame + frame}: particle {particle} is at "
            f"{trajectory.positions[frame, particle].tolist()}; positions must be finite"
        )
    material = trajectory.material_property
    if material is not None and not np.isfinite(material).all():
        particle = np.argwhere(~np.isfinite(material))[0, 0]
        raise DataError(
            f"{where}: material_property of particle {particle} is "
            f"{material[particle].tolist()}; it must be finite"
        )


def particle_types(raw: Any, particles: int, where: str) -> npt.NDArray[np.int64]:
    """Types as int64 `[particles]`, from an array of that length or from one number for all."""
    types = np.asarray(raw)
    if types.dtype.kind not in "iu":
        raise DataError(f"{where}: particle_type is of dtype {types.dtype}; integers are accepted")
    if types.ndim == 0:
        types = np.full(particles, types)
    if types.shape != (particles,):
        raise DataError(
            f"{where}: particle_type has shape {list(types.shape)}, positions have {particles} "
            "particles"
        )
    return types.astype(np.int64)


def check_type_range(types: npt.NDArray[np.int64], where: str) -> None:
    """Raises `DataError` where a type isn't one that the models know."""
    wrong = np.unique(types[(types < 0) | (types >= PARTICLE_TYPES)])
    if wrong.size:
        raise DataError(
            f"{where}: particle types {wrong[:5].tolist()}; 0 to {PARTICLE_TYPES - 1} are accepted"
        )


def material_properties(raw: Any, particles: int, where: str) -> npt.NDArray[np.float32]:
    """Properties as float32 `[particles, P]`, from one or several numbers per particle."""
    material = np.asarray(raw)
    if material.dtype.kind not in "fiu":
        raise DataError(f"{where}: material_property is of dtype {material.dtype}, not a number")
    if material.ndim == 0:
        material = np.full(particles, material)
    if material.ndim == 1:
        material = material[:, None]
    if material.ndim != 2 or len(material) != particles:
        raise DataError(
            f"{where}: material_property has shape {list(material.shape)}; [{particles}] or "
            f"[{particles}, P] are accepted"
        )
    return material.astype(np.float32)
