"""What is measured during training, on trajectories that training does not see."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from adaptgns.config import HISTORY, TrainConfig
from adaptgns.data.trajectories import Trajectories
from adaptgns.losses import training_loss
from adaptgns.metrics import edge_counts, position_mse
from adaptgns.policies import Fixed
from adaptgns.rollout import steps
from adaptgns.simulator import Simulator
from adaptgns.windows import Windows

ONE_STEP_WINDOWS = 64
"""Windows, evenly spread over the split, of the one-step figures"""
MARKS = (50, 100, 200)
COLLAPSED = 20
"""How many times the true edges, or the particles, mean that a rollout has collapsed"""


@dataclass(frozen=True)
class Validation:
    """What was measured, and the first trajectory's rollout to look at."""

    scores: dict[str, float]
    true: NDArray[np.float32]
    """``[K, N, d]``"""
    predicted: NDArray[np.float32]
    """``[K, N, d]``, K fewer where it collapsed"""
    sigma: NDArray[np.float32] | None
    """``[K, N]`` of ``predicted``, normalized units; None without a variance head"""
    mobile: NDArray[np.bool_]
    """``[N]``"""


def validate(simulator: Simulator, valid: Trajectories, config: TrainConfig) -> Validation:
    """One-step and rollout errors on the base graph, from true inputs without noise.

    - ``valid_loss`` and ``valid_one_step_mse`` (normalized accelerations, mean over particles and
      dimensions): of windows spread evenly over the split.
    - ``valid_rollout_mse`` and ``valid_rollout_mse_k``: squared position error, mean over
      particles, dimensions and the first trajectories; the former over all steps, too. A rollout
      whose particles collapse into a pile, where every step costs the square of their number, is
      stopped, and its error is infinite from there.
    """
    plain = replace(
        config,
        graph="base",
        unroll=1,
        variance_ahead=False,
        mirror=False,
        drift=0.0,
        compression=0.0,
    )
    windows = Windows(valid, simulator.metadata, plain, noise=0.0)
    numbers = np.linspace(0, len(windows) - 1, min(ONE_STEP_WINDOWS, len(windows)), dtype=int)
    losses, errors = [], []
    for number in numbers:
        batch = windows.collate([windows[0, int(number)]]).to(simulator.lower.device)
        with torch.inference_mode():
            prediction = simulator(batch.window, batch.particle_type, batch.graph, batch.material)
            target = simulator.target(batch.window, batch.following[:, 0])
            losses.append(float(training_loss(config.loss, prediction, target, batch.mobile)))
            errors.append(float(training_loss("mse", prediction, target, batch.mobile)))

    curves, shown = [], None
    for index in range(min(len(valid), config.validate_trajectories)):
        trajectory = valid[index]
        true = trajectory.positions[HISTORY:][: config.validate_horizon]
        mobile, box = simulator.metadata.mobile(trajectory.particle_type), simulator.metadata.box
        everyone = np.ones_like(mobile)
        predicted: list[NDArray[np.float32]] = []
        sigmas: list[NDArray[np.float32]] = []
        most = 0.0
        for number, step in enumerate(steps(simulator, trajectory, Fixed(), len(true))):
            predicted.append(step.positions)
            if step.sigma is not None:
                sigmas.append(step.sigma)
            if step.edges > most:
                there = edge_counts(true[[number]], simulator.radius, everyone, box)[0]
                most = max(most, COLLAPSED * max(there, len(mobile)))
                if step.edges > most:
                    break
        curve = np.full(len(true), np.inf)
        curve[: len(predicted)] = position_mse(
            np.stack(predicted), true[: len(predicted)], mobile, box
        )
        curves.append(np.where(np.isfinite(curve), curve, np.inf))
        shown = shown or (true, np.stack(predicted), np.stack(sigmas) if sigmas else None, mobile)
    assert shown is not None, "a split has a trajectory"
    shortest = min(map(len, curves))
    curve = np.mean([c[:shortest] for c in curves], axis=0)
    scores = {
        "valid_loss": float(np.mean(losses)),
        "valid_one_step_mse": float(np.mean(errors)),
        "valid_rollout_mse": float(curve.mean()),
        **{f"valid_rollout_mse_{k}": float(curve[k - 1]) for k in MARKS if k <= shortest},
    }
    return Validation(scores, *shown)
