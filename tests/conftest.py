"""Fixtures shared by all tests: a metadata, a small falling drop, and where reference data lies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from adaptgns import _core
from adaptgns.config import ModelConfig, TrainConfig
from adaptgns.data.metadata import Metadata
from adaptgns.generate import GenerateConfig, generate
from adaptgns.segment import Graph

SHARED = Path(__file__).parents[2] / "shared"


@pytest.fixture
def shared() -> Path:
    """The folder of reference data that nobody here made."""
    if not SHARED.is_dir():
        pytest.skip(f"reference data is absent: no folder {SHARED.name} beside the repository")
    return SHARED


@pytest.fixture
def metadata() -> Metadata:
    """A 2D box with walls."""
    return Metadata(
        dim=2,
        dt=0.0025,
        bounds=((0.1, 0.9), (0.1, 0.9)),
        periodic=(False, False),
        radius=0.015,
        velocity_mean=(1e-4, -8e-4),
        velocity_std=(2e-3, 2.5e-3),
        acceleration_mean=(0.0, 1e-6),
        acceleration_std=(1.4e-4, 1.5e-4),
        kinematic_types=(3,),
    )


@pytest.fixture
def small_config() -> TrainConfig:
    """A run of a few seconds."""
    return TrainConfig(
        model=ModelConfig(latent=8, hidden_layers=1, steps=2),
        steps=12,
        lr=1e-3,
        schedule="cosine",
        validate_every=6,
        validate_trajectories=1,
        validate_horizon=5,
        checkpoint_every=4,
        device="cpu",
        test_trajectories=1,
        test_horizon=6,
    )


@pytest.fixture(scope="session")
def drops(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of a few small drops."""
    folder = tmp_path_factory.mktemp("drops")
    generate(
        GenerateConfig(
            scene="waterdrop", out=folder, train=3, valid=1, test=2, frames=40, particles=(30, 60)
        )
    )
    return folder


torch.set_num_threads(1)


def graph_of(positions: np.ndarray, radius: float, *, self_edges: bool = True) -> Graph:
    """The radius graph of ``positions`` ``[N, d]`` as the network takes it."""
    edges = _core.radius_graph(positions, radius, self_edges=self_edges, return_offsets=True)
    return Graph.from_numpy(*edges)


def random_windows(rng: np.random.Generator, particles: int, dim: int = 2) -> torch.Tensor:
    """``[N, H, d]`` positions in the middle of the box that move a little."""
    start = rng.uniform(0.3, 0.4, (particles, 1, dim))
    steps = rng.normal(0, 2e-3, (particles, 6, dim))
    return torch.from_numpy((start + steps.cumsum(1)).astype(np.float32))
