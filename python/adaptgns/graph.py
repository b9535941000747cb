"""Interaction graphs, built in Rust.

The conventions, wherever a graph is built or used:

- an edge is a pair (sender, receiver): row 0 of ``edge_index`` holds the senders, row 1
  the receivers;
- edges are sorted by receiver, then by sender, whatever the number of threads, and
  particle ``i`` receives the edges ``offsets[i]:offsets[i + 1]``;
- a pair is near if its distance is at most the radius (``<=``), on periodic axes the
  distance to the nearest image; both directions of a pair are present, except in
  ``knn_graph``;
- self-edges are there only if asked for.
"""

from adaptgns._core import adaptive_graph, knn_graph, radius_graph

__all__ = ["adaptive_graph", "knn_graph", "radius_graph"]
