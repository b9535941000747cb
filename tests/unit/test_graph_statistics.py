"""Graph statistics against networkx."""

from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptgns import graph_statistics as module
from adaptgns.graph_statistics import graph_statistics


def reference(positions: np.ndarray, radius: float, box: np.ndarray | None) -> nx.Graph:
    difference = positions[:, None].astype(np.float64) - positions[None]
    if box is not None:
        difference -= np.where(np.isfinite(box), box, 0) * np.round(difference / box)
    near = np.linalg.norm(difference, axis=2) <= radius
    graph = nx.Graph()
    graph.add_nodes_from(range(len(positions)))
    graph.add_edges_from(np.argwhere(np.triu(near, 1)).tolist())
    return graph


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    particles=st.integers(2, 60),
    dim=st.sampled_from([2, 3]),
    radius=st.floats(0.02, 0.45),
    periodic=st.booleans(),
    wedges=st.sampled_from([1, 50, 1 << 22]),
)
def test_equals_networkx(
    *, seed: int, particles: int, dim: int, radius: float, periodic: bool, wedges: int
) -> None:
    positions = np.random.default_rng(seed).random((particles, dim))
    box = np.array([1.0, np.inf, 1.0][:dim]) if periodic else None
    graph = reference(positions, radius, box)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_PATHS_AT_A_TIME", wedges)
        statistics = graph_statistics(positions, radius, box)
    assert statistics.nodes == particles
    assert statistics.edges == graph.number_of_edges()
    assert statistics.density == pytest.approx(nx.density(graph))
    assert statistics.degree == pytest.approx(2 * graph.number_of_edges() / particles)
    assert statistics.clustering == pytest.approx(nx.average_clustering(graph))


@pytest.mark.parametrize("particles", [0, 1])
def test_too_few_particles_for_an_edge(particles: int) -> None:
    statistics = graph_statistics(np.zeros((particles, 2), np.float32), 0.1)
    assert (statistics.nodes, statistics.edges) == (particles, 0)
    assert statistics.density == statistics.degree == statistics.clustering == 0


def test_of_a_dense_graph_some_particles_stand_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    axis = np.linspace(0, 1, 30)  # in the order of the lattice, of which every 30th is at a wall
    positions = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    graph = reference(positions, 0.1, None)
    paths = sum(degree**2 for _, degree in graph.degree)
    monkeypatch.setattr(module, "_PATHS", paths // 3)
    whole = nx.average_clustering(graph)
    assert graph_statistics(positions, 0.1).clustering == pytest.approx(whole, rel=0.02)
    assert graph_statistics(positions, 0.1).clustering != whole
