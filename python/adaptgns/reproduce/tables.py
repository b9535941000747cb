"""The tables of a study's report, each row with the metrics that it comes from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adaptgns.config import PolicyName
from adaptgns.evaluate import MATCHED
from adaptgns.reproduce.profiles import Chosen, Model
from adaptgns.reproduce.results import Estimate, Results, Series, estimate
from adaptgns.reproduce.runs import EVERY, DataSet, read_json
from adaptgns.sweep import RESULT

MISSING = "–"
PAPER_STATISTICS = {
    "waterdrop": ("567 ± 200", "1,550 ± 583", "1.08e-02", "5.42 ± 0.22", "0.494 ± 0.036"),
    "sand": ("1,270 ± 503", "4,324 ± 1,864", "7.35e-03", "6.76 ± 1.01", "0.500 ± 0.034"),
}
PAPER_RESULTS = {
    "sand": {
        "MLP": ("N/A", "0.121"),
        "MSE, r 0.015": ("18,682", "0.0434"),
        "MSE, r 0.0176": ("23,498", "0.0355"),
        "MSE, r 0.019": ("25,516", "0.0285"),
        "NLL, r 0.015": ("28,968", "0.0417"),
        "NLL, r 0.0176": ("28,768", "0.0422"),
        "AdaptGNS": ("22,958", "0.0382"),
    },
    "waterdrop": {
        "MLP": ("N/A", "0.207"),
        "MSE, r 0.015": ("9,741", "0.0414"),
        "MSE, r 0.019": ("12,212", "0.0388"),
        "NLL, r 0.015": ("7,875", "0.0417"),
        "AdaptGNS": ("7,821", "0.0412"),
    },
}
"""Edges per step and MSE@200, measured on other data"""

ELSEWHERE = "†"
"""Stands at what another processor took"""

Comparison = tuple[str, tuple[str, PolicyName], tuple[str, PolicyName]]


def _longer(percent: int) -> tuple[Comparison, ...]:
    """Those among models that are trained for so many percent of the steps."""
    mse, nll, tuned = (f"{name}-{percent}" for name in ("mse", "nll", "tuned"))
    questions: tuple[Comparison, ...] = (
        ("adaptive or fixed", (nll, "adaptive"), (nll, "fixed")),
        ("uncertain or random", (nll, "adaptive"), (nll, "random")),
        ("random or fixed", (nll, "random"), (nll, "fixed")),
        ("two-sided or fixed", (nll, "two-sided"), (nll, "fixed")),
        ("two-pass or fixed", (nll, "two-pass"), (nll, "fixed")),
        ("k nearest or all within r", (nll, "knn"), (nll, "fixed")),
        ("lag and feedback: adaptive or two-pass", (nll, "adaptive"), (nll, "two-pass")),
        ("feedback: sigma on the adaptive or base graph", (nll, "adaptive"), (nll, "base-sigma")),
        ("lag: sigma on the base graph, before or now", (nll, "base-sigma"), (nll, "two-pass")),
        ("by sigma on the base graph, or fixed", (nll, "base-sigma"), (nll, "fixed")),
        ("by sigma on the base graph, or random", (nll, "base-sigma"), (nll, "random")),
        ("sigma or the divergence around", (nll, "adaptive"), (nll, "divergence")),
        ("the divergence around or fixed", (nll, "divergence"), (nll, "fixed")),
        ("the last acceleration or fixed", (nll, "acceleration"), (nll, "fixed")),
        ("adaptive NLL or fixed MSE: the aim", (nll, "adaptive"), (mse, "fixed")),
        ("the chosen rule or fixed MSE: the aim", (tuned, "adaptive"), (mse, "fixed")),
        ("the chosen rule or fixed, same model", (tuned, "adaptive"), (nll, "fixed")),
        ("the chosen rule, uncertain or random", (tuned, "adaptive"), (tuned, "random")),
        ("two-sided NLL or fixed MSE: the aim", (nll, "two-sided"), (mse, "fixed")),
        ("the divergence around, NLL, or fixed MSE", (nll, "divergence"), (mse, "fixed")),
        ("NLL or MSE, fixed graphs", (nll, "fixed"), (mse, "fixed")),
        ("the divergence around or fixed, MSE", (mse, "divergence"), (mse, "fixed")),
    )
    return tuple(
        (f"{question}, {percent // 100} times the training", one, other)
        for question, one, other in questions
    )


COMPARISONS: tuple[Comparison, ...] = (
    ("adaptive or fixed graph, same model", ("nll", "adaptive"), ("nll", "fixed")),
    ("uncertain or random particles expanded", ("nll", "adaptive"), ("nll", "random")),
    *_longer(400),
    (
        "the divergence's chosen rule or fixed MSE: the aim, 4 times the training",
        ("tuned-divergence-400", "divergence"),
        ("mse-400", "fixed"),
    ),
    (
        "the divergence's chosen rule or fixed, same model, 4 times the training",
        ("tuned-divergence-400", "divergence"),
        ("nll-400", "fixed"),
    ),
    *_longer(800),
    ("4 times the training or once, NLL", ("nll-400", "fixed"), ("nll", "fixed")),
    ("4 times the training or once, MSE", ("mse-400", "fixed"), ("mse", "fixed")),
    ("8 times the training or 4 times, NLL", ("nll-800", "fixed"), ("nll-400", "fixed")),
    ("8 times the training or 4 times, MSE", ("mse-800", "fixed"), ("mse-400", "fixed")),
    (
        "trained on adaptive graphs of r 0.01425, or fixed MSE: the aim, 4 times the training",
        ("nll-narrow-400", "adaptive"),
        ("mse-400", "fixed"),
    ),
    (
        "trained on adaptive graphs of r 0.01425, or on fixed ones, 4 times the training",
        ("nll-narrow-400", "adaptive"),
        ("nll-400", "fixed"),
    ),
    (
        "adaptive or fixed, trained on adaptive graphs of r 0.01425, 4 times the training",
        ("nll-narrow-400", "adaptive"),
        ("nll-narrow-400", "fixed"),
    ),
    (
        "uncertain or random, trained on adaptive graphs of r 0.01425, 4 times the training",
        ("nll-narrow-400", "adaptive"),
        ("nll-narrow-400", "random"),
    ),
    (
        "random or fixed, trained on adaptive graphs of r 0.01425, 4 times the training",
        ("nll-narrow-400", "random"),
        ("nll-narrow-400", "fixed"),
    ),
    (
        "feedback, trained on adaptive graphs of r 0.01425, 4 times the training",
        ("nll-narrow-400", "adaptive"),
        ("nll-narrow-400", "base-sigma"),
    ),
    ("lag and feedback: adaptive or two-pass", ("nll", "adaptive"), ("nll", "two-pass")),
    ("adaptive NLL or fixed MSE: the aim", ("nll", "adaptive"), ("mse", "fixed")),
    ("the chosen rule or fixed MSE: the aim", ("tuned", "adaptive"), ("mse", "fixed")),
    (
        "the divergence's chosen rule or fixed MSE: the aim",
        ("tuned-divergence", "divergence"),
        ("mse", "fixed"),
    ),
    ("the chosen rule or fixed, same model", ("tuned", "adaptive"), ("nll", "fixed")),
    ("the chosen rule, uncertain or random", ("tuned", "adaptive"), ("tuned", "random")),
    ("NLL or MSE, fixed graphs", ("nll", "fixed"), ("mse", "fixed")),
    ("k nearest or all within r, NLL", ("nll", "knn"), ("nll", "fixed")),
    ("k nearest or all within r, MSE", ("mse", "knn"), ("mse", "fixed")),
    ("GNS or MLP", ("mse", "fixed"), ("mlp", "fixed")),
    ("r 0.019 or 0.015, MSE", ("mse-denser", "fixed"), ("mse", "fixed")),
    ("adaptive NLL or MSE at its edges", ("nll", "adaptive"), ("mse-matched", "fixed")),
    ("adaptive or r 0.0176, NLL", ("nll", "adaptive"), ("nll-middle", "fixed")),
    ("r 0.0176 or 0.015, NLL", ("nll-middle", "fixed"), ("nll", "fixed")),
    (
        "trained on adaptive or base graphs, adaptive",
        ("nll-adaptive", "adaptive"),
        ("nll", "adaptive"),
    ),
    (
        "adaptive or fixed, trained on adaptive graphs",
        ("nll-adaptive", "adaptive"),
        ("nll-adaptive", "fixed"),
    ),
    (
        "uncertain or random, trained on adaptive graphs",
        ("nll-adaptive", "adaptive"),
        ("nll-adaptive", "random"),
    ),
    (
        "trained on adaptive graphs, or fixed MSE: the aim",
        ("nll-adaptive", "adaptive"),
        ("mse", "fixed"),
    ),
    ("sigma or the last acceleration, NLL", ("nll", "adaptive"), ("nll", "acceleration")),
    ("sigma or the divergence around, NLL", ("nll", "adaptive"), ("nll", "divergence")),
    ("the divergence around or fixed, NLL", ("nll", "divergence"), ("nll", "fixed")),
    ("the last acceleration or fixed, NLL", ("nll", "acceleration"), ("nll", "fixed")),
    ("the last acceleration or fixed, MSE", ("mse", "acceleration"), ("mse", "fixed")),
    ("the divergence around or fixed, MSE", ("mse", "divergence"), ("mse", "fixed")),
    ("two-sided or fixed, same model", ("nll", "two-sided"), ("nll", "fixed")),
    ("two-sided NLL or fixed MSE: the aim", ("nll", "two-sided"), ("mse", "fixed")),
    (
        "two-sided or fixed, trained on two-sided graphs",
        ("nll-two-sided", "two-sided"),
        ("nll-two-sided", "fixed"),
    ),
    (
        "two-sided, trained on it, or fixed MSE: the aim",
        ("nll-two-sided", "two-sided"),
        ("mse", "fixed"),
    ),
    ("adaptive or fixed, decoupled", ("decoupled", "adaptive"), ("decoupled", "fixed")),
    ("uncertain or random, decoupled", ("decoupled", "adaptive"), ("decoupled", "random")),
    ("two-sided or fixed, decoupled", ("decoupled", "two-sided"), ("decoupled", "fixed")),
    ("adaptive decoupled or fixed MSE: the aim", ("decoupled", "adaptive"), ("mse", "fixed")),
    ("two-sided decoupled or fixed MSE: the aim", ("decoupled", "two-sided"), ("mse", "fixed")),
    ("decoupled or MSE, fixed graphs", ("decoupled", "fixed"), ("mse", "fixed")),
    (
        "adaptive decoupled or MSE at the edges of NLL",
        ("decoupled", "adaptive"),
        ("mse-matched", "fixed"),
    ),
    (
        "adaptive decoupled, latents shaped, or MSE at the edges of NLL",
        ("decoupled-weight", "adaptive"),
        ("mse-matched", "fixed"),
    ),
    (
        "adaptive decoupled, latents shaped, or MSE at its edges",
        ("decoupled-weight", "adaptive"),
        ("mse-matched-decoupled", "fixed"),
    ),
    (
        "adaptive decoupled, latents shaped, or MSE of r 0.019",
        ("decoupled-weight", "adaptive"),
        ("mse-denser", "fixed"),
    ),
    (
        "adaptive or fixed, decoupled, latents shaped",
        ("decoupled-weight", "adaptive"),
        ("decoupled-weight", "fixed"),
    ),
    (
        "uncertain or random, decoupled, latents shaped",
        ("decoupled-weight", "adaptive"),
        ("decoupled-weight", "random"),
    ),
    (
        "two-sided or fixed, decoupled, latents shaped",
        ("decoupled-weight", "two-sided"),
        ("decoupled-weight", "fixed"),
    ),
    (
        "adaptive decoupled, latents shaped, or fixed MSE: the aim",
        ("decoupled-weight", "adaptive"),
        ("mse", "fixed"),
    ),
    (
        "two-sided decoupled, latents shaped, or fixed MSE: the aim",
        ("decoupled-weight", "two-sided"),
        ("mse", "fixed"),
    ),
    (
        "decoupled, latents shaped, or MSE, fixed graphs",
        ("decoupled-weight", "fixed"),
        ("mse", "fixed"),
    ),
    (
        "adaptive or fixed, decoupled, deeper head",
        ("decoupled-deep", "adaptive"),
        ("decoupled-deep", "fixed"),
    ),
    (
        "uncertain or random, decoupled, deeper head",
        ("decoupled-deep", "adaptive"),
        ("decoupled-deep", "random"),
    ),
    (
        "adaptive or fixed, sigma of the next step",
        ("decoupled-ahead", "adaptive"),
        ("decoupled-ahead", "fixed"),
    ),
    (
        "uncertain or random, sigma of the next step",
        ("decoupled-ahead", "adaptive"),
        ("decoupled-ahead", "random"),
    ),
    (
        "sigma of the next step or of this one",
        ("decoupled-ahead", "adaptive"),
        ("decoupled-weight", "adaptive"),
    ),
    ("adaptive beta-NLL or fixed MSE", ("beta-nll", "adaptive"), ("mse", "fixed")),
    ("adaptive or fixed, beta-NLL", ("beta-nll", "adaptive"), ("beta-nll", "fixed")),
    ("uncertain or random, beta-NLL", ("beta-nll", "adaptive"), ("beta-nll", "random")),
)


@dataclass(frozen=True)
class Row:
    """Cells of a row, and the files that its numbers come from."""

    cells: Sequence[str]
    files: Sequence[str] = ()


@dataclass(frozen=True)
class Table:
    """A table of the report."""

    name: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Row]
    note: str = ""


def tables(results: Results) -> list[Table]:
    """All that the study's profile has the runs for."""
    made = [_statistics(results)]
    for data in results.study.sets.values():
        made += [
            _rollouts(results, data),
            _comparisons(results, data),
            _clouds(results, data),
            *([_long(results, data)] if data.name in results.long else []),
            *_sweeps(results, data),
            *([_along(results, data)] if len(_shares(results, data)) > 1 else []),
            *_calibration(results, data),
        ]
    return [*made, *_paper(results)]


