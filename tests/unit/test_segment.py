"""Gather and segment sum against torch's own index operations, forward and backward."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptgns._core import radius_graph
from adaptgns.segment import Graph, at_receivers, at_senders, sum_at_receivers


def random_graph(rng: np.random.Generator, nodes: int, edges: int) -> Graph:
    """Any directed multigraph sorted by receiver, then sender; nodes without edges included."""
    pairs = rng.integers(0, nodes, (edges, 2))
    pairs = pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]
    offsets = np.searchsorted(pairs[:, 1], np.arange(nodes + 1))
    return Graph.from_numpy(np.ascontiguousarray(pairs.T), offsets)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32), nodes=st.integers(1, 20), edges=st.integers(0, 60))
def test_forward_and_gradient_equal_index_operations(seed: int, nodes: int, edges: int) -> None:
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, nodes, edges)
    x = torch.from_numpy(rng.standard_normal((nodes, 3))).requires_grad_()
    y = x.detach().clone().requires_grad_()

    per_edge = at_senders(x, graph) * at_receivers(x, graph).sin()
    ours = sum_at_receivers(per_edge, graph)
    per_edge = y[graph.senders] * y[graph.receivers].sin()
    theirs = torch.zeros_like(y).index_add(0, graph.receivers, per_edge)

    torch.testing.assert_close(ours, theirs)
    weights = torch.from_numpy(rng.standard_normal((nodes, 3)))
    (ours * weights).sum().backward()
    (theirs * weights).sum().backward()
    torch.testing.assert_close(x.grad, y.grad)


def test_a_graph_for_inference_gathers_and_sums_alike() -> None:
    rng = np.random.default_rng(0)
    edges, offsets = radius_graph(rng.random((50, 2)), 0.2, self_edges=True, return_offsets=True)
    x = torch.from_numpy(rng.standard_normal((50, 3)))
    results = []
    for graph in (Graph.from_numpy(edges, offsets), Graph.for_inference(edges, offsets)):
        per_edge = at_senders(x, graph) * at_receivers(x, graph).sin()
        results.append(sum_at_receivers(per_edge, graph))
        assert len(per_edge) == edges.shape[1]
    assert torch.equal(*results)


def test_a_graph_goes_to_a_gpu_by_way_of_page_locked_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is done can be seen without a GPU; that it can be done, on one alone."""
    done = []

    def pin(graph: Graph) -> Graph:
        done.append("pinned")
        return graph

    def to(graph: Graph, device: torch.device, *, non_blocking: bool = False) -> Graph:
        done.append(f"{device} {non_blocking}")
        return graph

    graph = random_graph(np.random.default_rng(0), 5, 20)
    assert graph.send(torch.device("meta")).senders.device.type == "meta"
    monkeypatch.setattr(Graph, "pin_memory", pin)
    monkeypatch.setattr(Graph, "to", to)
    graph.send(torch.device("cuda"))
    assert done == ["pinned", "cuda True"]
