"""What was measured of a set of rollouts: as JSON, and as tables for a terminal."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from adaptgns.atomic import json_types, replace_text
from adaptgns.graph_statistics import GraphStatistics
from adaptgns.metrics import Calibration

FORMAT = "adaptgns-metrics"
VERSION = 1


@dataclass(frozen=True)
class Measures:
    """The measures of one way of predicting: a rollout file, or a baseline."""

    label: str
    """Name of the model"""
    policy: str
    """Which graph it had; empty for a baseline"""
    scalars: Mapping[str, NDArray[np.float64]]
    """``[trajectories]`` values; the reported figure is their mean"""
    curves: Mapping[str, NDArray[np.float64]]
    """``[K]`` values per step, means over the trajectories, up to the shortest one's last step"""
    horizon: int
    """K, steps that every trajectory has"""
    spearman: float | None = None
    """Rank correlation of sigma and error, pooled over all particles"""
    calibration: Calibration | None = None
    """By deciles, pooled over all particles"""
    statistics: Sequence[GraphStatistics] = ()
    """Of the radius graph on predicted positions, one a trajectory"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What was run"""
    file: str | None = None

    def mean(self, scalar: str) -> float | None:
        """Mean over the trajectories; None where it was not measured."""
        values = self.scalars.get(scalar)
        return None if values is None else float(np.mean(values))

    @property
    def name(self) -> str:
        """Label and policy in one."""
        return f"{self.label}, {self.policy}" if self.policy else self.label


@dataclass(frozen=True)
class Report:
    """Everything that was measured on one set of trajectories."""

    marks: Sequence[int]
    """Steps at which errors are reported"""
    trajectories: Sequence[str]
    rollouts: Sequence[Measures]
    baselines: Sequence[Measures]
    statistics_step: int
    """Step whose graph statistics are reported"""
    true_statistics: Sequence[GraphStatistics]
    """Of the radius graph on true positions, one a trajectory"""
    notes: Sequence[str]
    """What a reader of the figures must know"""

    def to_json(self) -> dict[str, Any]:
        """As JSON types; what is not a finite number is null."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "marks": list(self.marks),
            "trajectories": list(self.trajectories),
            "notes": list(self.notes),
            "rollouts": [_measures_json(measures) for measures in self.rollouts],
            "baselines": [_measures_json(measures) for measures in self.baselines],
            "graph_statistics": {
                "step": self.statistics_step,
                "true": _statistics_json(self.true_statistics),
            },
        }
        result: dict[str, Any] = json_types(content)
        return result

    def write(self, path: Path) -> None:
        """Write :meth:`to_json` to ``path``, whole or not at all."""
        content = json.dumps(self.to_json(), indent=1, allow_nan=False)
        replace_text(path, content + "\n")

    def print(self, console: Console) -> None:
        """Print the tables. One too wide for ``console`` is cut into several below each other,
        never a number."""
        count = len(self.trajectories)
        title = f"Means over {count} {'trajectory' if count == 1 else 'trajectories'}"
        _print_columns(console, title, *self._columns())
        for measures in self.rollouts:
            if measures.calibration is not None:
                _print_calibration(console, measures.name, measures.calibration)
        if self.true_statistics:
            title = f"Undirected radius graph at step {self.statistics_step}, mean ± std"
            _print_columns(console, title, *self._statistics_columns())
        for note in self.notes:
            console.print(_encodable(console, f"note: {note}"), markup=False, highlight=False)

    def _columns(self) -> tuple[list[Column], list[Column]]:
        """The identifying columns, and the measured ones."""
        rows = [*self.rollouts, *self.baselines]

        def scalar(heading: str, name: str, spec: str) -> Column:
            return Column(heading, [_number(row.mean(name), spec) for row in rows])

        keys = [
            Column("model", [row.label for row in rows], "left"),
            Column("graph", [row.policy or MISSING for row in rows], "left"),
        ]
        measured = [
            *(scalar(f"MSE@{mark}", f"mse@{mark}", ".2e") for mark in self.marks),
            scalar("one-step\nMSE", "one_step_mse", ".3g"),
            Column("Spearman", [_number(row.spearman, ".3f") for row in rows]),
            scalar("edges\n/step", "edges_per_step", ",.0f"),
            *(scalar(f"clumping\n@{mark}", f"clumping@{mark}", ".2f") for mark in self.marks),
            scalar(f"transport\n@{self.marks[-1]}", f"transport@{self.marks[-1]}", ".2e"),
            scalar("kinetic\nerror", "kinetic_energy_error", ".3g"),
            scalar("graph\nms", "graph_ms", ".2f"),
            scalar("model\nms", "model_ms", ".2f"),
        ]
        return keys, measured

    def _statistics_columns(self) -> tuple[list[Column], list[Column]]:
        rows = [("truth", self.true_statistics)]
        rows += [(row.name, row.statistics) for row in self.rollouts if row.statistics]
        spec = {"nodes": ".0f", "edges": ".0f", "density": ".2e", "degree": ".2f"}

        def cell(statistics: Sequence[GraphStatistics], name: str) -> str:
            values = [float(getattr(each, name)) for each in statistics]
            form = spec.get(name, ".3f")
            return (
                f"{_number(float(np.mean(values)), form)} ± {_number(float(np.std(values)), form)}"
            )

        names = ("nodes", "edges", "density", "degree", "clustering")
        return (
            [Column("positions", [name for name, _ in rows], "left")],
            [Column(name, [cell(each, name) for _, each in rows]) for name in names],
        )


MISSING = "–"


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    heading: str
    cells: Sequence[str]
    justify: str = "right"


def _number(value: float | None, spec: str) -> str:
    return MISSING if value is None or not np.isfinite(value) else format(value, spec)


def _print_columns(
    console: Console, title: str, keys: Sequence[Column], columns: Sequence[Column]
) -> None:
    """Print one table, or, where it is wider than ``console``, several that repeat ``keys``."""
    rest = list(columns)
    while rest:
        for fitting in range(len(rest), 0, -1):
            table = _table(console, title, [*keys, *rest[:fitting]])
            # Rich would shorten the cells of a table that is wider than the console; one of a given
            # width keeps them.
            unlimited = console.options.update(width=1 << 16)
            table.width = Measurement.get(console, unlimited, table).maximum
            if table.width <= console.width:
                break
        console.print(table, crop=False)
        title, rest = "", rest[fitting:]


def _table(console: Console, title: str, columns: Sequence[Column]) -> Table:
    table = Table(
        title=_encodable(console, title) or None,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 0, 0, 1),
        pad_edge=False,
    )
    for column in columns:
        justify: Any = column.justify
        table.add_column(_encodable(console, column.heading), justify=justify, no_wrap=True)
    for cells in zip(*(column.cells for column in columns), strict=True):
        table.add_row(*(_encodable(console, cell) for cell in cells))
    return table


def _encodable(console: Console, text: str) -> str:
    """``text``, in ASCII where the console's stream knows nothing else."""
    if not console.options.ascii_only:
        return text
    signs = str.maketrans({"–": "-", "±": "+/-", "·": "*", "σ": "sigma", "Δ": "D", "²": "^2"})
    return text.translate(signs).encode("ascii", "replace").decode()


