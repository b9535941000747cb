"""The random walk has the distribution it claims."""

from __future__ import annotations

import numpy as np

from adaptgns.noise import compression, drift_noise, random_walk_noise


def test_velocity_noise_is_a_random_walk_that_ends_at_std() -> None:
    noise = random_walk_noise(np.random.default_rng(0), 6, 40_000, 2, 3e-4)
    assert noise.shape == (6, 40_000, 2)
    assert noise.dtype == np.float32
    assert (noise[0] == 0).all()
    velocity = np.diff(noise.astype(np.float64), axis=0)
    expected = 3e-4 * np.sqrt(np.arange(1, 6) / 5)
    np.testing.assert_allclose(velocity.std((1, 2)), expected, rtol=0.02)
    increments = np.diff(velocity, axis=0).reshape(4, -1)
    np.testing.assert_allclose(np.corrcoef(increments), np.eye(4), atol=0.02)


def test_drift_is_in_the_past_alone_and_mostly_common() -> None:
    rng = np.random.default_rng(0)
    noise = np.stack([drift_noise(rng, 6, 2, 3e-5) for _ in range(20_000)]).astype(np.float64)
    assert noise.shape == (20_000, 6, 2)
    assert (noise[:, -2:] == 0).all()
    acceleration = np.diff(noise, n=2, axis=1)  # [samples, 4, 2]
    # E|N|^2 = 1, and the variance of common plus half as much anew is 1.25.
    np.testing.assert_allclose(acceleration.std((0, 2)), 3e-5 * np.sqrt(1.25), rtol=0.03)
    between = (acceleration[:, 0] * acceleration[:, 3]).mean() / acceleration[:, 0].var()
    assert abs(between - 1 / 1.25) < 0.03


def lattice(spacing: float) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    axis = np.arange(0.1, 0.9 + 1e-6, spacing)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2).astype("f4")


def compress(seed: int, *, periodic: tuple[bool, bool] = (False, False)) -> tuple[np.ndarray, ...]:  # type: ignore[type-arg]
    bounds = np.array([[0.1, 0.9], [0.1, 0.9]])
    return compression(
        np.random.default_rng(seed), lattice(0.004), bounds, periodic, strain=0.2, radius=0.015
    )


def test_compression_stays_inside_walls_and_is_answered() -> None:
    positions = lattice(0.004)
    strains = []
    for seed in range(40):
        displacement, acceleration = compress(seed)
        for axis in range(2):
            at_wall = np.isclose(positions[:, axis], 0.1) | np.isclose(positions[:, axis], 0.9)
            assert np.abs(displacement[at_wall, axis]).max() < 1e-6
        # The answer pushes back, and never by more than a tenth in a frame.
        assert (displacement * acceleration).sum() < 0
        assert np.linalg.norm(acceleration) <= 0.1 * np.linalg.norm(displacement) * 1.001
        field = displacement.reshape(201, 201, 2).astype(np.float64)
        divergence = np.gradient(field[..., 0], 0.004, axis=0) + np.gradient(
            field[..., 1], 0.004, axis=1
        )
        strains.append(np.abs(divergence).max())
    assert 0.05 < np.median(strains) < 0.5


def test_compression_is_the_same_at_both_ends_of_a_period() -> None:
    positions = lattice(0.004)
    low, high = np.isclose(positions[:, 0], 0.1), np.isclose(positions[:, 0], 0.9)
    for seed in range(10):
        displacement, _ = compress(seed, periodic=(True, False))
        np.testing.assert_allclose(displacement[low], displacement[high], atol=1e-6)


def test_compression_along_a_period_begins_anywhere() -> None:
    """No place of a periodic box stands still in all of them, as a wall would."""
    displacements = [compress(seed, periodic=(True, True))[0] for seed in range(40)]
    assert np.abs(displacements).max(axis=(0, 2)).min() > 1e-4
