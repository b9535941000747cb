"""Training noise: what the errors of a rollout look like, and what they are answered with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def random_walk_noise(
    rng: np.random.Generator, frames: int, particles: int, dim: int, std: float
) -> NDArray[np.float32]:
    """Position noise ``[frames, particles, dim]`` whose velocity noise is a random walk
    (Sanchez-Gonzalez et al. 2020, A.2).

    The walk over the ``frames - 1`` velocities has independent steps of std
    ``std / sqrt(frames - 1)``, so that the last velocity's noise has std ``std`` (length per
    frame). The first position carries none.
    """
    steps = rng.standard_normal((frames - 1, particles, dim), dtype=np.float32)
    velocity_noise = np.cumsum(steps * np.float32(std / np.sqrt(frames - 1)), axis=0)
    noise = np.zeros((frames, particles, dim), dtype=np.float32)
    np.cumsum(velocity_noise, axis=0, out=noise[1:])
    return noise


def drift_noise(rng: np.random.Generator, frames: int, dim: int, std: float) -> NDArray[np.float32]:
    """Position noise ``[frames, dim]`` that all particles of a sample share, in their past alone.

    The accelerations before the last velocity are off by a common vector plus half as much anew
    at each frame, their scale ``std`` (length per frame squared) times a half-normal number; the
    last two positions, and so the last velocity, carry none. Neighbours cannot tell such noise
    from the truth. Without it a model learns to repeat the last acceleration, and in a rollout
    keeps up its own errors: a drop that falls freely slows down in mid-air.
    """
    scale = std * abs(rng.normal())
    common = rng.normal(size=dim)
    acceleration = scale * (common + 0.5 * rng.normal(size=(frames - 2, dim)))
    past = np.cumsum(np.cumsum(acceleration, axis=0), axis=0)  # the newest first
    return np.concatenate([past[::-1], np.zeros((2, dim))]).astype(np.float32)


WAVES = 3
"""Standing waves that a compression is made of."""
STRONGEST = 0.1
"""Share of a compression that the answering acceleration takes back per frame squared, at most."""


def compression(
    rng: np.random.Generator,
    positions: NDArray[np.float32],
    bounds: NDArray[np.float64],
    periodic: tuple[bool, ...],
    *,
    strain: float,
    radius: float,
    frames: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A smooth compression of ``positions`` ``[N, d]``, and how the next ``frames`` answer it.

    Random-walk noise is new for every particle, and says nothing of errors that neighbours share:
    a model that brakes a falling block too late piles it up, all of it, and solver data hold no
    piles to learn from. The compression is the gradient of a few standing waves, of 4 ``radius``
    to twice the extent of ``bounds`` ``[d, 2]`` in length, that move nothing across a wall; along
    periodic axes they begin anywhere. They are answered with the acceleration of a fluid in which
    sound crosses half a ``radius`` per frame, bounded where the waves are short.

    Args:
        strain: scale of the relative change of density, drawn anew (half-normal) at each call.

    Returns:
        The displacement ``[N, d]``, and by how much each following frame differs from it,
        ``[frames, N, d]``, the first of which is the acceleration; lengths.
    """
    low, extent = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
    phase = np.pi * (positions - low) / extent  # [N, d]
    amplitude = strain * abs(rng.normal()) / np.sqrt(WAVES)
    displacement = np.zeros(positions.shape)
    answers = np.zeros((frames, *positions.shape))
    for _ in range(WAVES):
        # Half waves along each axis, log-uniform; whole ones where the axis is periodic.
        most = np.maximum(extent / (2 * radius), 1)
        halves = np.floor(most ** rng.random(len(extent))) * (rng.random(len(extent)) < 0.8)
        halves = np.where(periodic, 2 * np.ceil(halves / 2), halves)
        shift = np.zeros(len(extent))
        shift[np.array(periodic)] = rng.uniform(0, 2 * np.pi, sum(periodic))
        sign = rng.choice([-1, 1])
        wave = np.pi * halves / extent
        square = (wave**2).sum()
        if square == 0:
            continue
        cosines = np.cos(phase * halves + shift)
        gradient = np.empty(positions.shape)
        for axis in range(len(extent)):
            others = np.delete(cosines, axis, axis=1).prod(axis=1)
            gradient[:, axis] = (
                -wave[axis] * np.sin(phase[:, axis] * halves[axis] + shift[axis]) * others
            )
        part = sign * amplitude / square * gradient
        displacement += part
        stiffness = (radius / 2) ** 2 * square
        share, speed = 0.0, 0.0  # that is taken back of the wave
        for answer in answers:
            speed += (1 - share) * stiffness / (1 + stiffness / STRONGEST)
            share += speed
            answer -= share * part  # noqa: PLW2901 (in place)
    return displacement.astype(np.float32), answers.astype(np.float32)
