"""What an interaction graph looks like: size, density, degree and clustering (table 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from adaptgns.graph import radius_graph

_PATHS = 1 << 27
"""Paths of two edges that are looked at, at most: a second or two."""
_PATHS_AT_A_TIME = 1 << 22
"""Of these: about 50 MiB."""


@dataclass(frozen=True)
class GraphStatistics:
    """Statistics of one undirected graph without self-edges.

    Attributes:
        nodes: number of particles.
        edges: number of connected pairs, each counted once.
        density: edges over the `N (N - 1) / 2` there could be; 0 for fewer than two particles.
        degree: neighbours per particle, on average.
        clustering: mean over all particles of the share of its pairs of neighbours that are
            neighbours themselves, 0 for fewer than two neighbours (Watts and Strogatz 1998;
            networkx's `average_clustering`). Of a graph with more than 1.3e8 paths of two edges,
            the mean over some particles, drawn with a fixed seed.
    """

    nodes: int
    edges: int
    density: float
    degree: float
    clustering: float


def graph_statistics(
    positions: npt.NDArray[np.floating[Any]],
    radius: float,
    box: npt.NDArray[np.float64] | None = None,
) -> GraphStatistics:
    """The statistics of the graph of all pairs within `radius`.

    Args:
        positions: `[N, d]`.
        radius: in the unit of the positions.
        box: period lengths, `inf` on open axes; None when nothing is periodic.

    Raises:
        ValueError: as `radius_graph` does.
    """
    nodes = len(positions)
    (sender, _), offsets = radius_graph(positions, radius, box=box, return_offsets=True)
    edges = len(sender) // 2
    pairs = nodes * (nodes - 1) // 2
    return GraphStatistics(
        nodes=nodes,
        edges=edges,
        density=edges / pairs if pairs else 0.0,
        degree=len(sender) / nodes if nodes else 0.0,
        clustering=_average_clustering(offsets, sender),
    )


def _average_clustering(offsets: npt.NDArray[np.int64], sender: npt.NDArray[np.int64]) -> float:
    """From the neighbours of each particle i, ``sender[offsets[i] : offsets[i + 1]]``.

    The square of the adjacency matrix counts the paths of two edges; those that an edge closes are
    the pairs of neighbours that are neighbours.
    """
    nodes = len(offsets) - 1
    if not nodes:
        return 0.0
    degree = np.diff(offsets)
    paths = np.add.reduceat(np.append(degree[sender], 0), offsets[:-1]) * (degree > 0)
    looked_at = np.arange(nodes)
    if (total := int(paths.sum())) > _PATHS:
        count = max(1, nodes * _PATHS // total)
        looked_at = np.sort(np.random.default_rng(0).choice(nodes, count, replace=False))
    adjacent = csr_array((np.ones(len(sender), np.int32), sender, offsets), shape=(nodes, nodes))
    share = np.zeros(len(looked_at))
    blocks = np.cumsum(paths[looked_at]) // _PATHS_AT_A_TIME
    for block in np.unique(blocks):
        part = blocks == block
        own = adjacent[looked_at[part]]
        closed = (own @ adjacent).multiply(own).sum(axis=1)
        possible = degree[looked_at[part]] * (degree[looked_at[part]] - 1)
        share[part] = closed / np.maximum(possible, 1)
    return float(share.mean())
