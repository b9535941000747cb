"""What a run folder tells of a run: its training log and its report."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptgns.atomic import read_json
from adaptgns.report import FORMAT, VERSION

LOG, REPORT = "metrics.jsonl", "metrics.json"


@dataclass(frozen=True)
class Evaluated:
    """One way of predicting that a report measured: a row of its table."""

    run: str
    """Name of the run's folder"""
    content: dict[str, Any]

    @property
    def label(self) -> str:
        """Name of the model, or of the baseline."""
        return str(self.content["label"])

    @property
    def policy(self) -> str:
        """Which graph it had; empty for a baseline."""
        return self.content["policy"] or ""

    @property
    def rule(self) -> str:
        """The policy's name, without the radius that follows where it is not that of training."""
        return self.policy.partition(",")[0]

    @property
    def radius(self) -> str:
        """That radius, as told; empty where it is that of training."""
        return self.policy.partition(",")[2]

    def curve(self, name: str) -> NDArray[np.float64]:
        """``[K]`` values per step, NaN where they are not finite; empty where not measured."""
        return np.array(self.content["curves"].get(name, []), dtype=np.float64)

    def scalar(self, name: str) -> NDArray[np.float64]:
        """``[trajectories]`` values, NaN where they are not finite; empty where not measured."""
        values = self.content["scalars"].get(name, {"per_trajectory": []})["per_trajectory"]
        return np.array(values, dtype=np.float64)

    @property
    def calibration(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """``[bins]`` predicted and measured squared errors, normalized units²; None without."""
        found = self.content["calibration"]
        if found is None:
            return None
        predicted, measured = (np.array(found[k], float) for k in ("predicted", "squared_error"))
        return predicted, measured


@dataclass(frozen=True)
class RunFolder:
    """A folder that ``train`` or ``evaluate`` wrote."""

    name: str
    log: list[dict[str, Any]]
    """Lines of the training log; none where there is no such file"""
    rollouts: list[Evaluated]
    baselines: list[Evaluated]

    @classmethod
    def read(cls, folder: Path) -> RunFolder:
        """Read ``folder``.

        FileNotFoundError where it holds neither a log nor a report, ValueError where one of them
        is not what it should be.
        """
        log, report = folder / LOG, folder / REPORT
        if not (log.is_file() or report.is_file()):
            raise FileNotFoundError(
                f"run {folder}: holds neither {LOG} nor {REPORT}; a folder that train or evaluate "
                "wrote is accepted"
            )
        name = folder.resolve().name
        content = _read_report(report) if report.is_file() else {"rollouts": [], "baselines": []}
        return cls(
            name=name,
            log=read_log(log) if log.is_file() else [],
            rollouts=[Evaluated(name, row) for row in content["rollouts"]],
            baselines=[Evaluated(name, row) for row in content["baselines"]],
        )

    def logged(self, key: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Training steps at which ``key`` was logged, and its values, NaN where not finite."""
        lines = [line for line in self.log if key in line]
        steps = np.array([line["step"] for line in lines], dtype=np.int64)
        return steps, np.array([line[key] for line in lines], dtype=np.float64)


def read_log(path: Path) -> list[dict[str, Any]]:
    """The lines of a training log; ValueError, with its number, where one is none."""
    lines = path.read_text("utf-8").splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        lines.pop()  # A killed run may leave half a line.
    content = []
    for number, line in enumerate(lines, start=1):
        try:
            values = json.loads(line)
        except ValueError:
            values = None
        if not (isinstance(values, dict) and isinstance(values.get("step"), int)):
            raise ValueError(f"{path}: line {number} is no JSON object with a step: {line[:60]!r}")
        content.append(values)
    return content


def _read_report(path: Path) -> dict[str, Any]:
    content = read_json(path)
    form = (content.get("format"), content.get("version")) if isinstance(content, dict) else None
    if form != (FORMAT, VERSION):
        raise ValueError(
            f"{path}: its format and version are {form}; accepted are {(FORMAT, VERSION)}, which "
            "evaluate writes"
        )
    report: dict[str, Any] = content
    return report