def _print_calibration(console: Console, name: str, calibration: Calibration) -> None:
    """The table of deciles, as table 3 of the paper has it."""
    rows = list(zip(calibration.squared_error, calibration.predicted, calibration.gap, strict=True))
    columns = [
        Column("decile", [*map(str, range(len(rows))), "ECE"]),
        Column("mean SE", [*(f"{row[0]:.4g}" for row in rows), ""]),
        Column("d·σ²", [*(f"{row[1]:.4g}" for row in rows), ""]),
        Column("|Δ|", [*(f"{row[2]:.4g}" for row in rows), f"{calibration.ece:.4g}"]),
    ]
    _print_columns(console, f"Calibration: {name}", columns[:1], columns[1:])


def _measures_json(measures: Measures) -> dict[str, Any]:
    calibration = measures.calibration
    return {
        "file": measures.file,
        "label": measures.label,
        "policy": measures.policy or None,
        "settings": dict(measures.settings),
        "horizon": measures.horizon,
        "scalars": {
            name: {"mean": measures.mean(name), "per_trajectory": values}
            for name, values in measures.scalars.items()
        },
        "spearman": measures.spearman,
        "calibration": None
        if calibration is None
        else {
            "squared_error": calibration.squared_error,
            "predicted": calibration.predicted,
            "gap": calibration.gap,
            "ece": calibration.ece,
        },
        "graph_statistics": _statistics_json(measures.statistics),
        "curves": dict(measures.curves),
    }


def _statistics_json(statistics: Sequence[GraphStatistics]) -> list[dict[str, Any]]:
    return [asdict(each) for each in statistics]
