"""Measures of a rollout, as functions of arrays.

Notation: x̂_k and x_k are the predicted and the true positions after step k = 1 … K, N the number of
mobile (non-kinematic) particles, d the number of dimensions. Kinematic particles count nowhere.
Differences between predicted and true positions, and velocities, are taken to the nearest image
along periodic axes. Sums run in float64 whatever the dtype of the arrays; a NaN that comes in comes
out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from adaptgns._core import radius_graph
from adaptgns.periodic import minimum_image
from adaptgns.threads import thread_count

Floats = NDArray[np.float32] | NDArray[np.float64]


def position_mse(
    predicted: Floats,
    true: Floats,
    mobile: NDArray[np.bool_],
    box: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """``[K]`` position errors, MSE_k = Σ_i ‖x̂_ik − x_ik‖² / (N·d), length².

    ``predicted`` and ``true`` are ``[K, N, d]``, ``mobile`` is ``[N]``.
    """
    error = minimum_image(predicted[:, mobile] - true[:, mobile].astype(np.float64), box)
    mse: NDArray[np.float64] = np.square(error).mean(axis=(1, 2))
    return mse


def one_step_mse(squared_error: Floats, mobile: NDArray[np.bool_], dim: int) -> float:
    """Error of single steps from true positions, Σ ‖â − a‖² / (M·N·d), normalized units².

    ``squared_error`` ``[M, N]`` is summed over the ``dim`` dimensions.
    """
    return float(squared_error[:, mobile].mean(dtype=np.float64)) / dim


def transport_cost(
    predicted: Floats,
    true: Floats,
    mobile: NDArray[np.bool_],
    box: NDArray[np.float64] | None = None,
) -> float:
    """Squared earth mover's distance of two clouds, min over permutations π of
    Σ_i ‖x̂_i − x_π(i)‖² / N, length²: how far the clouds differ, whichever particle is where.

    ``predicted`` and ``true`` are ``[N, d]``. It is the optimum itself, which Sinkhorn's algorithm
    comes near to; time grows with N³, memory with N². NaN for positions that are not finite.
    """
    one, other = (positions[mobile].astype(np.float64) for positions in (predicted, true))
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return np.nan
    cost = np.square(minimum_image(one[:, None] - other[None], box)).sum(axis=2)
    return float(cost[linear_sum_assignment(cost)].mean())


def kinetic_energy(
    positions: Floats,
    mobile: NDArray[np.bool_],
    dt: float,
    box: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """``[K]`` kinetic energies per unit mass, E_k = Σ_i ‖(x_ik − x_ik−1) / dt‖² / (2·N).

    ``positions`` is ``[K + 1, N, d]``: the frame before the first counts as frame 0. Particles have
    equal masses. (length / time)², with ``dt`` the time between frames.
    """
    velocity = minimum_image(np.diff(positions[:, mobile].astype(np.float64), axis=0), box) / dt
    energy: NDArray[np.float64] = np.square(velocity).sum(axis=2).mean(axis=1) / 2
    return energy


def kinetic_energy_error(predicted: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Error of the kinetic energy over a rollout, Σ_k |Ê_k − E_k| / Σ_k E_k, of two ``[K]``.

    inf where nothing moves in truth, but does in the prediction; 0 where neither does.
    """
    gap, energy = float(np.abs(predicted - true).sum()), float(true.sum())
    if energy > 0:
        return gap / energy
    return gap if gap == 0 or np.isnan(gap) else np.inf


def edge_counts(
    positions: Floats,
    radius: float,
    mobile: NDArray[np.bool_],
    box: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """``[K]`` directed edges of the radius graphs of ``positions`` ``[K, N, d]``.

    Without self-edges, and without those between two kinematic particles. NaN for a frame with
    positions that are not finite.
    """
    return np.array([_edge_count(frame, radius, mobile, box) for frame in positions])


def _edge_count(
    frame: Floats, radius: float, mobile: NDArray[np.bool_], box: NDArray[np.float64] | None
) -> float:
    if not np.isfinite(frame).all():
        return np.nan
    senders, receivers = radius_graph(frame, radius, box=box, threads=thread_count())
    return int(np.count_nonzero(mobile[senders] | mobile[receivers]))


def clumping(
    predicted_edges: NDArray[np.float64], true_edges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """``[K]`` ratios of :func:`edge_counts` on predicted over those on true positions.

    Both counts are of one radius, whatever graph the model was given: the ratio tells how much
    denser than in truth the predicted cloud is. NaN where the true graph has no edge.
    """
    ratio = np.full(len(true_edges), np.nan)
    np.divide(predicted_edges, true_edges, out=ratio, where=true_edges > 0)
    return ratio


@dataclass(frozen=True)
class Calibration:
    """Predicted against measured squared errors by bins of the predicted variance, normalized
    units²; bin 0 holds the smallest variances."""

    squared_error: NDArray[np.float64]
    """``[bins]`` mean over the bin of ‖â − a‖², summed over dimensions"""
    predicted: NDArray[np.float64]
    """``[bins]`` mean over the bin of d·σ², what the squared error should be"""

    @property
    def gap(self) -> NDArray[np.float64]:
        """``[bins]`` |Δ|, the distance between the two."""
        return np.abs(self.squared_error - self.predicted)

    @property
    def ece(self) -> float:
        """Expected calibration error, the mean of |Δ| over the bins."""
        return float(self.gap.mean())


def calibration(variance: Floats, squared_error: Floats, dim: int, bins: int = 10) -> Calibration:
    """Calibration of ``variance`` ``[n]`` (σ² per dimension) against ``squared_error`` ``[n]``
    (summed over the ``dim`` dimensions), in ``bins`` of equal count.

    Where n isn't a multiple of ``bins``, the first bins hold one more; equal variances keep their
    order. With fewer than ``bins`` values ValueError is raised.
    """
    _check_pairs("variance", variance, squared_error, at_least=bins)
    parts = np.array_split(np.argsort(variance, kind="stable"), bins)
    return Calibration(
        squared_error=np.array([squared_error[part].mean(dtype=np.float64) for part in parts]),
        predicted=np.array([dim * variance[part].mean(dtype=np.float64) for part in parts]),
    )


def spearman(first: Floats, second: Floats) -> float:
    """Spearman's rank correlation of two ``[n]``: Pearson's correlation of their ranks, where
    equal values share the mean of their ranks.

    NaN where one of the two is constant or holds a NaN.
    """
    _check_pairs("first", first, second, at_least=2)
    if np.isnan(first).any() or np.isnan(second).any():
        return np.nan
    ranks = [_average_ranks(values) for values in (first, second)]
    centred = [rank - rank.mean() for rank in ranks]
    scale = np.sqrt(np.square(centred[0]).sum() * np.square(centred[1]).sum())
    return float(centred[0] @ centred[1] / scale) if scale > 0 else np.nan


def _average_ranks(values: Floats) -> NDArray[np.float64]:
    """``[n]`` ranks counted from 1, equal values sharing their mean."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    # c equal values that end at rank e have the ranks e - c + 1 … e: on average e - (c - 1) / 2.
    average = counts.cumsum() - (counts - 1) / 2
    ranks: NDArray[np.float64] = average[inverse]
    return ranks


def _check_pairs(name: str, first: Floats, second: Floats, *, at_least: int) -> None:
    if first.ndim != 1 or first.shape != second.shape or len(first) < at_least:
        raise ValueError(
            f"{name}: got shape {first.shape} beside {second.shape}; expected two arrays of one "
            f"length, {at_least} or more"
        )
