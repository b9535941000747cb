"""Predictions that know no physics beyond the first frames, to measure a model against."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptgns.metrics import Floats
from adaptgns.periodic import minimum_image

GRAVITY = 9.81
"""Length units per second²"""


def constant_velocity(
    initial: Floats, steps: int, bounds: ArrayLike, *, box: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """``[steps, N, d]`` positions if every particle kept its last velocity: x_k = x_k−1 + v.

    ``initial`` ``[H, N, d]`` are the frames before, of which the last two are used; v their
    difference, in length per frame. Positions are clipped to ``bounds`` ``[d, 2]`` along open axes;
    ``box`` ``[d]`` tells the periods of the others, where positions are not wrapped back.
    """
    return _flight(initial, steps, bounds, np.zeros(initial.shape[2]), box)


def constant_gravity(
    initial: Floats,
    steps: int,
    bounds: ArrayLike,
    gravity_per_frame2: float,
    *,
    box: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """``[steps, N, d]`` positions in free flight: v_k = v_k−1 − g, x_k = x_k−1 + v_k.

    As :func:`constant_velocity`, with g = ``gravity_per_frame2`` (length per frame², that is
    :data:`GRAVITY` · dt²) along the second axis. A wall that clips a particle takes the velocity
    towards it, so that what hits the ceiling falls off again.
    """
    acceleration = np.zeros(initial.shape[2])
    acceleration[1] = -gravity_per_frame2
    return _flight(initial, steps, bounds, acceleration, box)


def _flight(
    initial: Floats,
    steps: int,
    bounds: ArrayLike,
    acceleration: NDArray[np.float64],
    box: NDArray[np.float64] | None,
) -> NDArray[np.float64]:
    if len(initial) < 2:
        raise ValueError(f"initial: got {len(initial)} frames; a velocity takes 2 or more")
    lower, upper = np.array(bounds, dtype=np.float64).T
    if box is not None:
        periodic = np.isfinite(box) & (box > 0)
        lower, upper = np.where(periodic, -np.inf, lower), np.where(periodic, np.inf, upper)
    position = initial[-1].astype(np.float64)
    velocity = minimum_image(position - initial[-2], box)
    positions = np.empty((steps, *position.shape))
    for step in range(steps):
        velocity = velocity + acceleration
        free = position + velocity
        position = np.clip(free, lower, upper)
        velocity = np.where(position == free, velocity, 0.0)
        positions[step] = position
    return positions