def _statistics(results: Results) -> Table:
    rows = []
    step = 0
    for data in results.study.sets.values():
        described = data.described
        step = described["step"]
        values = {
            name: np.array([each[name] for each in described["statistics"]])
            for name in ("nodes", "edges", "density", "degree", "clustering")
        }
        rows.append(
            Row(
                [
                    data.name,
                    str(len(described["statistics"])),
                    *(_mean_std(values[name], ",.0f") for name in ("nodes", "edges")),
                    f"{values['density'].mean():.2e}",
                    _mean_std(values["degree"], ".2f"),
                    _mean_std(values["clustering"], ".3f"),
                ],
                [str((data.metrics / "data.json").relative_to(results.study.out).as_posix())],
            )
        )
        if data.name in PAPER_STATISTICS:
            rows.append(Row([f"{data.name}, paper's set", "30", *PAPER_STATISTICS[data.name]]))
    return Table(
        "statistics",
        f"Graph statistics at step {step} (table 2)",
        ("data", "trajectories", "nodes", "edges", "density", "degree", "clustering"),
        rows,
        f"Undirected edges within the data's radius, mean ± standard deviation over the test "
        f"trajectories. Their course, every {EVERY} steps, is in the figure.",
    )


def _rollouts(results: Results, data: DataSet) -> Table:
    mark, marks = results.study.last_mark, results.study.profile.marks
    rows = []
    where = str((data.metrics / "times.json").relative_to(results.study.out).as_posix())
    mixed = False
    for series in results.of(data.name):
        time = data.step_time(series.model, series.policy)
        mixed = mixed or time["elsewhere"]
        sign = ELSEWHERE if time["elsewhere"] else ""
        true = series.curve("edges_within_radius_true").mean()
        predicted = series.curve("edges_within_radius").mean()
        rows.append(
            Row(
                [
                    series.model.title,
                    series.policy if series.model.edges else MISSING,
                    series.sample,
                    *(_interval(series.estimate(f"mse@{each}"), ".2e") for each in marks),
                    _interval(series.estimate("edges_per_step"), ",.0f")
                    if series.model.edges
                    else "0",
                    _number(predicted, ",.0f"),
                    _number(true, ",.0f"),
                    _number(predicted / true, ".2f"),
                    _interval(series.estimate(f"clumping@{mark}"), ".2f"),
                    f"{time['graph_ms']:.2f}{sign}",
                    f"{time['model_ms']:.2f}{sign}",
                ],
                [*series.files, where],
            )
        )
    where = str((data.metrics / "data.json").relative_to(results.study.out).as_posix())
    for count in sorted({series.trajectories for series in results.of(data.name)}):
        centre = [
            np.array(data.described["centroid_mse"][str(each)][:count], dtype=np.float64)
            for each in marks
        ]
        rows.append(
            Row(
                ["all particles at their true centre", MISSING, f"{MISSING} × {count}"]
                + [_interval(estimate(each[None]), ".2e") for each in centre]
                + [MISSING] * 7,
                [where],
            )
        )
    return Table(
        f"rollouts-{data.name}",
        f"Rollouts on {data.name} (table 4)",
        (
            "model",
            "graph",
            "seeds × trajectories",
            *(f"MSE@{each}" for each in marks),
            "edges a step",
            "edges within r, predicted",
            "true",
            "ratio",
            f"ratio@{mark}",
            "graph ms",
            "model ms",
        ),
        rows,
        "Means over seeds and trajectories, in brackets the 95 % interval for both as samples, of "
        "one seed for the trajectories alone (adaptgns.reproduce.results). Edges are directed and "
        "without self-edges. The ratio is "
        "that of edges within the data's radius on predicted over true positions, of their means "
        f"over all steps, and at step {mark} the mean of ratios: above 1, the predicted particles "
        "clump. Milliseconds of a step are medians of all models and policies in turns, of those "
        "that the study got later in turns among themselves, on true "
        f"positions of one trajectory of {data.times['particles']:,} particles, "
        f"{data.times['threads']} threads"
        + (
            f"; {ELSEWHERE} on another processor, to be compared among themselves."
            if mixed
            else "."
        ),
    )


