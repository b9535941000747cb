"""The whole network in the Rust core, for the CPU.

The same sums as :mod:`adaptgns.network` does with torch, in another order: a block of rows goes
through all layers of a perceptron while it lies in the cache, and less is kept for the way back.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from adaptgns._core import network_backward, network_forward
from adaptgns.segment import Graph
from adaptgns.threads import thread_count


def applies(features: Tensor) -> bool:
    """Whether :func:`network` can do what torch would with ``features``."""
    return (
        features.device.type == "cpu"
        and features.dtype == torch.float32
        and not torch.is_autocast_enabled("cpu")
        and not torch.compiler.is_compiling()
    )


def network(
    perceptrons: Sequence[nn.Module],
    node_features: Tensor,
    edge_features: Tensor | None,
    graph: Graph | None,
    *,
    heads: int,
    alone: bool = False,
    bf16: bool = False,
) -> list[Tensor]:
    """Outputs ``[N, :]`` of the last ``heads`` of the ``perceptrons``: node encoder, edge encoder,
    each step's edge and node perceptron, heads; without ``graph`` no edge perceptrons. With
    ``alone`` the heads behind the first send no gradients to the rest of the network; with ``bf16``
    the factors of products are rounded so, but for those of the heads, and where no gradients are
    taken the edges' latents."""
    parameters = [list(perceptron.parameters()) for perceptron in perceptrons]
    sizes = [len(own) for own in parameters]
    flat = [parameter for own in parameters for parameter in own]
    index: list[Tensor] = []
    if graph is not None and edge_features is not None:
        index = [graph.senders, graph.receivers, graph.receiver_offsets]
        if graph.by_sender is not None and graph.sender_offsets is not None:
            index += [graph.by_sender, graph.sender_offsets]
    inputs = [node_features, edge_features, *index, *flat]
    # Not what `forward` can see, where no gradients are taken and parameters ask for them anyway.
    keep = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in inputs)
    out: tuple[Tensor, ...] = _Network.apply(len(index), sizes, heads, alone, bf16, keep, *inputs)
    return list(out)


def _array(tensor: Tensor) -> Any:
    return tensor.detach().contiguous().numpy()


def _edges(index: Sequence[Tensor], features: Tensor | None) -> Any:
    return None if features is None else (_array(features), [_array(part) for part in index])


def _perceptrons(sizes: list[int], parameters: Sequence[Tensor]) -> Any:
    arrays = iter(_array(parameter) for parameter in parameters)
    return [[next(arrays) for _ in range(size)] for size in sizes]


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        indices: int,
        sizes: list[int],
        heads: int,
        alone: bool,
        bf16: bool,
        keep: bool,
        node_features: Tensor,
        edge_features: Tensor | None,
        *rest: Tensor,
    ) -> tuple[Tensor, ...]:
        index, parameters = rest[:indices], rest[indices:]
        outputs, tape = network_forward(
            _perceptrons(sizes, parameters),
            _array(node_features),
            _edges(index, edge_features),
            heads=heads,
            keep=keep,
            bf16=bf16,
            threads=thread_count(),
        )
        ctx.indices, ctx.sizes, ctx.tape = indices, sizes, tape
        ctx.alone, ctx.bf16 = alone, bf16
        ctx.save_for_backward(node_features, edge_features, *rest)
        return tuple(torch.from_numpy(output) for output in outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        node_features, edge_features, *rest = ctx.saved_tensors
        index, parameters = rest[: ctx.indices], rest[ctx.indices :]
        of_parameters, of_nodes, of_edges = network_backward(
            _perceptrons(ctx.sizes, parameters),
            _array(node_features),
            _edges(index, edge_features),
            ctx.tape,
            [_array(gradient) for gradient in gradients],
            alone=ctx.alone,
            bf16=ctx.bf16,
            threads=thread_count(),
        )
        parts = torch.split(torch.from_numpy(of_parameters), [p.numel() for p in parameters])
        to_edges = None
        if edge_features is not None:
            to_edges = torch.from_numpy(of_edges).view_as(edge_features)
        return (
            *(None,) * 6,
            torch.from_numpy(of_nodes).view_as(node_features),
            to_edges,
            *(None,) * ctx.indices,
            *(part.view_as(p) for part, p in zip(parts, parameters, strict=True)),
        )
