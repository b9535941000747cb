"""`python -m adaptgns.evaluate`: measure rollouts against the truth and each other.

Writes metrics.json and prints a table with a row for each rollout file, and for two baselines on
the same trajectories. The measures are defined in adaptgns.metrics.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console

from adaptgns.baselines import GRAVITY, constant_gravity, constant_velocity
from adaptgns.command import plain_errors
from adaptgns.data.metadata import Metadata
from adaptgns.graph_statistics import GraphStatistics, graph_statistics
from adaptgns.metrics import (
    Floats,
    calibration,
    clumping,
    edge_counts,
    kinetic_energy,
    kinetic_energy_error,
    one_step_mse,
    position_mse,
    spearman,
    transport_cost,
)
from adaptgns.report import Measures, Report
from adaptgns.rollout_file import Rollout, RolloutFile

METRICS = "metrics.json"
MARKS = (50, 100, 200)
STATISTICS_STEP = 100
"""Step of the graph statistics, as in table 2 of the paper"""
NAMED = 3
"""Trajectories that a note names"""
DECILES = 10
MATCHED = 2_000
"""Particles up to which clouds are matched: a second for each pair of clouds"""


@dataclass(frozen=True)
class EvaluateConfig:
    """Measure rollouts of one set of trajectories."""

    rollouts: tuple[Path, ...]
    """Rollout files (HDF5), all of the same trajectories."""
    out: Path | None = None
    """Folder for metrics.json; None: that of the first rollout file."""
    steps: tuple[int, ...] = MARKS
    """Predicted frames at which errors are reported; where no file reaches the first of these
    defaults, the last step that all have."""


def evaluate(
    files: Sequence[Path],
    marks: Sequence[int] = MARKS,
    *,
    out: Path | None = None,
    console: Console | None = None,
) -> Report:
    """Measure the rollouts in ``files``, at the steps ``marks`` among others.

    With ``out``, the report is written to metrics.json in this folder; with ``console``, printed.
    ValueError where the files hold rollouts of different trajectories.
    """
    report = measure(files, marks)
    if out is not None:
        report.write(out / METRICS)
    if console is not None:
        report.print(console)
    return report


def measure(files: Sequence[Path], marks: Sequence[int] = MARKS) -> Report:
    """As :func:`evaluate`, neither writing nor printing."""
    if not files:
        raise ValueError("rollouts: got no file; expected one or more")
    if not marks:
        raise ValueError("steps: got none; one or more are accepted")
    if any(mark < 1 for mark in marks):
        raise ValueError(f"steps: got {list(marks)}; steps are counted from 1")
    asked = sorted(set(marks))
    with ExitStack() as stack:
        opened = [stack.enter_context(RolloutFile(path)) for path in files]
        check_same_trajectories(opened)
        first = opened[0]
        names = [rollout.name for rollout in first]
        shortest = min(rollout.steps for file in opened for rollout in file)
        statistics_step = min(STATISTICS_STEP, shortest)
        reached = max(min(rollout.steps for rollout in file) for file in opened)
        marks = [shortest] if tuple(asked) == MARKS and reached < MARKS[0] else asked
        truth_statistics: list[GraphStatistics] = []
        tallies = [Tally() for _ in opened]
        baselines: dict[str, Tally] = defaultdict(Tally)
        for rollouts in zip(*opened, strict=True):
            truth = Truth.of(max(rollouts, key=lambda rollout: rollout.steps), first)
            truth_statistics += truth.statistics(truth.positions, statistics_step)
            for tally, rollout in zip(tallies, rollouts, strict=True):
                predicted = rollout.predicted
                tally.add_positions(truth, predicted, marks)
                tally.add_transport(truth, predicted, marks)
                tally.add_density(truth, predicted)
                tally.add_graph(rollout)
                tally.add_one_step(rollout, truth)
                tally.statistics += truth.statistics(predicted, statistics_step)
            for name, predicted in baseline_predictions(truth):
                baselines[name].add_positions(truth, predicted, marks)
        measures = [
            tally.measures(label, describe_policy(file), file)
            for tally, label, file in zip(tallies, distinct_labels(opened), opened, strict=True)
        ]
        return Report(
            marks=marks,
            trajectories=names,
            rollouts=measures,
            baselines=[tally.measures(name, "") for name, tally in baselines.items()],
            statistics_step=statistics_step,
            true_statistics=truth_statistics,
            notes=[
                *short_notes(measures, marks),
                *divergence_notes(measures, names),
                *gap_notes(measures, names),
                *unit_notes(opened),
            ],
        )


@dataclass(frozen=True)
class Truth:
    """The true course of one trajectory, and what all predictions of it are measured with."""

    initial: NDArray[np.float32]
    """``[H, N, d]``"""
    positions: NDArray[np.float32]
    """``[K, N, d]``"""
    mobile: NDArray[np.bool_]
    """``[N]``"""
    metadata: Metadata

    @classmethod
    def of(cls, rollout: Rollout, file: RolloutFile) -> Truth:
        """Of the trajectory that ``rollout`` predicts."""
        mobile = file.metadata.mobile(rollout.particle_type)
        if not mobile.any():
            raise ValueError(
                f"rollouts: trajectory {rollout.name} of {file.path} has kinematic particles only, "
                "which no metric counts"
            )
        return cls(rollout.initial, rollout.true, mobile, file.metadata)

    @cached_property
    def edges(self) -> NDArray[np.float64]:
        """``[K]`` edges on the true positions."""
        return self.count_edges(self.positions)

    def count_edges(self, positions: Floats) -> NDArray[np.float64]:
        """``[K]`` edges within the data's own radius on positions ``[K, N, d]``."""
        return edge_counts(positions, self.metadata.radius, self.mobile, self.metadata.box)

    def kinetic_energy(self, positions: Floats) -> NDArray[np.float64]:
        """``[K]`` of positions ``[K, N, d]`` that follow the initial ones."""
        course = np.concatenate([self.initial[-1:], positions])
        return kinetic_energy(course, self.mobile, self.metadata.dt, self.metadata.box)

    def statistics(self, positions: Floats, step: int) -> list[GraphStatistics]:
        """Of the radius graph on ``positions`` ``[K, N, d]`` after ``step`` steps; none where they
        are not finite."""
        frame = positions[step - 1]
        if not np.isfinite(frame).all():
            return []
        return [graph_statistics(frame, self.metadata.radius, self.metadata.box)]


