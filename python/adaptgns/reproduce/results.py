"""What the runs of a study say together: means, intervals and differences.

Intervals hold 95 % of the means of resampled seeds and trajectories (a bootstrap that draws both
with replacement, crossed, since every seed is measured on the same trajectories). Differences are
paired: by trajectory, and by seed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptgns.config import PolicyName
from adaptgns.reproduce.profiles import Model
from adaptgns.reproduce.runs import DataSet, Run, Study, StudyError

RESAMPLES = 10_000
LEVEL = 0.95


@dataclass(frozen=True)
class Estimate:
    """A mean with its interval."""

    mean: float
    low: float
    high: float

    @property
    def shown(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low > 0 or self.high < 0


def estimate(values: NDArray[np.float64]) -> Estimate:
    """Of the mean of ``values`` ``[seeds, trajectories]``; NaN where one is not finite."""
    if not np.isfinite(values).all():
        return Estimate(np.nan, np.nan, np.nan)
    rng = np.random.default_rng(0)
    seeds, trajectories = values.shape
    # The mean over a resample is a sum weighted by how often each seed and trajectory was drawn.
    by_seed = rng.multinomial(seeds, np.full(seeds, 1 / seeds), RESAMPLES) / seeds
    by_trajectory = (
        rng.multinomial(trajectories, np.full(trajectories, 1 / trajectories), RESAMPLES)
        / trajectories
    )
    means = np.einsum("rs,st,rt->r", by_seed, values, by_trajectory)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(float(values.mean()), float(low), float(high))


@dataclass(frozen=True)
class Series:
    """One model under one policy on one data set, over all seeds."""

    model: Model
    policy: PolicyName
    runs: tuple[Run, ...]

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """What was measured, a row a seed; StudyError where a run is missing or another one."""
        rows = [run.read(self.policy) for run in self.runs]
        counts = {len(row["scalars"]["mse"]["per_trajectory"]) for row in rows}
        if len(counts) > 1:
            raise StudyError(f"{self.files}: numbers of trajectories differ, {sorted(counts)}")
        return rows

    @property
    def files(self) -> list[str]:
        """The metrics that everything here comes from, below the study's folder."""
        return [
            str(run.metrics(self.policy).relative_to(run.study.out).as_posix()) for run in self.runs
        ]

    def scalar(self, name: str) -> NDArray[np.float64]:
        """``[seeds, trajectories]`` values, NaN where not finite or not measured."""
        missing = {"per_trajectory": [None] * len(self.rows[0]["scalars"]["mse"]["per_trajectory"])}
        values = [row["scalars"].get(name, missing)["per_trajectory"] for row in self.rows]
        return np.array(values, dtype=np.float64)

    def curve(self, name: str) -> NDArray[np.float64]:
        """``[seeds, K]`` values per step, means over trajectories."""
        curves = [np.array(row["curves"][name], dtype=np.float64) for row in self.rows]
        shortest = min(map(len, curves))
        return np.stack([curve[:shortest] for curve in curves])

    def estimate(self, name: str) -> Estimate:
        """Of the mean of a scalar."""
        return estimate(self.scalar(name))

    def calibration(self, name: str) -> NDArray[np.float64]:
        """``[seeds, deciles]`` of ``squared_error``, ``predicted`` or ``gap``; empty without a
        variance."""
        return np.array(
            [row["calibration"][name] for row in self.rows if row["calibration"]], np.float64
        )


@dataclass(frozen=True)
class Results:
    """All that a study has measured."""

    study: Study

    @cached_property
    def series(self) -> dict[tuple[str, str, PolicyName], Series]:
        """By data set, model and policy, in the order of the profile."""
        return {
            (data.name, model.name, policy): self._series(data, model, policy)
            for data in self.study.sets.values()
            for model in self.study.profile.models
            for policy in model.policies
        }

    def _series(self, data: DataSet, model: Model, policy: PolicyName) -> Series:
        runs = tuple(Run(data, model, seed) for seed in self.study.profile.seeds)
        return Series(model, policy, runs)

    def of(self, data: str) -> list[Series]:
        """Those of one data set."""
        return [series for (name, _, _), series in self.series.items() if name == data]

    def find(self, data: str, model: str, policy: PolicyName) -> Series | None:
        """One of them; None where the profile has none."""
        return self.series.get((data, model, policy))

    def difference(self, one: Series, other: Series, scalar: str) -> Estimate:
        """``one`` less ``other``, paired."""
        return estimate(one.scalar(scalar) - other.scalar(scalar))