def _comparisons(results: Results, data: DataSet) -> Table:
    marks = results.study.profile.marks
    rows = []
    for question, first, second in COMPARISONS:
        pair = results.pair(data.name, first, second)
        if pair is None:
            continue
        one, other = pair
        rows.append(
            Row(
                [
                    question,
                    f"{first[0]}, {first[1]}",
                    f"{second[0]}, {second[1]}",
                    one.sample,
                    _change(results, one, other, "one_step_mse"),
                    *(_change(results, one, other, f"mse@{mark}") for mark in marks),
                    _change(results, one, other, "kinetic_energy_error"),
                    _interval(results.difference(one, other, "edges_per_step"), "+,.0f"),
                    ", ".join(
                        _number(value, "+.0%")
                        for value in (
                            one.scalar(f"mse@{marks[-1]}").mean(1)
                            / other.scalar(f"mse@{marks[-1]}").mean(1)
                            - 1
                        )
                    ),
                ],
                [*one.files, *other.files],
            )
        )
    return Table(
        f"comparisons-{data.name}",
        f"One less the other on {data.name}",
        (
            "question",
            "one",
            "other",
            "seeds × trajectories",
            "one-step MSE",
            *(f"MSE@{mark}" for mark in marks),
            "kinetic energy error",
            "edges a step",
            f"MSE@{marks[-1]}, seed by seed",
        ),
        rows,
        "In percent of the other's mean. Differences are paired, of the trajectories and the seeds "
        "that both have; in brackets their 95 % interval, symmetric (Student's t), so that "
        "one of few heavy-tailed errors may pass -100 %, and not corrected for the number of "
        "comparisons. Single steps are from true positions.",
    )


