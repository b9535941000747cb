"""The figures of a study's report: vector and PNG, a model in one colour and a policy in one dash
everywhere."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from adaptgns import figures
from adaptgns.figures import BASELINE, DASHES, MARKERS, STYLE, save
from adaptgns.graph import adaptive_graph
from adaptgns.palette import SERIES, SIGMA_MAP
from adaptgns.periodic import minimum_image
from adaptgns.reproduce.profiles import ADAPTIVE, Model
from adaptgns.reproduce.results import Results, Series
from adaptgns.reproduce.runs import DataSet
from adaptgns.reproduce.tables import matched, series_label

COLOURS = {
    "mse": SERIES[0],
    "nll": SERIES[1],
    "mlp": SERIES[5],
    "nll-adaptive": SERIES[2],
    "nll-narrow": "#7a8f00",
    "nll-two-sided": "#2f5fc9",
    "beta-nll": SERIES[3],
    "mse-denser": SERIES[4],
    "tuned": "#b0528f",
    "tuned-divergence": "#d98cc0",
    "decoupled": "#4f8f3a",
    "decoupled-weight": "#9bc53d",
    "decoupled-deep": "#1f4d2b",
    "decoupled-ahead": "#3fae8c",
    "nll-middle": "#e58f73",
    "mse-matched": "#7aa6d8",
    "mse-matched-decoupled": "#5b78b0",
}
FIGURE_3 = (("mse", "fixed"), ("nll", "fixed"), ("nll", "adaptive"), ("nll", "random"))
EXTRA_EDGE, BASE_EDGE = "#1fa774", "#c3cad3"
WIDTH = 6.6


def write(results: Results, folder: Path) -> list[Path]:
    """Write the figures into ``folder``; the PNG files, in the order of the report."""
    paths = []
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        for name, figure in _drawn(results):
            paths.append(next(p for p in save(figure, folder, name) if p.suffix == ".png"))
    return paths


def _drawn(results: Results) -> Iterator[tuple[str, Figure]]:
    sets = list(results.study.sets.values())
    yield "statistics", _statistics(sets)
    snapshots = {data.name: _snapshot(results, data) for data in sets}
    if all(snapshots.values()):
        yield "graphs", _graphs(results, snapshots)
        yield "sigma", _sigma(snapshots)
    yield "steps", _steps(results, sets)
    if results.long:
        yield "long", _long(results)
    yield "pareto", _pareto(results, sets)
    yield "reliability", _reliability(results, sets)
    yield "clouds", _clouds(results, sets)


def colour(model: Model) -> str:
    """Of that model, or of the one that it was trained longer or shorter than."""
    return COLOURS[re.sub(r"-\d+$", "", model.name)]


def _panels(count: int, height: float, rows: int = 1) -> tuple[Figure, Any]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, count, squeeze=False)


def _statistics(sets: list[DataSet]) -> Figure:
    """Table 2 along the time."""
    figure, ((edges, degree, clustering),) = _panels(3, 2.3)
    for data, tint in zip(sets, (SERIES[2], SERIES[3], SERIES[0], SERIES[1]), strict=False):
        described = data.described
        shortest = min(len(course) for course in described["evolution"])
        steps = described["evolution_every"] * np.arange(shortest)
        for ax, name in ((edges, "edges"), (degree, "degree"), (clustering, "clustering")):
            values = np.array(
                [[frame[name] for frame in course[:shortest]] for course in described["evolution"]]
            )
            mean, spread = values.mean(0), values.std(0)
            ax.plot(steps, mean, color=tint, label=data.name)
            ax.fill_between(steps, mean - spread, mean + spread, color=tint, alpha=0.2, lw=0)
    for ax, title in (
        (edges, "undirected edges"),
        (degree, "average degree"),
        (clustering, "average clustering"),
    ):
        ax.set(title=title, xlabel="step")
    figures.legend(figure, edges)
    return figure


def _snapshot(results: Results, data: DataSet) -> dict[str, NDArray[Any]] | None:
    """Frames of the adaptive rollout of the first seed."""
    series = results.find(data.name, "nll", "adaptive")
    if series is None:
        return None
    path = series.runs[0].metrics("adaptive").with_suffix(".npz")
    if not path.exists():
        return None
    with np.load(path) as file:
        return dict(file)


def _graphs(results: Results, snapshots: dict[str, Any]) -> Figure:
    """Figure 1: the graph, with the edges that uncertainty adds, at the last step kept."""
    figure, (panels,) = _panels(len(snapshots), 3.2)
    for ax, (name, frames) in zip(panels, snapshots.items(), strict=True):
        positions, sigma = frames["predicted"][-1], frames["sigma"][-1]
        box, mobile = frames["box"], frames["mobile"]
        period = box if np.isfinite(box).any() else None
        radius = results.study.sets[name].described["radius"]
        edges = adaptive_graph(
            positions,
            sigma,
            radius,
            ADAPTIVE.tau,
            ADAPTIVE.factor,
            box=period,
            eligible=mobile,
        )
        edges = edges[:, edges[0] < edges[1]]
        ends = positions[edges]  # [2, E, d]
        apart = minimum_image(ends[1] - ends[0], period)
        ends = np.stack([ends[0], ends[0] + apart])[..., :2]
        far = np.linalg.norm(apart, axis=1) > radius
        for chosen, tint, width in ((~far, BASE_EDGE, 0.35), (far, EXTRA_EDGE, 0.5)):
            lines = ends[:, chosen].transpose(1, 0, 2)
            ax.add_collection(LineCollection(list(lines), colors=tint, linewidths=width))
        order = np.argsort(sigma)
        ax.scatter(*positions[order, :2].T, c=sigma[order], s=2.5, cmap=SIGMA_MAP, zorder=3, lw=0)
        step = int(frames["steps"][-1])
        ax.set_title(f"{name}, step {step}: {int(far.sum()):,} of {len(far):,} edges are extra")
        _to_scale(ax)
    return figure


def _sigma(snapshots: dict[str, Any]) -> Figure:
    """Figure 2: where the model is unsure, at three steps."""
    figure, rows = _panels(3, 2.3 * len(snapshots), len(snapshots))
    for panels, (name, frames) in zip(rows, snapshots.items(), strict=True):
        shown = range(min(3, len(frames["steps"])))
        low, high = np.quantile(frames["sigma"][list(shown)], (0.02, 0.98))
        for ax, row in zip(panels, shown, strict=False):
            positions, sigma = frames["predicted"][row], frames["sigma"][row]
            order = np.argsort(sigma)
            ax.scatter(
                *positions[order, :2].T, c=sigma[order], s=2, cmap=SIGMA_MAP, vmin=low, vmax=high
            )
            ax.set_title(f"{name}, step {int(frames['steps'][row])}")
            _to_scale(ax)
        scale = ScalarMappable(Normalize(low, high), SIGMA_MAP)
        figure.colorbar(scale, ax=list(panels), label="σ, normalized", shrink=0.8)
    return figure


def _steps(results: Results, sets: list[DataSet]) -> Figure:
    """Figure 3: edges and error at every step."""
    figure, rows = _panels(2, 2.3 * len(sets), len(sets))
    for (edges, errors), data in zip(rows, sets, strict=True):
        for model, policy in FIGURE_3:
            series = results.find(data.name, model, policy)  # type: ignore[arg-type]
            if series is None:
                continue
            for ax, name in ((edges, "edges"), (errors, "mse")):
                curves = series.curve(name)
                _band(ax, curves, series)
        first = results.of(data.name)[0]
        true = first.curve("edges_within_radius_true").mean(0)
        edges.plot(np.arange(1, len(true) + 1), true, color=BASELINE, label="true positions")
        edges.set(title=f"{data.name}: directed edges of a step", xlabel="step")
        errors.set(title=f"{data.name}: position MSE, length²", xlabel="step", yscale="log")
    figures.legend(figure, rows[0][0])
    return figure


def _long(results: Results) -> Figure:
    """Error and clumping of the long rollouts at every step."""
    figure, rows = _panels(2, 2.3 * len(results.long), len(results.long))
    for (errors, ratios), (name, made) in zip(rows, results.long.items(), strict=True):
        for series in made:
            _band(errors, series.curve("mse"), series)
            predicted, true = (
                series.curve(f"edges_within_radius{which}") for which in ("", "_true")
            )
            _band(ratios, predicted / true, series)
        centre = results.study.sets[name].described_long["centroid_mse_mean"]
        steps = np.arange(1, len(centre) + 1)
        errors.plot(steps, centre, color=BASELINE, label="all particles at their true centre")
        ratios.axhline(1.0, color=BASELINE)
        errors.set(title=f"{name}: position MSE, length²", xlabel="step", yscale="log")
        ratios.set(title=f"{name}: edges within r, predicted over true", xlabel="step")
    figures.legend(figure, rows[0][0])
    return figure


def _band(ax: Axes, curves: NDArray[np.float64], series: Series) -> None:
    """The mean over the seeds, and from the lowest to the highest."""
    steps = np.arange(1, curves.shape[1] + 1)
    tint = colour(series.model)
    ax.plot(
        steps,
        curves.mean(0),
        color=tint,
        linestyle=DASHES[series.policy],
        label=series_label(series),
    )
    ax.fill_between(steps, curves.min(0), curves.max(0), color=tint, alpha=0.12, lw=0)


def _pareto(results: Results, sets: list[DataSet]) -> Figure:
    mark = results.study.last_mark
    figure, rows = _panels(2, 2.6 * len(sets), len(sets))
    models: dict[str, dict[str, Any]] = {}
    trainings: dict[str, dict[str, Any]] = {}
    policies: dict[str, dict[str, Any]] = {}
    for panels, data in zip(rows, sets, strict=True):
        for ax, unit in zip(panels, ("directed edges a step", "milliseconds a step"), strict=True):
            means: list[tuple[float, float]] = []
            for series in results.alike(data.name):
                model = series.model
                if not model.edges or not model.prominent:
                    continue
                error = series.estimate(f"mse@{mark}")
                cost = series.scalar("edges_per_step").mean()
                if unit.startswith("milli"):
                    time = data.step_time(model, series.policy)
                    if time["elsewhere"]:
                        continue
                    cost = time["graph_ms"] + time["model_ms"]
                means.append((cost, error.mean))
                tint = colour(model)
                # Hollow, and the larger the longer they were trained, are those trained for longer.
                trained = {
                    "markerfacecolor": "none" if model.share > 1 else tint,
                    "markersize": 4 + 2 * model.share**0.5,
                }
                ax.plot(cost, error.mean, MARKERS[series.policy], color=tint, zorder=3, **trained)
                ax.vlines(cost, error.low, error.high, color=tint, lw=0.6, alpha=0.4)
                if model.length:
                    trainings[model.length] = {"color": BASELINE, **trained}
                models[model.plain] = {"color": tint}
                policies[series.policy] = {"color": BASELINE, "marker": MARKERS[series.policy]}
            ax.step(*pareto_front(means).T, where="post", color=BASELINE, lw=1.2)
            ax.set(title=f"{data.name}: MSE@{mark}, length²", xlabel=unit, yscale="log")
            ax.margins(0.15)
    for label, style in (models | policies | trainings).items():
        rows[0][0].plot([], [], linestyle="none", label=label, **{"marker": "o", **style})
    figures.legend(figure, rows[0][0])
    return figure


def pareto_front(points: list[tuple[float, float]]) -> NDArray[np.float64]:
    """``[F, 2]``, by cost: those of the ``points`` of cost and error that no other undercuts in one
    without exceeding it in the other; what is not finite is none."""
    front: list[tuple[float, float]] = []
    for point in sorted({point for point in points if np.isfinite(point).all()}):
        if not front or point[1] < front[-1][1]:
            front.append(point)
    return np.array(front, dtype=np.float64).reshape(-1, 2)


def _reliability(results: Results, sets: list[DataSet]) -> Figure:
    figure, (panels,) = _panels(len(sets), 3.2)
    for ax, data in zip(panels, sets, strict=True):
        ends: list[float] = []
        for series in results.of(data.name):
            if series.policy != "fixed":
                continue
            predicted, measured = (series.calibration(n) for n in ("predicted", "squared_error"))
            for seed, (one, other) in enumerate(zip(predicted, measured, strict=True)):
                ax.plot(
                    one,
                    other,
                    color=colour(series.model),
                    alpha=min(1.0, 0.4 + 0.6 * series.model.share),
                    linestyle="-" if series.model.share == 1 else ":",
                    linewidth=max(1.0, 0.7 * series.model.share**0.5),
                    marker="o",
                    markersize=2.5,
                    label=series.model.title if seed == 0 else None,
                )
                ends += [*one, *other]
        if ends:
            line = [min(ends), max(ends)]
            ax.plot(line, line, color=BASELINE, lw=0.8, label="calibrated")
        ax.set(
            title=f"{data.name}: squared error, deciles of σ",
            xlabel="predicted, d·σ², normalized²",
            ylabel="measured, normalized²",
            xscale="log",
            yscale="log",
        )
    figures.legend(figure, panels[0])
    return figure


def _clouds(results: Results, sets: list[DataSet]) -> Figure:
    """Kinetic energy along the rollout, and the distance between the clouds at the marks."""
    marks = results.study.profile.marks
    figure, rows = _panels(2, 2.3 * len(sets), len(sets))
    for (energy, transport), data in zip(rows, sets, strict=True):
        for model, policy in FIGURE_3:
            series = results.find(data.name, model, policy)  # type: ignore[arg-type]
            if series is None:
                continue
            _band(energy, series.curve("kinetic_energy"), series)
            values = [matched(series, mark).mean for mark in marks]
            transport.plot(
                marks,
                values,
                color=colour(series.model),
                linestyle=DASHES[policy],
                marker=MARKERS[policy],
                markersize=3,
            )
        true = results.of(data.name)[0].curve("kinetic_energy_true").mean(0)
        energy.plot(np.arange(1, len(true) + 1), true, color=BASELINE, label="truth")
        energy.set(title=f"{data.name}: kinetic energy per mass, (length/time)²", xlabel="step")
        transport.set(title=f"{data.name}: transport cost, length²", xlabel="step", yscale="log")
    figures.legend(figure, rows[0][0])
    return figure


def _to_scale(ax: Axes) -> None:
    ax.set_aspect("equal", "datalim")
    ax.set(xticks=[], yticks=[])
    for side in ax.spines.values():
        side.set_visible(False)
