"""Features, integration and symmetries of the simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from adaptgns import _core
from adaptgns.config import ModelConfig
from adaptgns.data.metadata import Metadata
from adaptgns.segment import Graph
from adaptgns.simulator import Simulator
from tests.conftest import graph_of, random_windows

SMALL = ModelConfig(latent=16, hidden_layers=1, steps=3)


@pytest.fixture
def simulator(metadata: Metadata) -> Simulator:
    torch.manual_seed(0)
    return Simulator(SMALL, metadata, noise=3e-4, variance=True)


def types(count: int) -> torch.Tensor:
    return torch.full((count,), 5)


def test_paper_model_has_the_peers_size_and_a_small_variance_head(metadata: Metadata) -> None:
    with_head = Simulator(ModelConfig(), metadata, noise=6.7e-4, variance=True)
    without = Simulator(ModelConfig(), metadata, noise=6.7e-4, variance=False)
    size = sum(p.numel() for p in without.parameters())
    head = sum(p.numel() for p in with_head.parameters()) - size
    assert size == 1_591_826
    assert 0 < head < 20_000


def test_target_is_what_advance_needs(simulator: Simulator) -> None:
    window = random_windows(np.random.default_rng(1), 20)
    following = window[:, -1] + 1e-3 * torch.randn(20, 2)
    advanced = simulator.advance(window, simulator.target(window, following))
    torch.testing.assert_close(advanced, following, rtol=0, atol=2e-7)


def test_node_features(simulator: Simulator, metadata: Metadata) -> None:
    window = torch.full((1, 6, 2), 0.5)
    window[0, -1] = torch.tensor([0.1 + 0.003, 0.501])
    features = simulator.node_features(window, types(1))[0]
    last_velocity = torch.tensor([0.103 - 0.5, 0.001])
    mean, std = torch.tensor(metadata.velocity_mean), torch.tensor(metadata.velocity_std)
    widened = (std**2 + 3e-4**2).sqrt()
    torch.testing.assert_close(features[8:10], (last_velocity - mean) / widened, rtol=1e-4, atol=0)
    torch.testing.assert_close(features[10:14], torch.tensor([0.2, 1, 1, 1]), rtol=1e-4, atol=0)
    assert features.shape == (10 + 4 + 16,)


def test_edge_features_point_from_receiver_to_sender(simulator: Simulator) -> None:
    positions = np.array([[0.5, 0.5], [0.51, 0.5]], np.float32)
    graph = graph_of(positions, 0.015, self_edges=False)
    window = torch.from_numpy(positions)[:, None].expand(2, 6, 2)
    features = simulator.edge_features(window, graph)
    into_first = features[graph.receivers == 0]
    torch.testing.assert_close(
        into_first, torch.tensor([[2 / 3, 0.0, 2 / 3]]), rtol=1e-4, atol=1e-6
    )


def test_relative_motion(metadata: Metadata) -> None:
    """A pair that closes in along x while both fall."""
    config = replace(SMALL, relative_motion=True)
    simulator = Simulator(config, metadata, noise=3e-4, variance=True)
    velocity = torch.tensor([[1e-3, -2e-3], [-1e-3, -2e-3]])
    fall = torch.tensor([0.0, -1e-4])
    window = torch.empty(2, 6, 2)
    window[:, -1] = torch.tensor([[0.5, 0.5], [0.51, 0.5]])
    for k in range(4, -1, -1):
        window[:, k] = window[:, k + 1] - velocity + (4 - k) * fall
    graph = graph_of(window[:, -1].numpy(), 0.015, self_edges=True)
    speed = 0.2 * (torch.tensor(metadata.velocity_std) ** 2 + 3e-4**2).sqrt()

    edges = simulator.edge_features(window, graph)
    pair = edges[(graph.receivers == 0) & (graph.senders == 1)][0]
    closing = -2e-3 / speed[0]
    expected = torch.stack([closing, torch.tensor(0.0), closing])
    torch.testing.assert_close(pair[:3], torch.tensor([2 / 3, 0, 2 / 3]), rtol=0, atol=1e-4)
    torch.testing.assert_close(pair[3:], expected, rtol=0, atol=1e-3)
    assert (edges[graph.receivers == graph.senders] == 0).all()

    nodes = simulator.node_features(window, types(2))
    accelerations = nodes[:, :8].unflatten(1, (4, 2))
    mean, std = simulator.acceleration_mean, simulator.acceleration_std
    torch.testing.assert_close(
        accelerations, ((fall - mean) / std).expand(2, 4, 2), rtol=0, atol=2e-3
    )
    mean, std = simulator.velocity_mean, simulator.velocity_std
    torch.testing.assert_close(nodes[:, 8:10], (velocity - mean) / std, rtol=0, atol=1e-3)
    assert simulator(window, types(2), graph).acceleration.isfinite().all()


def test_batched_equals_single(simulator: Simulator) -> None:
    rng = np.random.default_rng(2)
    a, b = random_windows(rng, 30), random_windows(rng, 17)
    graphs = [graph_of(w[:, -1].numpy(), 0.015) for w in (a, b)]
    single = [simulator(w, types(len(w)), g) for w, g in zip((a, b), graphs, strict=True)]
    edges = torch.cat(
        [torch.stack([g.senders, g.receivers]) + n for g, n in zip(graphs, (0, 30), strict=True)], 1
    )
    offsets = torch.cat(
        [graphs[0].receiver_offsets[:-1], graphs[1].receiver_offsets + len(graphs[0].senders)]
    )
    batched = simulator(torch.cat([a, b]), types(47), Graph.from_edges(edges, offsets))
    for k in range(2):
        torch.testing.assert_close(
            batched[k], torch.cat([s[k] for s in single]), rtol=1e-4, atol=1e-5
        )


def test_permuting_particles_permutes_the_prediction(simulator: Simulator) -> None:
    rng = np.random.default_rng(3)
    window, order = random_windows(rng, 40), torch.from_numpy(rng.permutation(40))
    plain = simulator(window, types(40), graph_of(window[:, -1].numpy(), 0.015))
    permuted = simulator(window[order], types(40), graph_of(window[order, -1].numpy(), 0.015))
    torch.testing.assert_close(
        permuted.acceleration, plain.acceleration[order], rtol=1e-4, atol=1e-5
    )


def test_gradients_reach_every_parameter(simulator: Simulator) -> None:
    window = random_windows(np.random.default_rng(4), 40)
    out = simulator(window, types(40), graph_of(window[:, -1].numpy(), 0.015))
    (out.acceleration.square().sum() + out.variance.log().sum()).backward()
    for name, parameter in simulator.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_split_edge_layer_equals_concatenation(simulator: Simulator) -> None:
    rng = np.random.default_rng(5)
    window = random_windows(rng, 40)
    graph = graph_of(window[:, -1].numpy(), 0.015)
    layer = simulator.network.layers[0]
    nodes, edges = torch.randn(40, 16), torch.randn(len(graph.senders), 16)
    new_nodes, new_edges = layer(nodes, edges, graph)
    message = layer.edge_mlp(torch.cat([nodes[graph.receivers], nodes[graph.senders], edges], 1))
    incoming = torch.zeros_like(nodes).index_add(0, graph.receivers, message)
    torch.testing.assert_close(new_edges, edges + message, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(
        new_nodes, nodes + layer.node_mlp(torch.cat([incoming, nodes], 1)), rtol=1e-5, atol=1e-5
    )


def test_without_edges_each_particle_is_on_its_own(metadata: Metadata) -> None:
    torch.manual_seed(0)
    mlp = Simulator(replace(SMALL, edges=False), metadata, noise=0.0, variance=True)
    window = random_windows(np.random.default_rng(6), 12)
    together = mlp(window, types(12), None).acceleration
    alone = torch.cat([mlp(w[None], types(1), None).acceleration for w in window])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-5)


def test_periodic_axes_use_the_nearest_image(metadata: Metadata) -> None:
    periodic = replace(metadata, bounds=((0.0, 1.0), (0.1, 0.9)), periodic=(True, False))
    torch.manual_seed(0)
    simulator = Simulator(SMALL, periodic, noise=0.0, variance=True)
    window = random_windows(np.random.default_rng(7), 10)
    moved = window.clone()
    moved[..., 0] = (moved[..., 0] + 0.65) % 1.0  # across the boundary
    assert (moved[..., 0].diff(dim=1).abs() > 0.5).any()
    assert simulator.node_features(window, types(10)).shape == (10, 10 + 2 + 16)
    torch.testing.assert_close(
        simulator.node_features(moved, types(10)),
        simulator.node_features(window, types(10)),
        rtol=0,
        atol=1e-3,
    )
    advanced = simulator.advance(moved, torch.zeros(10, 2))
    assert ((advanced[:, 0] >= 0) & (advanced[:, 0] < 1)).all()


def test_relative_motion_across_a_period(metadata: Metadata) -> None:
    periodic = replace(metadata, bounds=((0.0, 1.0), (0.1, 0.9)), periodic=(True, False))
    torch.manual_seed(0)
    config = replace(SMALL, relative_motion=True)
    simulator = Simulator(config, periodic, noise=3e-4, variance=True)
    window = random_windows(np.random.default_rng(7), 40)
    moved = window.clone()
    moved[..., 0] = (moved[..., 0] + 0.65) % 1.0  # across the boundary
    assert (moved[..., 0].diff(dim=1).abs() > 0.5).any()
    box = np.array([1.0, np.inf])
    graph = graph_of(window[:, -1].numpy(), 0.015)
    edges, offsets = _core.radius_graph(
        moved[:, -1].numpy(), 0.015, box=box, self_edges=True, return_offsets=True
    )
    assert np.array_equal(edges, torch.stack([graph.senders, graph.receivers]).numpy())
    torch.testing.assert_close(
        simulator.edge_features(moved, Graph.from_numpy(edges, offsets)),
        simulator.edge_features(window, graph),
        rtol=0,
        atol=1e-3,
    )


def test_gradients_of_positions_do_not_depend_on_chance(metadata: Metadata) -> None:
    """Two threads, and more edges than torch sums on one."""
    torch.manual_seed(0)
    config = replace(SMALL, relative_motion=True)
    simulator = Simulator(config, metadata, noise=3e-4, variance=True)
    window = random_windows(np.random.default_rng(0), 4000).requires_grad_()
    graph = graph_of(window[:, -1].detach().numpy(), 0.015)
    weights = torch.randn(len(graph.senders), 6)
    assert len(weights) > 1 << 17

    def gradient() -> torch.Tensor:
        features = simulator.edge_features(window, graph)
        return torch.autograd.grad((features * weights).sum(), window)[0]

    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        first, *others = [gradient() for _ in range(6)]
    finally:
        torch.set_num_threads(threads)
    assert first.isfinite().all()
    assert all(torch.equal(first, other) for other in others)