def _change(results: Results, one: Series, other: Series, scalar: str) -> str:
    """The difference of two means in percent of the second, with its interval."""
    reference = other.scalar(scalar).mean()
    difference = results.difference(one, other, scalar)
    if not (np.isfinite(difference.mean) and reference):
        return MISSING
    mean, low, high = (value / reference for value in vars(difference).values())
    return f"{mean:+.0%} [{low:+.0%}, {high:+.0%}]"


def _clouds(results: Results, data: DataSet) -> Table:
    marks = results.study.profile.marks
    rows = [
        Row(
            [
                series.model.title,
                series.policy if series.model.edges else MISSING,
                series.sample,
                _interval(series.estimate("kinetic_energy_error"), ".3f"),
                *(_interval(matched(series, mark), ".1e") for mark in marks),
            ],
            series.files,
        )
        for series in results.of(data.name)
    ]
    return Table(
        f"clouds-{data.name}",
        f"Energy and where the matter is, {data.name}",
        (
            "model",
            "graph",
            "seeds × trajectories",
            "kinetic energy error",
            *(f"transport@{mark}" for mark in marks),
        ),
        rows,
        "Kinetic energy: sum over the steps of the difference between predicted and true, over the "
        "sum of the true one. Transport: squared earth mover's distance between predicted and true "
        "particles (length²), which Sinkhorn's algorithm approximates, here exact; of trajectories "
        f"up to {MATCHED:,} particles.",
    )


