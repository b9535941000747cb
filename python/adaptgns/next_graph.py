"""The graph that a state of a rollout leads to, for pictures of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adaptgns._core import adaptive_graph, radius_graph
from adaptgns.metrics import Floats
from adaptgns.periodic import minimum_image
from adaptgns.rollout_file import RolloutFile

Pairs = NDArray[np.int64]


def unrecorded(file: RolloutFile) -> str | None:
    """What a picture of the graph does not show, in words."""
    if file.policy in ("fixed", "adaptive"):
        return None
    return (
        f"the edges drawn are those within r: what the policy {file.policy} chose is not recorded"
    )


def next_graph(
    file: RolloutFile,
    positions: Floats,
    sigma: NDArray[np.float32] | None,
    mobile: NDArray[np.bool_],
) -> tuple[Pairs, Pairs]:
    """``[2, E]`` edges within the base radius, and those beyond it, of the step that starts from
    ``positions`` ``[N, d]`` where the step before predicted ``sigma`` ``[N]``.

    There are none beyond it without a sigma, or under another policy than ``adaptive``: what the
    others choose is not in the file (:func:`unrecorded`). A model without edges has none at all.
    """
    radius, box = file.graph_radius, file.metadata.box
    none = np.empty((2, 0), dtype=np.int64)
    if not file.has_edges:
        return none, none
    if file.policy != "adaptive" or sigma is None:
        return radius_graph(positions, radius, box=box), none
    edges = adaptive_graph(
        positions, sigma, radius, file.tau, file.factor, box=box, eligible=mobile
    )
    across = minimum_image(positions[edges[0]] - positions[edges[1]], box)
    length = np.linalg.norm(across, axis=1)
    return edges[:, length <= radius], edges[:, length > radius]
