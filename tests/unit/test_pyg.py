"""The PyTorch Geometric side: its radius graph by brute force, and frames as `Data`."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from adaptgns.config import ModelConfig
from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectory import Trajectory
from adaptgns.pyg import frame_data, radius_graph
from adaptgns.segment import Graph
from adaptgns.simulator import Simulator


def brute(x: torch.Tensor, r: float, batch: torch.Tensor, loop: bool) -> set[tuple[int, int]]:
    near = (torch.cdist(x.double(), x.double()) <= r) & (batch[:, None] == batch[None])
    if not loop:
        near.fill_diagonal_(False)
    return {(int(a), int(b)) for a, b in near.nonzero()}


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_radius_graph_has_every_neighbour(dim: int, loop: bool) -> None:
    x = torch.rand(200, dim, generator=torch.Generator().manual_seed(dim))
    batch = torch.arange(200) // 90 * 2  # three examples and two empty ones
    edges = radius_graph(x, 0.6, batch, loop, batch_size=6)
    assert {(a, b) for a, b in edges.T.tolist()} == brute(x, 0.6, batch, loop)
    assert edges.shape[1] > 32 * 200  # more than the default limit of the original
    assert edges[1].diff().min() >= 0
    flipped = radius_graph(x, 0.6, batch, loop, flow="target_to_source", num_workers=1)
    assert torch.equal(flipped, edges.flip(0))
    alone = radius_graph(x[:90], 0.6)
    assert torch.equal(alone, radius_graph(x, 0.6, batch)[:, : alone.shape[1]])


def test_a_limit_is_an_error_and_not_a_cut() -> None:
    x = torch.zeros(5, 2)
    assert radius_graph(x, 0.1, max_num_neighbors=4).shape == (2, 20)
    with pytest.raises(ValueError, match="max_num_neighbors is 3, but point 0 has 4 within r"):
        radius_graph(x, 0.1, max_num_neighbors=3)
    assert radius_graph(torch.zeros(0, 2), 0.1, max_num_neighbors=1).shape == (2, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"batch": torch.tensor([0, 1])}, r"batch has shape \[2\]; \[3\] is accepted"),
        ({"batch": torch.tensor([1, 0, 1])}, "batch isn't sorted"),
        (
            {"batch": torch.tensor([0, 0, 1]), "batch_size": 1},
            "batch_size is 1, but batch goes to 1",
        ),
        ({"flow": "upwards"}, "flow is 'upwards'"),
    ],
)
def test_wrong_arguments_are_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        radius_graph(torch.zeros(3, 2), 0.1, **arguments)  # type: ignore[arg-type]


def trajectory(material: bool) -> Trajectory:
    rng = np.random.default_rng(0)
    steps = rng.normal(0, 2e-3, (9, 30, 2)).cumsum(0)
    positions = ((rng.uniform(0.1, 0.9, (30, 2)) + steps - 0.1) % 0.8 + 0.1).astype(np.float32)
    properties = rng.random((30, 2), dtype=np.float32) if material else None
    return Trajectory("", positions, np.zeros(30, np.int64), properties)


@pytest.mark.parametrize("periodic", [False, True])
def test_frame_data_is_what_the_simulator_sees(metadata: Metadata, periodic: bool) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its own deprecations
        pytest.importorskip("torch_geometric")
    metadata = replace(metadata, periodic=(periodic, periodic))
    one = trajectory(material=periodic)
    data = frame_data(one, 6, metadata, radius=0.2)
    simulator = Simulator(ModelConfig(radius=0.2), metadata, noise=0.0, variance=False)
    window = torch.from_numpy(one.positions[1:8]).transpose(0, 1)
    offsets = torch.cat(
        [
            torch.zeros(1, dtype=torch.int64),
            torch.bincount(data.edge_index[1], minlength=30).cumsum(0),
        ]
    )
    features = simulator.edge_features(window[:, :6], Graph.from_edges(data.edge_index, offsets))
    torch.testing.assert_close(data.edge_attr, features, atol=1e-5, rtol=0)
    assert data.velocity.shape == (30, 5, 2)
    target = (data.y - simulator.acceleration_mean) / simulator.acceleration_std
    torch.testing.assert_close(
        target, simulator.target(window[:, :6], window[:, 6]), atol=2e-3, rtol=1e-3
    )
    assert ("material_property" in data) == periodic
    assert data.validate()
    assert "y" not in frame_data(one, 8, metadata)
    for frame in (4, 9):
        with pytest.raises(ValueError, match=f"frame is {frame}; 5 to 8 are accepted"):
            frame_data(one, frame, metadata)


def test_without_pytorch_geometric(metadata: Metadata, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch_geometric.data", None)
    with pytest.raises(ImportError, match="frame_data needs PyTorch Geometric; pip install"):
        frame_data(trajectory(False), 6, metadata)