@dataclass
class Tally:
    """The measures of one way of predicting, gathered trajectory by trajectory."""

    scalars: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    curves: dict[str, list[NDArray[np.float64]]] = field(default_factory=lambda: defaultdict(list))
    squared_error: list[NDArray[np.float32]] = field(default_factory=list)
    variance: list[NDArray[np.float32]] = field(default_factory=list)
    statistics: list[GraphStatistics] = field(default_factory=list)
    dim: int = 0

    def add_positions(self, truth: Truth, predicted: Floats, marks: Iterable[int]) -> None:
        """Measure predicted positions ``[K, N, d]``."""
        steps, metadata = len(predicted), truth.metadata
        true = truth.positions[:steps]
        mse = position_mse(predicted, true, truth.mobile, metadata.box)
        energy, true_energy = truth.kinetic_energy(predicted), truth.kinetic_energy(true)
        self.curves["mse"].append(mse)
        self.curves["kinetic_energy"].append(energy)
        self.curves["kinetic_energy_true"].append(true_energy)
        self.scalars["mse"].append(float(mse.mean()))
        self.scalars["kinetic_energy_error"].append(kinetic_energy_error(energy, true_energy))
        # A baseline piles its particles up in corners, all of them connected: counting its edges
        # at every step would take longer than all the rest.
        reached = [mark for mark in marks if mark <= steps]
        rows = np.array(reached, dtype=np.int64) - 1
        density = clumping(truth.count_edges(predicted[rows]), truth.edges[rows])
        for mark, row, ratio in zip(reached, rows, density, strict=True):
            self.scalars[f"mse@{mark}"].append(mse[row])
            self.scalars[f"clumping@{mark}"].append(ratio)

    def add_transport(self, truth: Truth, predicted: Floats, marks: Iterable[int]) -> None:
        """Match the clouds at ``marks``, where that does not take long; else it is NaN."""
        for mark in marks:
            if mark > len(predicted):
                continue
            cost = np.nan
            if truth.mobile.sum() <= MATCHED:
                true, box = truth.positions[mark - 1], truth.metadata.box
                cost = transport_cost(predicted[mark - 1], true, truth.mobile, box)
            self.scalars[f"transport@{mark}"].append(cost)

    def add_density(self, truth: Truth, predicted: Floats) -> None:
        """Count the edges within the data's own radius at every step, whatever the policy."""
        self.curves["edges_within_radius"].append(truth.count_edges(predicted))
        self.curves["edges_within_radius_true"].append(truth.edges[: len(predicted)])

    def add_graph(self, rollout: Rollout) -> None:
        """Note what the graphs cost: their edges, and the median times of a step."""
        edges = rollout.edges.astype(np.float64)
        self.curves["edges"].append(edges)
        self.scalars["edges_per_step"].append(float(edges.mean()))
        self.scalars["graph_ms"].append(float(np.median(rollout.graph_ms)))
        self.scalars["model_ms"].append(float(np.median(rollout.model_ms)))

    def add_one_step(self, rollout: Rollout, truth: Truth) -> None:
        """Measure the single steps from true positions, where there are any."""
        one_step = rollout.one_step
        if one_step is None:
            return
        self.dim = truth.positions.shape[2]
        mse = one_step_mse(one_step.squared_error, truth.mobile, self.dim)
        self.scalars["one_step_mse"].append(mse)
        if one_step.variance is not None:
            self.squared_error.append(one_step.squared_error[:, truth.mobile].ravel())
            self.variance.append(one_step.variance[:, truth.mobile].ravel())

    def measures(self, label: str, policy: str, file: RolloutFile | None = None) -> Measures:
        """All of it. A scalar that not every trajectory has is left out."""
        count = len(self.curves["mse"])
        horizon = min(len(curve) for curve in self.curves["mse"])
        error, variance = (
            np.concatenate(pool) if pool else np.empty(0, dtype=np.float32)
            for pool in (self.squared_error, self.variance)
        )
        return Measures(
            label=label,
            policy=policy,
            scalars={
                name: np.array(values)
                for name, values in self.scalars.items()
                if len(values) == count
            },
            curves={
                name: np.mean([curve[:horizon] for curve in curves], axis=0)
                for name, curves in self.curves.items()
            },
            horizon=horizon,
            spearman=spearman(variance, error) if len(error) >= DECILES else None,
            calibration=calibration(variance, error, self.dim, DECILES)
            if len(error) >= DECILES
            else None,
            statistics=self.statistics if len(self.statistics) == count else (),
            settings={} if file is None else file.settings,
            file=None if file is None else str(file.path),
        )


