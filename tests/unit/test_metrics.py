"""Metrics against their definitions, brute force and scipy."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptgns.metrics import (
    calibration,
    clumping,
    edge_counts,
    kinetic_energy,
    kinetic_energy_error,
    one_step_mse,
    position_mse,
    spearman,
    transport_cost,
)
from adaptgns.periodic import minimum_image

ALL = np.ones(4, dtype=bool)


def test_position_mse_is_the_mean_over_particles_and_dimensions() -> None:
    true = np.zeros((2, 4, 3), dtype=np.float32)
    predicted = true.copy()
    predicted[1, 2] = [1.0, 2.0, 3.0]
    np.testing.assert_allclose(position_mse(predicted, true, ALL), [0, 14 / 12])


def test_kinematic_particles_count_nowhere() -> None:
    rng = np.random.default_rng(0)
    true, predicted = rng.random((2, 5, 4, 2))
    mobile = np.array([True, False, True, False])
    expected = position_mse(predicted[:, mobile], true[:, mobile], np.ones(2, dtype=bool))
    np.testing.assert_array_equal(position_mse(predicted, true, mobile), expected)
    errors = rng.random((3, 4))
    assert one_step_mse(errors, mobile, 2) == pytest.approx(errors[:, [0, 2]].mean() / 2)
    energy = kinetic_energy(true[:, mobile], np.ones(2, dtype=bool), 0.1)
    np.testing.assert_array_equal(kinetic_energy(true, mobile, 0.1), energy)


def test_minimum_image_wraps_periodic_axes_alone() -> None:
    difference = np.array([[0.9, 0.9], [-0.6, -0.6], [2.2, 0.4]])
    box = np.array([1.0, np.inf])
    expected = [[-0.1, 0.9], [0.4, -0.6], [0.2, 0.4]]
    np.testing.assert_allclose(minimum_image(difference, box), expected)
    np.testing.assert_array_equal(minimum_image(difference, None), difference)


def test_small_errors_are_not_lost_to_single_precision() -> None:
    # Squares of float32 values near 1e-23 underflow in float32.
    true = np.zeros((1, 4, 2), dtype=np.float32)
    assert position_mse(true + np.float32(1e-23), true, ALL)[0] == pytest.approx(1e-46)


def test_transport_matches_whichever_particle_is_nearest() -> None:
    true = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [5.0, 5.0]], np.float32)
    mobile = np.array([True, True, True, False])
    swapped = true[[1, 2, 0, 3]]
    assert transport_cost(swapped, true, mobile) == 0.0
    moved = swapped + np.array([[0.1, 0], [0, 0], [0, 0], [9, 9]], np.float32)
    assert transport_cost(moved, true, mobile) == pytest.approx(0.01 / 3, rel=1e-5)
    # A period of 1 along the first axis makes the first two the same place.
    near = true.copy()
    near[0, 0] = 0.95
    periodic = transport_cost(near, true, mobile, np.array([1.0, np.inf]))
    assert periodic == pytest.approx(0.0025 / 3, rel=1e-3)
    near[2] = np.nan
    assert np.isnan(transport_cost(near, true, mobile))


def test_kinetic_energy_of_free_fall() -> None:
    dt, gravity = 0.01, 9.81
    time = dt * np.arange(6)
    positions = np.zeros((6, 4, 2))
    positions[:, :, 1] = -(gravity / 2 * time**2)[:, None]
    middle = (time[1:] + time[:-1]) / 2
    np.testing.assert_allclose(kinetic_energy(positions, ALL, dt), (gravity * middle) ** 2 / 2)


def test_kinetic_energy_error_is_relative() -> None:
    true = np.array([1.0, 3.0])
    assert kinetic_energy_error(np.array([2.0, 1.0]), true) == pytest.approx(3 / 4)
    assert kinetic_energy_error(np.zeros(2), np.zeros(2)) == 0
    assert kinetic_energy_error(np.ones(2), np.zeros(2)) == np.inf


def test_edges_are_directed_and_without_those_between_kinematic_particles() -> None:
    frame = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [0.9, 0.9]])
    # Within 0.12 are the pairs 0-1 and 0-2.
    assert edge_counts(frame[None], 0.12, ALL).tolist() == [4]
    assert edge_counts(frame[None], 0.12, np.array([False, False, True, True])).tolist() == [2]
    diverged = np.stack([frame, np.full_like(frame, np.nan)])
    np.testing.assert_array_equal(edge_counts(diverged, 0.12, ALL), [4, np.nan])


def test_clumping_is_the_ratio_of_edges() -> None:
    ratio = clumping(np.array([4.0, 6.0, 0.0]), np.array([2.0, 0.0, 3.0]))
    np.testing.assert_array_equal(ratio, [2, np.nan, 0])


def test_calibration_by_hand() -> None:
    variance = np.array([4.0, 1.0, 3.0, 2.0, 5.0])
    error = np.array([8.0, 3.0, 5.0, 4.0, 11.0])
    result = calibration(variance, error, dim=2, bins=2)
    np.testing.assert_allclose(result.predicted, [4.0, 9.0])  # of 1, 2, 3 and 4, 5
    np.testing.assert_allclose(result.squared_error, [4.0, 9.5])
    np.testing.assert_allclose(result.gap, [0.0, 0.5])
    assert result.ece == pytest.approx(0.25)


def test_a_calibrated_variance_has_no_gap() -> None:
    rng = np.random.default_rng(0)
    variance = rng.uniform(0.1, 3.0, 200_000)
    error = variance * np.square(rng.normal(size=(2, 200_000))).sum(axis=0)
    assert calibration(variance, error, dim=2).ece < 0.02
    assert calibration(2 * variance, error, dim=2).ece == pytest.approx(3.1, rel=0.05)


def test_calibration_needs_a_value_a_bin() -> None:
    with pytest.raises(ValueError, match=r"variance: got shape \(9,\)"):
        calibration(np.ones(9), np.ones(9), dim=2)


@given(
    pairs=st.lists(
        st.tuples(st.integers(0, 5), st.floats(-10, 10, allow_nan=False)), min_size=3, max_size=60
    )
)
@settings(max_examples=100, deadline=None)
def test_spearman_equals_scipy(pairs: list[tuple[int, float]]) -> None:
    first, second = np.array(pairs, dtype=np.float64).T
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        assert np.isnan(spearman(first, second))
    else:
        expected = scipy.stats.spearmanr(first, second).statistic
        assert spearman(first, second) == pytest.approx(expected, abs=1e-12)


def test_spearman_of_nan_is_nan() -> None:
    assert np.isnan(spearman(np.array([1.0, np.nan, 2.0]), np.arange(3.0)))