def matched(series: Series, mark: int) -> Estimate:
    """Of the transport at ``mark``, over the trajectories that were matched."""
    values = series.scalar(f"transport@{mark}")
    return estimate(values[:, np.isfinite(values).all(axis=0)])


def _long(results: Results, data: DataSet) -> Table:
    """How far rollouts hold."""
    assert data.long is not None
    marks, made = data.long.marks, results.long[data.name]
    first = made[0]
    rows = []
    for series in made:
        predicted, true = (
            series.curve(name).mean()
            for name in ("edges_within_radius", "edges_within_radius_true")
        )
        rows.append(
            Row(
                [
                    series.model.title,
                    series.policy,
                    *(_interval(series.estimate(f"mse@{mark}"), ".2e") for mark in marks),
                    MISSING
                    if series is first
                    else _change(results, series, first, f"mse@{marks[-1]}"),
                    _interval(series.estimate("edges_per_step"), ",.0f"),
                    _number(predicted, ",.0f"),
                    _number(true, ",.0f"),
                    _number(predicted / true, ".2f"),
                    _interval(series.estimate(f"clumping@{marks[-1]}"), ".2f"),
                    _interval(series.estimate("kinetic_energy_error"), ".3f"),
                ],
                series.files if series is first else [*series.files, *first.files],
            )
        )
    centre = data.described_long["centroid_mse"]
    rows.append(
        Row(
            ["all particles at their true centre", MISSING]
            + [_interval(estimate(np.array(centre[str(mark)])[None]), ".2e") for mark in marks]
            + [MISSING] * 7,
            [str((data.metrics / "long.json").relative_to(results.study.out).as_posix())],
        )
    )
    return Table(
        f"long-{data.name}",
        f"Rollouts of {marks[-1]} steps on {data.name}",
        (
            "model",
            "graph",
            *(f"MSE@{mark}" for mark in marks),
            f"MSE@{marks[-1]}, less {first.policy}",
            "edges a step",
            "edges within r, predicted",
            "true",
            "ratio",
            f"ratio@{marks[-1]}",
            "kinetic energy error",
        ),
        rows,
        f"As in the tables above, of {data.described_long['trajectories']} trajectories to the "
        "end: edges, ratio and energy are over all steps. A difference is in percent of what is "
        "taken off, and paired by seed and trajectory.",
    )


