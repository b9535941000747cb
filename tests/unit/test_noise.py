"""The random walk has the distribution it claims."""

from __future__ import annotations

import numpy as np

from adaptgns.noise import random_walk_noise


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
