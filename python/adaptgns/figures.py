"""Figures of runs for a page: training, errors and edges per step, calibration, Pareto.

A run has one colour in all of them, and a policy one dash and one marker, so that they can be told
apart in grey.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from adaptgns.atomic import written_whole
from adaptgns.palette import SERIES
from adaptgns.run_folder import Evaluated, RunFolder

FORMATS = ("png", "pdf")
WIDTH, HEIGHT, DPI = 6.4, 2.6, 200
STYLE = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "pdf.fonttype": 42,  # text stays text
}
DASHES = {
    "fixed": "-",
    "adaptive": "--",
    "two-sided": (0, (6, 1, 1, 1)),
    "two-pass": "-.",
    "base-sigma": (0, (4, 1, 1, 1, 1, 1)),
    "random": ":",
    "acceleration": (0, (3, 1)),
    "divergence": (0, (8, 2)),
    "knn": (0, (1, 3)),
}
MARKERS = {
    "fixed": "o",
    "adaptive": "s",
    "two-sided": "P",
    "two-pass": "^",
    "base-sigma": ">",
    "random": "x",
    "acceleration": "v",
    "divergence": "<",
    "knn": "D",
}
BASELINE = "#9aa3ad"
TRAINING = {
    "loss": "training loss",
    "valid_one_step_mse": "validation, one step",
    "valid_rollout_mse": "validation, rollout",
}


class Figures:
    """The figures of ``runs``, in the order in which they were named."""

    def __init__(self, runs: Sequence[RunFolder]) -> None:
        self._runs = runs
        self._rollouts = [rollout for run in runs for rollout in run.rollouts]
        self._names = _distinct_names(self._rollouts)

    def write(self, folder: Path) -> list[Path]:
        """Write those that the runs have the figures for, as PNG and PDF, and tell their paths.

        Each file is written whole or not at all.
        """
        with mpl.rc_context(STYLE):  # type: ignore[arg-type]
            return [path for name, figure in self._drawn() for path in save(figure, folder, name)]

    def _drawn(self) -> Iterator[tuple[str, Figure]]:
        if any(run.log for run in self._runs):
            yield "training", self._training()
        if self._rollouts:
            yield "steps", self._steps()
            yield "pareto", self._pareto()
        if any(rollout.calibration is not None for rollout in self._rollouts):
            yield "calibration", self._calibration()

    def _training(self) -> Figure:
        figure, axes = _figure(len(TRAINING))
        for run, colour in zip(self._runs, self._colours(), strict=True):
            for ax, key in zip(axes, TRAINING, strict=True):
                steps, values = run.logged(key)
                marker = "o" if len(steps) < 30 else None
                ax.plot(steps, values, color=colour, label=run.name, marker=marker, markersize=2.5)
        for ax, (key, title) in zip(axes, TRAINING.items(), strict=True):
            ax.set(title=title, xlabel="training step")
            if key != "loss":  # which may be below 0
                _logarithmic(ax)
        axes[1].set_ylabel("MSE, normalized units²")
        axes[2].set_ylabel("MSE, length²")
        legend(figure, axes[0])
        return figure

    def _steps(self) -> Figure:
        figure, (errors, edges) = _figure(2)
        for rollout, name in zip(self._rollouts, self._names, strict=True):
            style: dict[str, Any] = {
                "color": self._colour(rollout),
                "linestyle": DASHES.get(rollout.rule, "-"),
            }
            for ax, key in ((errors, "mse"), (edges, "edges")):
                curve = rollout.curve(key)
                ax.plot(np.arange(1, len(curve) + 1), curve, label=name, **style)
        for baseline, dash in zip(self._runs[0].baselines, (":", (0, (1, 3)), "-."), strict=False):
            curve = baseline.curve("mse")
            steps = np.arange(1, len(curve) + 1)
            errors.plot(steps, curve, color=BASELINE, linestyle=dash, label=baseline.label)
        errors.set(title="position MSE, length²", xlabel="step")
        _logarithmic(errors)
        edges.set(title="directed edges of a step", xlabel="step")
        edges.set_ylim(bottom=0)
        legend(figure, errors)
        return figure

    def _calibration(self) -> Figure:
        figure, (axes,) = _figure(1, width=3.4, height=3.4)
        ends = []
        for rollout, name in zip(self._rollouts, self._names, strict=True):
            if rollout.calibration is None:
                continue
            predicted, measured = rollout.calibration
            ends += [*predicted, *measured]
            axes.plot(
                predicted,
                measured,
                color=self._colour(rollout),
                linestyle=DASHES.get(rollout.rule, "-"),
                marker=MARKERS.get(rollout.rule, "o"),
                markersize=3.5,
                label=name,
            )
        low, high = np.nanmin(ends), np.nanmax(ends)
        axes.plot([low, high], [low, high], color=BASELINE, linewidth=0.8, label="calibrated")
        axes.set(
            xscale="log",
            yscale="log",
            aspect="equal",
            title="squared error, deciles of σ",
            xlabel="predicted, d·σ², normalized units²",
            ylabel="measured, normalized units²",
        )
        legend(figure, axes)
        return figure

    def _pareto(self) -> Figure:
        """What accuracy costs: in edges, and in time."""
        figure, panels = _figure(2)
        for rollout, name in zip(self._rollouts, self._names, strict=True):
            mse = rollout.scalar("mse")
            error = np.std(mse, ddof=1) / np.sqrt(len(mse)) if len(mse) > 1 else 0.0
            milliseconds = rollout.scalar("graph_ms") + rollout.scalar("model_ms")
            for axes, cost in zip(
                panels, (rollout.scalar("edges_per_step"), milliseconds), strict=True
            ):
                axes.errorbar(
                    cost.mean(),
                    mse.mean(),
                    yerr=error,
                    color=self._colour(rollout),
                    marker=MARKERS.get(rollout.rule, "o"),
                    linestyle="none",
                    capsize=2,
                    label=name,
                )
        panels[0].set(xlabel="directed edges of a step", title="position MSE, length²: mean ± s.e.")
        panels[1].set(xlabel="milliseconds of a step, graph and model")
        for axes in panels:
            axes.margins(0.25)
            _logarithmic(axes)
        legend(figure, panels[0])
        return figure

    def _colours(self) -> list[str]:
        return [SERIES[index % len(SERIES)] for index in range(len(self._runs))]

    def _colour(self, rollout: Evaluated) -> str:
        """That of its run; in a report of several models, one a model and radius."""
        if len(self._runs) > 1:
            return self._colours()[[run.name for run in self._runs].index(rollout.run)]
        models = list(dict.fromkeys((other.label, other.radius) for other in self._rollouts))
        return SERIES[models.index((rollout.label, rollout.radius)) % len(SERIES)]


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write ``figure`` as PNG and PDF into ``folder``, each whole or not at all."""
    paths = []
    for form in FORMATS:
        path = folder / f"{name}.{form}"
        # No date in the file: the same runs give the same bytes.
        metadata = {"CreationDate": None} if form == "pdf" else None
        with written_whole(path) as partial:
            figure.savefig(partial, format=form, dpi=DPI, metadata=metadata)
        paths.append(path)
    return paths


