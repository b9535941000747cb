"""What an interaction graph looks like: size, density, degree and clustering (table 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from adaptgns._core import radius_graph

_WEDGES_AT_A_TIME = 1 << 22
"""Pairs of neighbours looked up together: about 100 MiB."""


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
            networkx's `average_clustering`).
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
    sender, receiver = radius_graph(positions, radius, box=box)
    edges = len(sender) // 2
    pairs = nodes * (nodes - 1) // 2
    return GraphStatistics(
        nodes=nodes,
        edges=edges,
        density=edges / pairs if pairs else 0.0,
        degree=len(sender) / nodes if nodes else 0.0,
        clustering=_average_clustering(sender, receiver, nodes),
    )


def _average_clustering(
    sender: npt.NDArray[np.int64], receiver: npt.NDArray[np.int64], nodes: int
) -> float:
    """Counts, for each edge (i, a) and each neighbour b of i, whether a and b are connected.

    The edges are sorted by receiver, then sender, so `receiver * N + sender` is sorted too, and
    an edge is looked up by bisection.
    """
    degree = np.bincount(receiver, minlength=nodes)
    keys = receiver * nodes + sender
    first = np.concatenate([[0], np.cumsum(degree)])
    wedges = degree[receiver]
    closed = np.zeros(nodes, dtype=np.int64)
    end = np.cumsum(wedges)
    start = 0
    while start < len(sender):
        done = end[start] - wedges[start]
        stop = max(int(np.searchsorted(end, done + _WEDGES_AT_A_TIME, side="right")), start + 1)
        count = wedges[start:stop]
        edge = np.repeat(np.arange(start, stop), count)
        # The k-th wedge of an edge leads to the k-th neighbour of its receiver.
        k = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
        other = sender[first[receiver[edge]] + k]
        wanted = sender[edge] * nodes + other
        found = keys[np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)] == wanted
        closed += np.bincount(receiver[edge[found]], minlength=nodes)
        start = stop
    possible = degree * (degree - 1)
    share = np.divide(closed, possible, out=np.zeros(nodes), where=possible > 0)
    return float(share.mean()) if nodes else 0.0