def baseline_predictions(truth: Truth) -> list[tuple[str, NDArray[np.float64]]]:
    """Name and positions ``[K, N, d]`` of each baseline; kinematic particles move as they do."""
    steps, metadata = len(truth.positions), truth.metadata
    bounds, box = metadata.bounds, metadata.box
    predictions = [
        ("constant velocity", constant_velocity(truth.initial, steps, bounds, box=box)),
    ]
    if not metadata.periodic[1]:
        gravity = GRAVITY * metadata.dt**2
        fall = constant_gravity(truth.initial, steps, bounds, gravity, box=box)
        predictions.append(("constant gravity", fall))
    for _, predicted in predictions:
        predicted[:, ~truth.mobile] = truth.positions[:, ~truth.mobile]
    return predictions


def describe_policy(file: RolloutFile) -> str:
    """Policy and, where it is not the trained one, radius of the graph."""
    trained = file.settings.get("trained_radius")
    if trained is None or file.graph_radius == trained:
        return file.policy
    return f"{file.policy}, r = {file.graph_radius:g}"


def distinct_labels(files: Sequence[RolloutFile]) -> list[str]:
    """The models' labels, with the file's path where model and policy alone are not enough."""
    kinds = [(file.label, describe_policy(file)) for file in files]
    return [
        file.label if kinds.count(kind) == 1 else f"{file.label} ({file.path})"
        for file, kind in zip(files, kinds, strict=True)
    ]