def write_figures(runs: Sequence[Path], folder: Path) -> list[Path]:
    """Write the figures of the run folders ``runs`` into ``folder``, and tell their paths.

    A figure is left out where no run has what it shows. ValueError for no run, or two folders of
    one name, which could not be told apart; see also :meth:`RunFolder.read`.
    """
    read = [RunFolder.read(run) for run in runs]
    names = [run.name for run in read]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"runs: got {names}; one or more folders of different names are accepted")
    paths = Figures(read).write(folder)
    if not paths:
        raise ValueError(f"runs: {names} hold an empty log and no report, which nothing shows")
    return paths


def _distinct_names(rollouts: Sequence[Evaluated]) -> list[str]:
    """The shortest form that tells them apart."""
    forms = [
        [f"{rollout.label}, {rollout.policy}" for rollout in rollouts],
        [f"{rollout.run}, {rollout.policy}" for rollout in rollouts],
        [f"{rollout.run}: {rollout.label}, {rollout.policy}" for rollout in rollouts],
    ]
    return next((names for names in forms if len(set(names)) == len(names)), forms[-1])


def _figure(panels: int, width: float = WIDTH, height: float = HEIGHT) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(1, panels, squeeze=False)[0])


def _logarithmic(axes: Axes) -> None:
    """A logarithmic scale, where something on it is above 0."""
    values = [np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.get_lines()]
    if any((value > 0).any() for value in values):
        axes.set_yscale("log")


def legend(figure: Figure, axes: Axes) -> None:
    """A legend below the panels, with what ``axes`` show; what is more than two lines of it makes
    the figure taller."""
    handles, labels = axes.get_legend_handles_labels()
    columns = max(1, int(figure.get_figwidth() // (0.45 + 0.06 * max(map(len, labels)))))
    lines = -(-len(labels) // columns)
    figure.set_figheight(figure.get_figheight() + 0.17 * max(0, lines - 2))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)