def _sweeps(results: Results, data: DataSet) -> list[Table]:
    return [
        _sweep(results, data, model, model.chosen)
        for model in results.study.profile.models_on(data.source)
        if model.chosen is not None
    ]


def _sweep(results: Results, data: DataSet, model: Model, chosen: Chosen) -> Table:
    path = data.metrics / chosen.folder / RESULT
    content = read_json(path)
    file = str(path.relative_to(results.study.out).as_posix())
    settings, budget = content["settings"], results.study.profile.model(chosen.budget)
    rows = [
        Row(
            [
                *(f"{row[name]:g}" for name in ("tau", "factor", "radius")),
                _number(row["mse"], ".2e"),
                _number(row["edges"], ",.0f"),
                _number(row["clumping"], ".2f"),
                "yes" if row == content["chosen"] else "",
            ],
            [file],
        )
        for row in content["trials"]
    ]
    return Table(
        f"{chosen.folder}-{data.name}",
        f"{model.title} on validation, {data.name}",
        (
            "tau",
            "factor",
            "r",
            f"MSE@{settings['steps']}",
            "edges a step",
            f"ratio@{settings['steps']}",
            "chosen",
        ),
        rows,
        f"One seed. The budget is that of {budget.title} on the fixed graph there: "
        f"{settings['edges']:,.0f} directed edges a step.",
    )