def check_same_trajectories(files: Sequence[RolloutFile]) -> None:
    """Raise ValueError unless all ``files`` predict the same trajectories."""
    first = files[0]
    if len(first) == 0:
        raise ValueError(f"rollouts: {first.path} holds no trajectory")
    for file in files[1:]:
        difference = _difference(first, file)
        if difference is not None:
            raise ValueError(
                f"rollouts: {first.path} and {file.path} can't be compared, {difference}; expected "
                "rollouts of the same trajectories"
            )


def _difference(first: RolloutFile, second: RolloutFile) -> str | None:
    """What keeps two files from being compared, in words."""
    if len(first) != len(second):
        return f"they hold {len(first)} and {len(second)} trajectories"
    for name in ("dim", "dt", "radius", "bounds", "periodic", "kinematic_types"):
        one, other = (getattr(file.metadata, name) for file in (first, second))
        if one != other:
            return f"their metadata differ in {name}: {one} and {other}"
    for index, (one, other) in enumerate(zip(first, second, strict=True)):
        steps = min(one.steps, other.steps)
        tensors: Mapping[str, tuple[NDArray[np.generic], NDArray[np.generic]]] = {
            "particle types": (one.particle_type, other.particle_type),
            "initial positions": (one.initial, other.initial),
            "true positions": (one.true[:steps], other.true[:steps]),
        }
        for name, pair in tensors.items():
            if not np.array_equal(*pair):
                return f"trajectory {index} ({one.name}, {other.name}) differs in its {name}"
    return None


def short_notes(measures: Sequence[Measures], marks: Sequence[int]) -> list[str]:
    """Which marks lie past the end of which rollouts."""
    return [
        f"no figure at step {', '.join(map(str, missed))} for {row.name}: its shortest rollout has "
        f"{row.horizon} steps"
        for row in measures
        if (missed := [mark for mark in marks if mark > row.horizon])
    ]


def divergence_notes(measures: Sequence[Measures], names: Sequence[str]) -> list[str]:
    """Which rollouts ended in positions that are not finite."""
    return [
        f"{row.name} diverged in trajectory {', '.join(diverged)}"
        for row in measures
        if (
            diverged := [
                name
                for name, mse in zip(names, row.scalars["mse"], strict=True)
                if not np.isfinite(mse)
            ]
        )
    ]


def gap_notes(measures: Sequence[Measures], names: Sequence[str]) -> list[str]:
    """Where a mean is not given, since a trajectory of a rollout that did not diverge lacks it."""
    reasons = {
        "clumping": "no true edges there",
        "transport": f"more than {MATCHED:,} particles to match",
    }
    notes = {}
    for row in measures:
        diverged = ~np.isfinite(row.scalars["mse"])
        for scalar, values in row.scalars.items():
            kind = scalar.partition("@")[0]
            without = ~np.isfinite(values) & ~diverged
            if kind in reasons and without.any():
                some = ", ".join(np.array(names)[without][:NAMED])
                more = int(without.sum()) - NAMED
                notes[scalar, some] = (
                    f"no mean {scalar}, for want of one of trajectory {some}"
                    f"{f' and {more} more' if more > 0 else ''}: {reasons[kind]}"
                )
    return list(notes.values())


def unit_notes(files: Sequence[RolloutFile]) -> list[str]:
    """A warning where normalized units differ between the files."""
    units = {
        (tuple(file.metadata.acceleration_std), file.settings.get("training", {}).get("noise"))
        for file in files
    }
    if len(units) == 1:
        return []
    return [
        "the models were trained with different statistics or noise, so that one-step MSE and "
        "calibration, which are in normalized units, can't be compared between them"
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command with ``argv``, or with the process's own arguments."""
    config = tyro.cli(EvaluateConfig, args=argv, prog="python -m adaptgns.evaluate")
    console = Console()
    out = config.rollouts[0].parent if config.out is None and config.rollouts else config.out
    with plain_errors():
        evaluate(config.rollouts, config.steps, out=out, console=console)
    assert out is not None  # without a file evaluate raises
    console.print(str(out / METRICS), highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
