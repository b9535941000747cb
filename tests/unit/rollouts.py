"""Small rollout files for the tests of what reads them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectory import INPUT_FRAMES, Trajectory
from adaptgns.rollout_file import RolloutWriter


@dataclass(frozen=True)
class Step:
    """What the simulator gives for a step."""

    positions: np.ndarray
    sigma: np.ndarray | None
    squared_error: np.ndarray
    edges: int = 10
    graph_ms: float = 0.5
    model_ms: float = 2.0


def falling_block(steps: int = 12, *, seed: int = 0, particles: int = 40) -> Trajectory:
    """Particles that fall in 2D and drift apart; the first three are kinematic and rest."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(0.4, 0.5, (particles, 2))
    velocity = rng.normal(0.0, 5e-4, (particles, 2))
    time = np.arange(INPUT_FRAMES + steps)[:, None, None]
    positions = start + time * velocity - [0.0, 6e-5] * time**2 / 2
    positions[:, :3] = start[:3]
    particle_type = np.full(particles, 5)
    particle_type[:3] = 3
    return Trajectory(f"block {seed}", positions.astype(np.float32), particle_type)


def steps_of(
    trajectory: Trajectory, *, error: float = 0.0, sigma: bool = True, seed: int = 1
) -> Iterator[Step]:
    """The true steps of ``trajectory``, moved aside by ``error`` times the number of the step."""
    rng = np.random.default_rng(seed)
    particles = len(trajectory.particle_type)
    for number, true in enumerate(trajectory.positions[INPUT_FRAMES:], start=1):
        variance = rng.uniform(0.1, 2.0, particles)
        noise = rng.normal(0.0, 1.0, (particles, 2)) ** 2
        yield Step(
            positions=true + np.float32(error * number),
            sigma=np.sqrt(variance).astype(np.float32) if sigma else None,
            squared_error=(variance * noise.sum(axis=1)).astype(np.float32),
        )


def settings(**changes: Any) -> Mapping[str, Any]:
    return {
        "label": "GNS nll",
        "policy": "fixed",
        "trained_radius": 0.015,
        "radius": None,
        "adaptive": {"tau": 70.0, "factor": 1.267},
    } | changes


def write_rollout(
    path: Path,
    metadata: Metadata,
    *,
    trajectories: int = 2,
    steps: int = 12,
    error: float = 1e-3,
    sigma: bool = True,
    **changes: Any,
) -> Path:
    """A file of rollouts that are off by ``error`` more at every step."""
    with RolloutWriter(path, metadata=metadata, settings=settings(**changes)) as writer:
        for seed in range(trajectories):
            trajectory = falling_block(steps, seed=seed)
            one_step = list(enumerate(steps_of(trajectory, sigma=sigma), start=INPUT_FRAMES))
            rolled = steps_of(trajectory, error=error, sigma=sigma)
            writer.add(trajectory, rolled, one_step[::3])
    return path