def _shares(results: Results, data: DataSet) -> list[tuple[float, str]]:
    """Shares of the training at which the NLL model was measured, and the models' names."""
    return sorted(
        (series.model.share, series.model.name)
        for series in results.of(data.name)
        if (series.model.name == "nll" or series.model.name.startswith("nll-"))
        and series.model.graph == "base"
        and series.model.radius == 1.0
        and series.policy == "adaptive"
    )


def _along(results: Results, data: DataSet) -> Table:
    mark = results.study.last_mark
    rows = []
    for share, name in _shares(results, data):
        fixed, adaptive = (
            results.series[data.name, name, policy] for policy in ("fixed", "adaptive")
        )
        edges = results.difference(adaptive, fixed, "edges_per_step")
        rows.append(
            Row(
                [
                    f"{share:.0%} of {data.steps:,}",
                    fixed.sample,
                    _interval(fixed.estimate(f"mse@{mark}"), ".2e"),
                    _interval(fixed.estimate(f"clumping@{mark}"), ".2f"),
                    _change(results, adaptive, fixed, f"mse@{mark}"),
                    _interval(edges, "+,.0f"),
                ],
                [*fixed.files, *adaptive.files],
            )
        )
    return Table(
        f"along-{data.name}",
        f"Does the gain last as the model gets better? {data.name}",
        (
            "training steps",
            "seeds × trajectories",
            f"MSE@{mark}, fixed",
            f"ratio@{mark}, fixed",
            "adaptive - fixed, of fixed",
            "edges a step",
        ),
        rows,
        "Each row's models were trained from the start with a schedule of that length. Intervals "
        "of one seed are for the trajectories alone.",
    )


def _calibration(results: Results, data: DataSet) -> list[Table]:
    made = []
    for series in results.of(data.name):
        if series.policy != "fixed" or series.model.share < 1:
            continue
        errors, predicted, gaps = (
            series.calibration(name) for name in ("squared_error", "predicted", "gap")
        )
        if not len(errors):
            continue
        ranks = np.array([row["spearman"] for row in series.rows], dtype=np.float64)
        rows = [
            Row(
                [str(index), f"{error:.4g}", f"{variance:.4g}", f"{gap:.4g}"],
                series.files,
            )
            for index, (error, variance, gap) in enumerate(
                zip(errors.mean(0), predicted.mean(0), gaps.mean(0), strict=True)
            )
        ]
        rows.append(Row(["ECE", "", "", f"{gaps.mean():.4g}"], series.files))
        made.append(
            Table(
                f"calibration-{data.name}-{series.model.name}",
                f"Calibration of {series.model.title} on {data.name} (table 3)",
                ("decile of sigma", "mean squared error", "d·σ²", "|Δ|"),
                rows,
                f"One step from true positions of {series.trajectories} trajectories, normalized "
                "units, deciles of each seed averaged over the seeds. Rank correlation of sigma "
                f"and error {ranks.mean():.2f} ({', '.join(f'{rank:.2f}' for rank in ranks)}).",
            )
        )
    return made


def _paper(results: Results) -> list[Table]:
    rows = [
        Row([name, model, edges, error])
        for name in results.study.sets
        for model, (edges, error) in PAPER_RESULTS.get(name, {}).items()
    ]
    if not rows:
        return []
    return [
        Table(
            "paper",
            "The paper's table 4, measured on other data",
            ("data", "model", "edges a step", "MSE@200"),
            rows,
            "One seed; its water was made by SPH and its sand by another MPM, and its true frames "
            "hold about 3,100 directed edges at step 100 on water: context, no comparison.",
        )
    ]


def _mean_std(values: np.ndarray, form: str) -> str:
    return f"{values.mean():{form}} ± {values.std():{form}}"


def _interval(value: Estimate, form: str) -> str:
    if not np.isfinite(value.mean):
        return MISSING
    return f"{value.mean:{form}} [{value.low:{form}}, {value.high:{form}}]"


def _number(value: float | None, form: str) -> str:
    return MISSING if value is None or not np.isfinite(value) else f"{value:{form}}"


def series_label(series: Series) -> str:
    """Names a model under a policy in a figure."""
    return f"{series.model.title}, {series.policy}" if series.model.edges else series.model.title
