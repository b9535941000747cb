"""Gathering node rows onto edges and summing edge rows at nodes, for sorted edge lists.

Both directions of each operation are segmented sums over contiguous rows, so that forward and
backward passes are deterministic and free of atomics. ``embedding_bag`` in sum mode is torch's
fastest such kernel on CPU and is there on CUDA, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import embedding_bag


class Parcel:
    """What goes to another process whole, as bytes.

    torch sends each tensor by a file handle of its own, which takes longer than to copy one of a
    batch: ten of them cost as much as making the batch.
    """

    def __getstate__(self) -> dict[str, Any]:
        return {
            name: part.numpy() if isinstance(part, Tensor) else part
            for name, part in vars(self).items()
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, part in state.items():
            vars(self)[name] = torch.from_numpy(part) if isinstance(part, np.ndarray) else part


@dataclass(frozen=True)
class Graph(Parcel):
    """An interaction graph: E directed edges among N particles, sorted by receiver, then sender.

    ``senders`` and ``receivers`` are int64 ``[E]``; the edges into particle i are the rows
    ``receiver_offsets[i]:receiver_offsets[i + 1]``. ``by_sender`` ``[E]`` lists the edges sorted
    by sender, and ``sender_offsets`` ``[N + 1]`` delimits each sender's part of that list; only
    a deterministic backward pass needs the two, and a graph for inference has None.
    """

    senders: Tensor
    receivers: Tensor
    receiver_offsets: Tensor
    by_sender: Tensor | None = None
    sender_offsets: Tensor | None = None

    @staticmethod
    def from_numpy(edges: NDArray[np.int64], offsets: NDArray[np.int64]) -> Graph:
        """:meth:`from_edges` for the arrays that ``adaptgns._core`` returns."""
        return Graph.from_edges(torch.from_numpy(edges), torch.from_numpy(offsets))

    @staticmethod
    def for_inference(edges: NDArray[np.int64], offsets: NDArray[np.int64]) -> Graph:
        """The graph of the arrays that ``adaptgns._core`` returns, without what only the backward
        pass needs."""
        senders, receivers = torch.from_numpy(edges)
        return Graph(senders, receivers, torch.from_numpy(offsets))

    @staticmethod
    def from_edges(edges: Tensor, offsets: Tensor) -> Graph:
        """The graph of ``edges`` (int64 ``[2, E]``) with the receivers' ``offsets`` ``[N + 1]``."""
        senders, receivers = edges
        by_sender = torch.argsort(senders, stable=True)
        counts = torch.bincount(senders, minlength=len(offsets) - 1)
        sender_offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        return Graph(senders, receivers, offsets, by_sender, sender_offsets)

    def to(self, device: torch.device, *, non_blocking: bool = False) -> Graph:
        """The same graph on another device."""
        return self._with(lambda part: part.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Graph:
        """The same graph in page-locked memory, for asynchronous copies to a GPU."""
        return self._with(lambda part: part.pin_memory())

    def send(self, device: torch.device) -> Graph:
        """The same graph on ``device``: on its way to a GPU while the caller goes on."""
        if device.type != "cuda":
            return self.to(device)
        return self.pin_memory().to(device, non_blocking=True)

    def _with(self, change: Callable[[Tensor], Tensor]) -> Graph:
        return Graph(*(change(part) for part in vars(self).values() if part is not None))


class _SegmentSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, receivers: Tensor, offsets: Tensor) -> Tensor:
        ctx.save_for_backward(receivers)
        rows = torch.arange(len(values), device=values.device)
        return embedding_bag(rows, values, offsets, mode="sum", include_last_offset=True)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (receivers,) = ctx.saved_tensors
        return gradient.index_select(0, receivers), None, None


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, nodes: Tensor, index: Tensor, order: Tensor, offsets: Tensor) -> Tensor:
        ctx.save_for_backward(order, offsets)
        return nodes.index_select(0, index)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        order, offsets = ctx.saved_tensors
        summed = embedding_bag(
            order, gradient.contiguous(), offsets, mode="sum", include_last_offset=True
        )
        return summed, None, None, None


def sum_at_receivers(edges: Tensor, graph: Graph) -> Tensor:
    """Sum of the incoming edges' rows: ``[E, F]`` to ``[N, F]``."""
    out: Tensor = _SegmentSum.apply(edges, graph.receivers, graph.receiver_offsets)
    return out


def at_senders(nodes: Tensor, graph: Graph) -> Tensor:
    """Every edge's sender row: ``[N, F]`` to ``[E, F]``."""
    if graph.by_sender is None:
        return nodes.index_select(0, graph.senders)
    out: Tensor = _Gather.apply(nodes, graph.senders, graph.by_sender, graph.sender_offsets)
    return out


def at_receivers(nodes: Tensor, graph: Graph) -> Tensor:
    """Every edge's receiver row: ``[N, F]`` to ``[E, F]``."""
    rows = torch.arange(len(graph.receivers), device=nodes.device)
    out: Tensor = _Gather.apply(nodes, graph.receivers, rows, graph.receiver_offsets)
    return out
