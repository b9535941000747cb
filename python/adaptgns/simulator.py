"""The learned simulator: features of a window of positions, the network, and the integrator.

Shapes: N particles, E edges, d dimensions, H = ``HISTORY`` positions per window. Velocities are
per frame, accelerations per frame squared; "normalized" means divided by the data's standard
deviation after its mean is taken off.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from adaptgns.config import HISTORY, TYPE_EMBEDDING, ModelConfig, Precision
from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectory import PARTICLE_TYPES
from adaptgns.network import EncodeProcessDecode, Prediction
from adaptgns.segment import Graph, at_receivers, at_senders

RELATIVE_SPEED = 0.2
"""How far neighbours' velocities differ, as a share of the velocities' std: the scale of their
difference as a feature."""


class Simulator(nn.Module):
    """A graph network simulator together with all that it must know of its data.

    ``noise`` is the std of the training noise (length per frame): both normalizing standard
    deviations are widened with it, sqrt(std^2 + noise^2).
    """

    def __init__(
        self,
        config: ModelConfig,
        metadata: Metadata,
        *,
        noise: float,
        variance: bool,
        variance_alone: bool = False,
        precision: Precision = "float32",
    ) -> None:
        super().__init__()
        self.config = config
        self.metadata = metadata
        self.radius = config.radius_or(metadata.radius)
        dim = metadata.dim
        open_axes = [axis for axis in range(dim) if not metadata.periodic[axis]]
        self.type_embedding = nn.Embedding(PARTICLE_TYPES, TYPE_EMBEDDING)
        self.network = EncodeProcessDecode(
            node_features=(HISTORY - 1) * dim
            + 2 * len(open_axes)
            + TYPE_EMBEDDING
            + metadata.material_properties,
            edge_features=(dim + 1) * (2 if config.relative_motion else 1),
            outputs=dim,
            latent=config.latent,
            hidden_layers=config.hidden_layers,
            steps=config.steps,
            edges=config.edges,
            variance=variance,
            variance_layers=config.variance_layers,
            variance_alone=variance_alone,
            legacy_edges=config.edge_update == "legacy",
            precision=precision,
        )

        def constant(name: str, values: object) -> None:
            self.register_buffer(name, torch.as_tensor(values, dtype=torch.float32), False)

        def widened(std: tuple[float, ...]) -> list[float]:
            return [(s * s + noise * noise) ** 0.5 for s in std]

        constant("velocity_mean", metadata.velocity_mean)
        constant("velocity_std", widened(metadata.velocity_std))
        constant("acceleration_mean", metadata.acceleration_mean)
        constant("acceleration_std", widened(metadata.acceleration_std))
        bounds = torch.tensor(metadata.bounds)[open_axes]  # [open axes, 2]
        constant("lower", bounds[:, 0])
        constant("upper", bounds[:, 1])
        self.open_axes = open_axes
        constant("origin", [low for low, _ in metadata.bounds])
        walls = [
            (-torch.inf, torch.inf) if periodic else pair
            for pair, periodic in zip(metadata.bounds, metadata.periodic, strict=True)
        ]
        constant("low", [low for low, _ in walls])
        constant("high", [high for _, high in walls])
        constant("box", metadata.box if metadata.box is not None else [torch.inf] * dim)

    velocity_mean: Tensor
    velocity_std: Tensor
    acceleration_mean: Tensor
    acceleration_std: Tensor
    lower: Tensor
    upper: Tensor
    origin: Tensor
    low: Tensor
    high: Tensor
    box: Tensor

    def displacement(self, to: Tensor, start: Tensor) -> Tensor:
        """``to - start``, the nearest image of it along periodic axes."""
        difference = to - start
        if self.metadata.box is None:
            return difference
        return difference - self._periods((difference / self.box).round())

    def _periods(self, count: Tensor) -> Tensor:
        """``count`` periods along each axis, 0 along open ones, whose period is infinite."""
        return torch.where(self.box.isinf(), 0, self.box * count)

    def node_features(
        self, window: Tensor, particle_type: Tensor, material: Tensor | None = None
    ) -> Tensor:
        """Features ``[N, :]`` of positions ``[N, H, d]``: the H - 1 velocities (with
        ``relative_motion`` the last one and the H - 2 accelerations), the clipped distances to the
        open bounds over the radius, the type's embedding, the material."""
        velocity = self.displacement(window[:, 1:], window[:, :-1])  # [N, H-1, d]
        normalized = (velocity - self.velocity_mean) / self.velocity_std
        if self.config.relative_motion:
            acceleration = (velocity.diff(dim=1) - self.acceleration_mean) / self.acceleration_std
            normalized = torch.cat([acceleration, normalized[:, -1:]], dim=1)
        current = window[:, -1, self.open_axes]
        distance = torch.cat([current - self.lower, self.upper - current], dim=1)
        parts = [
            normalized.flatten(1),
            (distance / self.radius).clamp(-1, 1),
            self.type_embedding(particle_type),
        ]
        if material is not None:
            parts.append(material)
        return torch.cat(parts, dim=1)

    def edge_features(self, window: Tensor, graph: Graph) -> Tensor:
        """Features ``[E, :]`` of positions ``[N, H, d]``: (sender - receiver) / radius and its
        norm; with ``relative_motion`` also the difference of the last velocities and its part
        along the edge."""
        positions = window[:, -1]
        displacement = self.displacement(
            at_senders(positions, graph), at_receivers(positions, graph)
        )
        displacement = displacement / self.radius
        parts = [displacement, displacement.norm(dim=1, keepdim=True)]
        if self.config.relative_motion:
            velocity = self.displacement(positions, window[:, -2])
            relative = at_senders(velocity, graph) - at_receivers(velocity, graph)
            relative = relative / (RELATIVE_SPEED * self.velocity_std)
            direction = functional.normalize(displacement, dim=1, eps=1e-3)
            parts += [relative, (relative * direction).sum(dim=1, keepdim=True)]
        return torch.cat(parts, dim=1)

    def forward(
        self,
        window: Tensor,
        particle_type: Tensor,
        graph: Graph | None,
        material: Tensor | None = None,
    ) -> Prediction:
        """The normalized acceleration of every particle of ``window`` ``[N, H, d]``."""
        nodes = self.node_features(window, particle_type, material)
        edges = None if graph is None else self.edge_features(window, graph)
        return self.network(nodes, edges, graph)  # type: ignore[no-any-return]

    def advance(self, window: Tensor, acceleration: Tensor) -> Tensor:
        """The next positions ``[N, d]`` by semi-implicit Euler with one frame as the time unit:
        v' = v + a, x' = x + v'; ``acceleration`` is normalized. Periodic axes are wrapped,
        and ``walls`` hold."""
        velocity = self.displacement(window[:, -1], window[:, -2])
        velocity = velocity + acceleration * self.acceleration_std + self.acceleration_mean
        following = window[:, -1] + velocity
        if self.config.walls:
            following = following.clamp(self.low, self.high)
        if self.metadata.box is None:
            return following
        return following - self._periods(((following - self.origin) / self.box).floor())

    def target(self, window: Tensor, following: Tensor) -> Tensor:
        """The normalized acceleration ``[N, d]`` that :meth:`advance` needs to get from
        ``window`` to the ``following`` positions ``[N, d]``."""
        before = self.displacement(window[:, -1], window[:, -2])
        after = self.displacement(following, window[:, -1])
        return (after - before - self.acceleration_mean) / self.acceleration_std
