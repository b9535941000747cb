"""Degree against radius, and the advice drawn from it."""

from __future__ import annotations

import numpy as np
import pytest

from adaptgns.data.radius import DegreeCurve
from adaptgns.graph_statistics import graph_statistics


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("box", [None, 1.0])
def test_degrees_are_those_of_the_graphs(dim: int, box: float | None) -> None:
    rng = np.random.default_rng(dim)
    frames = [rng.random((count, dim), dtype=np.float32) for count in (200, 350)]
    periods = None if box is None else np.full(dim, box)
    curve = DegreeCurve(frames, 0.2, periods)
    for radius in (0.03, 0.11, 0.2):
        edges = sum(graph_statistics(positions, radius, periods).edges for positions in frames)
        assert curve.degree(radius) == pytest.approx(2 * edges / 550, rel=1e-3)


@pytest.mark.parametrize(("dim", "degree"), [(2, 6), (3, 18)])
def test_the_advised_radius_gives_the_degree_aimed_at(dim: int, degree: int) -> None:
    frames = [np.random.default_rng(0).random((500, dim), dtype=np.float32)]
    advised = DegreeCurve(frames, 1e-3, None).advice()
    assert advised is not None
    assert graph_statistics(frames[0], advised * 1.0001).degree == pytest.approx(degree, rel=0.01)


def test_no_advice_for_a_handful_of_particles() -> None:
    curve = DegreeCurve([np.random.default_rng(0).random((3, 3), dtype=np.float32)], 0.1, None)
    assert curve.advice() is None
    assert curve.degree(2.0) == pytest.approx(2.0)
