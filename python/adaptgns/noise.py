"""Training noise: a random walk on the input velocities (Sanchez-Gonzalez et al. 2020, A.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def random_walk_noise(
    rng: np.random.Generator, frames: int, particles: int, dim: int, std: float
) -> NDArray[np.float32]:
    """Position noise ``[frames, particles, dim]`` whose velocity noise is a random walk.

    The walk over the ``frames - 1`` velocities has independent steps of std
    ``std / sqrt(frames - 1)``, so that the last velocity's noise has std ``std`` (length per
    frame). The first position carries none.
    """
    steps = rng.standard_normal((frames - 1, particles, dim), dtype=np.float32)
    velocity_noise = np.cumsum(steps * np.float32(std / np.sqrt(frames - 1)), axis=0)
    noise = np.zeros((frames, particles, dim), dtype=np.float32)
    np.cumsum(velocity_noise, axis=0, out=noise[1:])
    return noise
