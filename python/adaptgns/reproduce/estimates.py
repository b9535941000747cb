"""How long the runs of a study would take on this machine, from a few steps of each kind."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch

from adaptgns import _core
from adaptgns.checkpoint import build_simulator
from adaptgns.config import HISTORY, Loss, TrainConfig, torch_device
from adaptgns.data.default import DEFAULT_SETS
from adaptgns.data.generation import SplitPlan
from adaptgns.data.metadata import Metadata
from adaptgns.data.scenes import SCENES
from adaptgns.data.trajectories import open_split
from adaptgns.graph import radius_graph
from adaptgns.losses import training_loss
from adaptgns.reproduce.runs import Run, Split
from adaptgns.segment import Graph
from adaptgns.threads import thread_count

REPEATS = 3
"""Of which the fastest counts: what else the machine does is not the run's cost."""


def seconds(run: Run) -> float:
    """Of what is missing of a run, roughly: training steps, unless all are done, and steps of the
    rollouts, which are taken to have as many edges as the true ones."""
    profile, model = run.study.profile, run.model
    train, test = (_particles(run, split) for split in ("train", "test"))
    base = replace(profile.base, device=run.study.device)
    samples = base.batch
    if base.batch_particles is not None:
        samples = max(1, min(samples, base.batch_particles // train))
    factor = 1.0 if model.radius == "matched" else model.radius
    forward, both = _step(base, model.edges, model.loss, samples * train, factor)
    unrolled = 1 + (base.unroll - 1) / 2  # in the second half alone
    training = 0.0
    if model.chosen is None and not run.trained_whole:
        a_step = both * unrolled + (forward if model.graph != "base" else 0.0)
        training = model.share * run.data.steps * a_step
    one, _ = _step(base, model.edges, model.loss, test, factor)
    passes = sum(
        (2 if policy in ("two-pass", "base-sigma") else 1) * _rollout_steps(run, split)
        for policy, split in run.missing
    )
    return training + 2 * passes * one  # each rollout beside its single steps from true positions


def _plan(run: Run, split: str) -> SplitPlan | None:
    """Of a set that is generated; None for a folder of data."""
    for sets in (run.study.profile.plans, DEFAULT_SETS):
        for name, plans in sets.items():
            if name == run.data.source:
                return plans[split]
    return None


def _particles(run: Run, split: str) -> int:
    """Of a typical trajectory."""
    plan = _plan(run, split)
    if plan is None:
        return int(np.median(open_split(run.data.folder, split).particle_counts))
    if plan.particles is not None:
        return sum(plan.particles) // 2
    drawn = [
        len(_core.simulate(plan.scene, seed=seed, frames=1, dim=plan.dim)[1]) for seed in range(5)
    ]
    return int(np.median(drawn))


def _rollout_steps(run: Run, split: Split) -> int:
    """Of all rollouts of the test set, or of the long trajectories."""
    profile, long = run.study.profile, run.data.long if split == "long" else None
    plan = (long and long.plan) or _plan(run, "test")
    if plan is None:
        test = open_split(run.data.folder, "test")
        count, frames = len(test), int(np.median(test.lengths)) - HISTORY
    else:
        count, frames = plan.trajectories, plan.frames - HISTORY
    if long is not None:
        return count * frames
    wanted = profile.trajectories_of(run.model, split)
    return min(count, wanted or count) * min(frames, profile.horizon or frames)


@lru_cache
def _step(
    base: TrainConfig, edges: bool, loss: Loss, particles: int, radius: float
) -> tuple[float, float]:
    """Seconds of a forward pass, and of one with the way back, on particles spread as in water."""
    scene = SCENES["waterdrop"]
    metadata = Metadata(
        dim=2,
        dt=scene.dt,
        bounds=((scene.low, scene.high),) * 2,
        periodic=(False, False),
        radius=scene.radii[0],
        kinematic_types=(),
        velocity_mean=(0.0, 0.0),
        velocity_std=(1e-3, 1e-3),
        acceleration_mean=(0.0, 0.0),
        acceleration_std=(1e-4, 1e-4),
    )
    side = (particles * np.pi * metadata.radius**2 / 5.4) ** 0.5  # 5.4 neighbours
    positions = np.random.default_rng(0).uniform(0.2, 0.2 + side, (particles, 2))
    config = replace(base, loss=loss, model=replace(base.model, edges=edges))
    device = torch_device(base.device)
    simulator = build_simulator(config, metadata).to(device)
    window = torch.from_numpy(np.repeat(positions[:, None], HISTORY, 1).astype(np.float32))
    window = window.to(device)
    kind, mobile = (torch.ones(particles, dtype=t, device=device) for t in (torch.long, torch.bool))

    def forward() -> torch.Tensor:
        graph = None
        if edges:
            found = radius_graph(
                positions.astype(np.float32),
                radius * metadata.radius,
                self_edges=True,
                threads=thread_count(),
                return_offsets=True,
            )
            graph = Graph.from_numpy(*found).to(device)
        prediction = simulator(window, kind, graph)
        return training_loss(config.loss, prediction, window[:, -1], mobile)

    def alone() -> None:
        with torch.no_grad():
            float(forward())

    def both() -> None:
        forward().backward()  # type: ignore[no-untyped-call]
        float(next(simulator.parameters()).detach().sum())

    return _fastest(alone), _fastest(both)


def _fastest(work: Callable[[], None]) -> float:
    times = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times[1:])
