"""The baselines' flights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from adaptgns.baselines import GRAVITY, constant_gravity, constant_velocity
from adaptgns.data.metadata import read_metadata
from adaptgns.data.trajectories import open_split
from adaptgns.data.trajectory import INPUT_FRAMES
from adaptgns.metrics import position_mse

BOUNDS = ((0.0, 1.0), (0.0, 1.0))


def moving(position: list[float], velocity: list[float]) -> np.ndarray:
    """Two frames of one particle that ends at ``position``."""
    last = np.array([position])
    return np.stack([last - velocity, last])


def test_velocity_is_held_until_a_wall() -> None:
    path = constant_velocity(moving([0.5, 0.5], [0.2, -0.1]), 7, BOUNDS)
    np.testing.assert_allclose(path[:, 0, 0], [0.7, 0.9, 1, 1, 1, 1, 1])
    np.testing.assert_allclose(path[:, 0, 1], [0.4, 0.3, 0.2, 0.1, 0, 0, 0], atol=1e-12)


def test_fall_is_that_of_the_formula() -> None:
    path = constant_gravity(moving([0.5, 0.9], [0.01, 0.02]), 6, BOUNDS, 0.003)
    step = np.arange(1, 7)
    np.testing.assert_allclose(path[:, 0, 1], 0.9 + 0.02 * step - 0.003 * step * (step + 1) / 2)
    np.testing.assert_allclose(path[:, 0, 0], 0.5 + 0.01 * step)


def test_what_hits_the_ceiling_falls_off_at_once() -> None:
    path = constant_gravity(moving([0.5, 0.95], [0.0, 0.2]), 3, BOUNDS, 0.01)
    np.testing.assert_allclose(path[:, 0, 1], [1.0, 0.99, 0.97])


def test_periodic_axes_have_no_walls() -> None:
    box = np.array([1.0, np.inf])
    # From 0.95 across the boundary to 0.05: a velocity of 0.1, not of -0.9.
    initial = np.array([[[0.95, 0.5]], [[0.05, 0.5]]])
    path = constant_velocity(initial, 12, BOUNDS, box=box)
    np.testing.assert_allclose(path[:, 0, 0], 0.05 + 0.1 * np.arange(1, 13))


def test_one_frame_has_no_velocity() -> None:
    with pytest.raises(ValueError, match="initial: got 1 frames"):
        constant_velocity(np.zeros((1, 3, 2)), 5, BOUNDS)


def test_errors_on_taichi_water(shared: Path) -> None:
    folder = shared / "data" / "taichi_water"
    metadata = read_metadata(folder)
    gravity = GRAVITY * metadata.dt**2
    errors = []
    for trajectory in open_split(folder, "test"):
        initial = trajectory.positions[:INPUT_FRAMES]
        true = trajectory.positions[INPUT_FRAMES : INPUT_FRAMES + 100]
        mobile = np.ones(len(trajectory.particle_type), dtype=bool)
        flights = (
            constant_velocity(initial, 100, metadata.bounds),
            constant_gravity(initial, 100, metadata.bounds, gravity),
        )
        errors.append([position_mse(flight, true, mobile)[[49, 99]] for flight in flights])
    velocity, fall = np.mean(errors, axis=0)
    # Recorded elsewhere with walls treated slightly differently.
    np.testing.assert_allclose(velocity, [2.9e-3, 3.5e-2], rtol=0.05)
    np.testing.assert_allclose(fall, [1.5e-4, 5.3e-3], rtol=0.05)
