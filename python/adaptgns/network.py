"""Encode-process-decode graph network (Sanchez-Gonzalez et al. 2020) with a variance head.

Shapes: N particles, E edges, L latent width.
"""

from __future__ import annotations

import itertools
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from adaptgns import fused
from adaptgns.config import Precision
from adaptgns.segment import Graph, at_receivers, at_senders, sum_at_receivers

VARIANCE_FLOOR = 1e-8
"""Smallest variance the head can predict, in normalized units squared."""


class Prediction(NamedTuple):
    """What the network says of every particle, in normalized units."""

    acceleration: Tensor
    """``[N, d]``"""
    variance: Tensor | None
    """``[N]``, the variance per dimension; None for a network without a variance head."""


class LayerNorm(nn.LayerNorm):
    """torch's, in the type of its parameters: of bf16 on a CPU torch sums their gradients in bf16,
    too, and over thousands of edges is off by more than half."""

    def forward(self, rows: Tensor) -> Tensor:
        return super().forward(rows.to(self.weight.dtype))


def mlp(inputs: int, width: int, hidden_layers: int, outputs: int, *, norm: bool) -> nn.Sequential:
    """``hidden_layers`` ReLU layers of ``width``, a linear output, and a LayerNorm if asked."""
    sizes = [inputs, *[width] * hidden_layers]
    layers: list[nn.Module] = []
    for a, b in itertools.pairwise(sizes):
        layers += [nn.Linear(a, b), nn.ReLU()]
    layers.append(nn.Linear(sizes[-1], outputs))
    if norm:
        layers.append(LayerNorm(outputs))
    return nn.Sequential(*layers)


class InteractionLayer(nn.Module):
    """One message-passing step: edges from their ends, nodes from their summed incoming edges.

    The first edge layer acts on [receiver, sender, edge]. A linear map of a concatenation is the
    sum of maps of its parts, so the node parts are multiplied once per node, not once per edge.
    """

    def __init__(self, latent: int, hidden_layers: int, *, legacy_edges: bool = False) -> None:
        super().__init__()
        self.legacy_edges = legacy_edges
        self.edge_mlp = mlp(3 * latent, latent, hidden_layers, latent, norm=True)
        self.node_mlp = mlp(2 * latent, latent, hidden_layers, latent, norm=True)

    def forward(self, nodes: Tensor, edges: Tensor, graph: Graph) -> tuple[Tensor, Tensor]:
        """Updated nodes ``[N, L]`` and edges ``[E, L]``, residuals included."""
        first = self.edge_mlp[0]
        assert isinstance(first, nn.Linear)
        receiver_part, sender_part, edge_part = first.weight.chunk(3, dim=1)
        hidden = functional.linear(edges, edge_part, first.bias)  # [E, L]
        hidden = hidden + at_receivers(functional.linear(nodes, receiver_part), graph)
        hidden = hidden + at_senders(functional.linear(nodes, sender_part), graph)
        messages = self.edge_mlp[1:](hidden).to(edges.dtype)
        incoming = sum_at_receivers(messages, graph)  # [N, L]
        update = self.node_mlp(torch.cat([incoming, nodes], dim=1))
        return nodes + update, edges + (edges if self.legacy_edges else messages)


class EncodeProcessDecode(nn.Module):
    """Node and edge features to normalized accelerations and their variance.

    Without ``edges`` it is the per-particle baseline: the same encoder, node updates, decoder and
    variance head, and no message ever arrives. With ``variance_alone`` what the variance head
    learns changes nothing else.

    ``precision`` may be changed at any time. With bf16 the products of the encoders and of message
    passing are of numbers in that type, and the latents of the edges are, too, in torch's form (on
    GPUs), and where no gradients are taken; the parameters, the sums over the steps at the nodes,
    the heads and the outputs stay in float32.
    """

    def __init__(
        self,
        node_features: int,
        edge_features: int,
        outputs: int,
        *,
        latent: int,
        hidden_layers: int,
        steps: int,
        edges: bool,
        variance: bool,
        variance_layers: int = 1,
        variance_alone: bool = False,
        legacy_edges: bool = False,
        precision: Precision = "float32",
    ) -> None:
        super().__init__()
        self.precision = precision
        self.legacy_edges = legacy_edges
        self.variance_alone = variance_alone
        self.node_encoder = mlp(node_features, latent, hidden_layers, latent, norm=True)
        self.edge_encoder = (
            mlp(edge_features, latent, hidden_layers, latent, norm=True) if edges else None
        )
        self.layers = nn.ModuleList(
            InteractionLayer(latent, hidden_layers, legacy_edges=legacy_edges)
            if edges
            else mlp(latent, latent, hidden_layers, latent, norm=True)
            for _ in range(steps)
        )
        self.decoder = mlp(latent, latent, hidden_layers, outputs, norm=False)
        self.variance_head = (
            mlp(latent, latent, variance_layers, 1, norm=False) if variance else None
        )

    def forward(
        self, node_features: Tensor, edge_features: Tensor | None, graph: Graph | None
    ) -> Prediction:
        """Predictions for ``node_features`` ``[N, :]`` and ``edge_features`` ``[E, :]``."""
        if fused.applies(node_features) and not self.legacy_edges:
            acceleration, *variances = fused.network(
                self._perceptrons(),
                node_features,
                edge_features,
                graph,
                heads=len(self._heads()),
                alone=self.variance_alone,
                bf16=self.precision == "bf16",
            )
        else:
            with self._autocast(node_features.device.type):
                nodes = self._encode_and_process(node_features, edge_features, graph)
            others = nodes.detach() if self.variance_alone else nodes
            acceleration = self.decoder(nodes)
            variances = [head(others) for head in self._heads()[1:]]
        variance = None
        if variances:
            variance = functional.softplus(variances[0]).squeeze(1) + VARIANCE_FLOOR
        return Prediction(acceleration, variance)

    def _autocast(self, device: str) -> AbstractContextManager[object]:
        if self.precision == "bf16":
            return torch.autocast(device, torch.bfloat16)
        return nullcontext()

    def _encode_and_process(
        self, node_features: Tensor, edge_features: Tensor | None, graph: Graph | None
    ) -> Tensor:
        nodes: Tensor = self.node_encoder(node_features)
        if self.edge_encoder is None:
            for layer in self.layers:
                nodes = nodes + layer(nodes)
            return nodes
        edges = self.edge_encoder(edge_features)
        if self.precision == "bf16":
            edges = edges.bfloat16()
        for layer in self.layers:
            nodes, edges = layer(nodes, edges, graph)
        return nodes

    def _heads(self) -> list[nn.Sequential]:
        return [self.decoder] if self.variance_head is None else [self.decoder, self.variance_head]

    def _perceptrons(self) -> list[nn.Module]:
        """All of them, in the order in which data flow."""
        encoders = [self.node_encoder]
        steps: list[nn.Module] = list(self.layers)
        if self.edge_encoder is not None:
            encoders.append(self.edge_encoder)
            steps = [perceptron for layer in self.layers for perceptron in layer.children()]
        return [*encoders, *steps, *self._heads()]
