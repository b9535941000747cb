"""Rollout steps of as many particles as fit: seconds of each, and the most memory.

    python benchmarks/scale.py [--out benchmarks/results/scale.json] [--particles 1000000]

Particles lie uniformly at random in a square, 6.8 others within the radius of each; the network
has the paper's size and random weights; the steps are those of ``adaptgns.rollout``. Beside the
memory measured stands what the plain form of ``step.py`` needs for the same: ``--form plain``
measures that, too, where it fits. ``--device cuda`` takes the steps on a GPU, whose memory is then
measured, too.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import machine, resident
from step import plain
from torch import Tensor

from adaptgns.config import HISTORY, ModelConfig, Precision
from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectory import Trajectory
from adaptgns.network import EncodeProcessDecode, Prediction
from adaptgns.policies import Fixed
from adaptgns.rollout import steps
from adaptgns.segment import Graph
from adaptgns.simulator import Simulator

NEIGHBOURS = 6.8
"""Others within the radius of a particle, as in the data sets of water in 2D"""
MODEL = ModelConfig()
"""Width 128, 10 steps, self-edges"""


class Plain(EncodeProcessDecode):
    """The network as peers write it."""

    def forward(
        self, node_features: Tensor, edge_features: Tensor | None, graph: Graph | None
    ) -> Prediction:
        assert edge_features is not None
        assert graph is not None
        return Prediction(*plain(self, node_features, edge_features, graph))


def scene(particles: int, count: int) -> tuple[Metadata, Trajectory]:
    """Particles that drift a hundredth of the radius per frame."""
    radius = math.sqrt(NEIGHBOURS / (math.pi * particles))
    metadata = Metadata(
        dim=2,
        dt=1.0,
        bounds=((0.0, 1.0), (0.0, 1.0)),
        periodic=(False, False),
        radius=radius,
        velocity_mean=(0.0, 0.0),
        velocity_std=(radius / 100,) * 2,
        acceleration_mean=(0.0, 0.0),
        acceleration_std=(radius / 1000,) * 2,
        kinematic_types=(),
    )
    rng = np.random.default_rng(0)
    start = rng.random((particles, 2), dtype=np.float32)
    velocity = rng.normal(scale=radius / 100, size=(particles, 2)).astype(np.float32)
    frames = np.arange(HISTORY + count, dtype=np.float32)
    positions = start + frames[:, None, None] * velocity
    return metadata, Trajectory("random", positions, np.full(particles, 5, dtype=np.int64))


def plain_mib(particles: int, edges: int) -> float:
    """MiB of latents that the plain form holds at once without gradients, while it concatenates:
    of each edge its latent, its last message, both ends gathered and the three together, of each
    node its latent and the sum of messages."""
    per_edge, per_node = (1 + 1 + 2 + 3) * MODEL.latent, 2 * MODEL.latent
    return 4 * (edges * per_edge + particles * per_node) / 2**20


def measure(
    particles: int, count: int, form: str, device: str, precision: Precision
) -> dict[str, Any]:
    metadata, trajectory = scene(particles, count)
    torch.manual_seed(0)
    simulator = Simulator(MODEL, metadata, noise=0.0, variance=True).eval()
    simulator.to(device)
    simulator.network.precision = precision
    if form == "plain":
        simulator.network.__class__ = Plain
    torch.linalg.norm(torch.randn(500, 500) @ torch.randn(500, 500))  # libraries are loaded
    before = resident("VmRSS")
    taken = []
    for step in steps(simulator, trajectory, Fixed(), count):
        assert np.isfinite(step.positions).all()
        taken.append({"graph_s": step.graph_ms / 1e3, "model_s": step.model_ms / 1e3})
        edges = step.edges + particles
        print(f"{edges:,} edges", "  ".join(f"{k} {v:.3g}" for k, v in taken[-1].items()))
    gpu = torch.cuda.max_memory_allocated() / 2**20 if device == "cuda" else None
    return {
        "form": form,
        "device": device,
        "precision": precision,
        "particles": particles,
        "edges": edges,
        "steps": taken,
        "memory_before_mib": before,
        "memory_peak_mib": resident("VmHWM"),
        "gpu_peak_mib": gpu,
        "one_latent_per_edge_mib": (2 if precision == "bf16" else 4) * edges * MODEL.latent / 2**20,
        "plain_computed_mib": plain_mib(particles, edges),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--particles", type=int, default=1_000_000)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--form", choices=("ours", "plain"), default="ours")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--precision", choices=("float32", "bf16"), default="float32")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    report = {
        "machine": machine(),
        **measure(
            options.particles, options.steps, options.form, options.device, options.precision
        ),
    }
    for name, value in report.items():
        if name.endswith("mib") and value is not None:
            print(f"{name:26} {value:10,.0f}")
    if options.out:
        options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
