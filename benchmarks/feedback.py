"""What longer edges do to the sigma that the next ones are chosen by.

    T=results/laptop/training
    python benchmarks/feedback.py $T/waterdrop/nll-0 waterdrop $T/waterdrop/nll-800-0 \\
        $T/waterdrop/nll-narrow-400-0 $T/sand/nll-0 sand $T/sand/nll-narrow-400-0 \\
        --out benchmarks/results/feedback.json

Models of the package (``waterdrop``, ``sand``) and run folders, here of the study that ``python -m
adaptgns.reproduce`` makes, step from the true positions of their data's test trajectories, while
the particles of the highest sigma one step ago see farther, or random ones. In each
step a second pass tells sigma on the base graph. Reported are, in means over the steps:

- ``expanded``, ``others``: sigma on the step's graph over that on the base graph, of the particles
  that see farther and of the others (geometric means);
- ``as_base``: of those whom sigma chooses for the next step, the share that sigma of the base graph
  would choose: 1 where edges do not change sigma, 0.3 where the choice has nothing to do with it;
- ``again``: the share of them that see farther already.

Intervals are over the trajectories.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from machine import machine
from numpy.typing import NDArray

from adaptgns.atomic import write_json
from adaptgns.checkpoint import read_checkpoint
from adaptgns.config import HISTORY, AdaptiveConfig, PolicyName
from adaptgns.data.default import dataset_folder
from adaptgns.data.trajectories import Trajectory, open_split
from adaptgns.policies import Edges, State
from adaptgns.reproduce.results import estimate
from adaptgns.rollout import steps
from adaptgns.simulator import Simulator

RULE = AdaptiveConfig()
STEPS = 200
SIGNALS = ("sigma", "random")
FIGURES = ("expanded", "others", "as_base", "again")


class Watched:
    """The adaptive graph by sigma, or by chance, with sigma on the base graph beside."""

    name: ClassVar[PolicyName] = "adaptive"
    needs_sigma: ClassVar[bool] = True

    def __init__(self, signal: str) -> None:
        self.signal = signal
        self.rng = np.random.default_rng(0)

    def edges(self, state: State) -> Edges:
        self.mobile, base = state.mobile, state.base()
        self.base_sigma = state.predict_sigma(base)
        self.chosen = np.zeros(len(self.mobile), bool)
        if state.sigma is None:
            return base
        signal = state.sigma
        if self.signal == "random":
            signal = self.rng.random(len(signal), dtype=np.float32)
        self.chosen = high(signal, state.mobile)
        return state.expanded(signal, RULE)


def high(sigma: NDArray[np.float32], mobile: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``[N]`` whom the rule lets see farther."""
    return mobile & (sigma > np.percentile(sigma[mobile], RULE.tau))


def watch(simulator: Simulator, trajectory: Trajectory, signal: str) -> list[float]:
    """The figures of one trajectory."""
    graph, rows = Watched(signal), []
    count = min(STEPS, len(trajectory.positions) - HISTORY)
    for step in steps(simulator, trajectory, graph, count, teacher_forcing=True):
        assert step.sigma is not None
        chosen, others = graph.chosen, graph.mobile & ~graph.chosen
        following = high(step.sigma, graph.mobile)
        if chosen.any() and following.any():
            ratio = np.log(step.sigma / graph.base_sigma)
            base = high(graph.base_sigma, graph.mobile)
            shares = base[following].mean(), chosen[following].mean()
            rows.append([ratio[chosen].mean(), ratio[others].mean(), *shares])
    means = np.mean(rows, axis=0)
    return [*np.exp(means[:2]).tolist(), *means[2:].tolist()]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkpoints", nargs="+", help="waterdrop, sand, or run folders")
    parser.add_argument("--trajectories", type=int, default=10)
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name in options.checkpoints:
        checkpoint = read_checkpoint(Path(name))
        test = open_split(dataset_folder(checkpoint.config.data), "test")
        simulator = checkpoint.simulator()
        for signal in SIGNALS:
            count = min(options.trajectories, len(test))
            found = np.array([watch(simulator, test[i], signal) for i in range(count)])
            figures = {
                figure: asdict(estimate(values[None]))
                for figure, values in zip(FIGURES, found.T, strict=True)
            }
            rows.append(
                {
                    "checkpoint": "/".join(Path(name).parts[-2:]),
                    "loss": checkpoint.config.loss,
                    "graph": checkpoint.config.graph,
                    "seed": checkpoint.config.seed,
                    "training_steps": checkpoint.config.steps,
                    "chosen_by": signal,
                    "trajectories": count,
                    **figures,
                }
            )
            shown = ", ".join(
                f"{figure} {value['mean']:.2f} [{value['low']:.2f}, {value['high']:.2f}]"
                for figure, value in figures.items()
            )
            print(f"{name}, chosen by {signal}: {shown}", flush=True)
    if options.out is not None:
        write_json(options.out, {"machine": machine(), "steps": STEPS, "rows": rows})


if __name__ == "__main__":
    main()
