"""Motion statistics against the plain formula in float64."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from adaptgns.data import DataError, Trajectory, open_split
from adaptgns.data import statistics as statistics_module
from adaptgns.data.statistics import compute_statistics
from adaptgns.data.store import write_split
from adaptgns.periodic import minimum_image


def walks(seed: int, box: float | None = None) -> list[Trajectory]:
    rng = np.random.default_rng(seed)
    trajectories = []
    for frames, particles in ((7, 3), (20, 5), (11, 1)):
        steps = rng.normal((0.3, -0.2), (0.01, 0.02), (frames, particles, 2)).cumsum(0)
        positions = np.mod(steps, box) if box else steps
        types = rng.choice([0, 1, 5], particles)
        types[0] = 0
        trajectories.append(Trajectory("", positions.astype(np.float32), types))
    return trajectories


@pytest.fixture(params=[1, 40, 1 << 22], ids=["frame by frame", "few frames", "whole"])
def block(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics_module, "_BLOCK_VALUES", request.param)


@pytest.mark.usefixtures("block")
@pytest.mark.parametrize("box", [None, 1.0])
@pytest.mark.parametrize("kinematic", [(), (1, 5)])
def test_equals_the_formula(tmp_path: Path, box: float | None, kinematic: tuple[int, ...]) -> None:
    trajectories = walks(0, box)
    write_split(tmp_path / "train.h5", trajectories)
    periods = None if box is None else np.array([box, box])
    result = compute_statistics(
        open_split(tmp_path, "train"), box=periods, kinematic_types=kinematic
    )
    velocities, accelerations = [], []
    for trajectory in trajectories:
        moving = ~np.isin(trajectory.particle_type, kinematic)
        velocity = np.diff(trajectory.positions[:, moving].astype(np.float64), axis=0)
        if box:
            velocity = (velocity + box / 2) % box - box / 2
        velocities.append(velocity.reshape(-1, 2))
        accelerations.append(np.diff(velocity, axis=0).reshape(-1, 2))
    velocity, acceleration = np.concatenate(velocities), np.concatenate(accelerations)
    np.testing.assert_allclose(result.velocity_mean, velocity.mean(0), rtol=1e-12)
    np.testing.assert_allclose(result.velocity_std, velocity.std(0), rtol=1e-12)
    np.testing.assert_allclose(result.acceleration_mean, acceleration.mean(0), atol=1e-15)
    np.testing.assert_allclose(result.acceleration_std, acceleration.std(0), rtol=1e-12)


def test_minimum_image_leaves_open_axes_alone() -> None:
    box = np.array([1.0, np.inf])
    np.testing.assert_allclose(minimum_image(np.array([[0.9, 0.9]]), box), [[-0.1, 0.9]])


def test_only_kinematic_particles(tmp_path: Path) -> None:
    write_split(tmp_path / "train.h5", walks(0))
    with pytest.raises(DataError, match=r"train\.h5: no motion.*kinematic types \[0, 1, 5\]"):
        compute_statistics(open_split(tmp_path, "train"), box=None, kinematic_types=(0, 1, 5))
