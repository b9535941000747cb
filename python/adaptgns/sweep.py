"""`python -m adaptgns.sweep`: tau × factor × radius of the adaptive graph, on validation rollouts.

Each trial rolls a trained model out under one rule, and notes the error at the last step and what
the graph costs. Whom the rule lets see farther is a policy's choice, as a rule the uncertain ones.
Trials lie in a journal that several processes and machines can work on at once: run the same
command again, here or there. Then the rule with the lowest error within the budget of edges is
chosen, and a heat map drawn.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
import optuna
import torch
import tyro
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from optuna.storages import JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from rich.console import Console
from rich.table import Table
from sqlalchemy.exc import SQLAlchemyError

from adaptgns.atomic import write_json
from adaptgns.checkpoint import checkpoint_file, read_checkpoint
from adaptgns.command import plain_errors
from adaptgns.config import HISTORY, AdaptiveConfig, Device, RuledPolicy, to_json, torch_device
from adaptgns.data.trajectories import Trajectories
from adaptgns.figures import STYLE, save
from adaptgns.metrics import clumping, edge_counts, position_mse
from adaptgns.policies import make_policy
from adaptgns.rollout import open_data, steps, tell_short
from adaptgns.simulator import Simulator

JOURNAL, RESULT, HEAT_MAP = "journal.log", "sweep.json", "sweep"
Combination = tuple[tuple[str, float], ...]

DRAWN = 30
"""Trials of the samplers that draw, unless asked otherwise"""


@dataclass(frozen=True)
class SweepConfig:
    """Search tau, factor and radius of the adaptive graph on validation rollouts."""

    checkpoint: Path
    """Run folder or .safetensors file."""
    out: Path
    """Folder for the journal, sweep.json and the heat map."""
    data: str | None = None
    """Folder of a data set or name of an embedded one; None: the one the model was trained on."""
    split: Literal["train", "valid"] = "valid"
    """Which part of the data; the test split is for what was chosen."""
    policy: RuledPolicy = "adaptive"
    """Which particles see farther; all but acceleration and divergence need a model with a
    variance."""
    tau: tuple[float, ...] = (50.0, 70.0, 90.0)
    """Percentiles of sigma, or of the policy's own measure; other samplers than grid draw between
    the lowest and the highest."""
    factor: tuple[float, ...] = (1.1, 1.267, 1.5)
    """Expansion factors, likewise."""
    radius: tuple[float, ...] = ()
    """Base radii of the graph (length units of the data), likewise; none: that of training."""
    sampler: Literal["grid", "tpe", "random"] = "grid"
    """grid takes every combination; the others draw, tpe (Bergstra et al. 2011) where good trials
    lay."""
    trials: int | None = None
    """Trials at most, of all processes together; None: the whole grid, or 30."""
    edges: float | None = None
    """Budget of directed edges per step; None: none."""
    steps: int = 200
    """Frames to predict; the error at the last one counts."""
    trajectories: int | None = None
    """Trajectories to roll out, from the first; None: all."""
    storage: str | None = None
    """Database URL (such as postgresql://...) for trials of machines that share no folder; None:
    a journal in the folder."""
    seed: int = 0
    """Seed of the samplers that draw, and of the policy random."""
    device: Device = "auto"
    """auto: a GPU where there is one."""

    def __post_init__(self) -> None:
        for name in ("tau", "factor"):
            if not getattr(self, name):
                raise ValueError(f"{name}: got none; one or more are accepted")
        for name in ("tau", "factor", "radius"):
            values = getattr(self, name)
            if len(set(values)) < len(values):
                raise ValueError(
                    f"{name}: got {', '.join(map(str, values))}; each value is accepted once"
                )
        for tau, factor in product(self.tau, self.factor):
            rule = AdaptiveConfig(tau, factor)  # which checks them
            if self.policy == "two-sided":
                rule.require_two_sides()
        for name in ("trials", "edges", "steps", "trajectories"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"{name}: got {value}; accepted are numbers above 0")
        if any(not 0 < radius < math.inf for radius in self.radius):
            raise ValueError(f"radius: got {self.radius}; accepted are finite numbers > 0")


def sweep(config: SweepConfig, console: Console) -> dict[str, Any]:
    """Make the trials that are missing, and write what came out; also returned.

    Raises ValueError for a model without the variance that the policy needs, and where no trial is
    within the budget.
    """
    checkpoint = read_checkpoint(config.checkpoint)
    simulator, split = open_data(checkpoint, config.data, config.split, console)
    simulator = simulator.to(torch_device(config.device))
    tell_short(split, config.trajectories, config.steps, console)
    policy = make_policy(config.policy, AdaptiveConfig(), k=0, seed=0)
    if policy.needs_sigma and simulator.network.variance_head is None:
        raise ValueError(
            f"policy: got {config.policy}, which needs the model's variance; this model has none, "
            "for which acceleration and divergence are accepted"
        )
    config = replace(config, radius=config.radius or (simulator.radius,))
    space = {"tau": config.tau, "factor": config.factor, "radius": config.radius}
    config.out.mkdir(parents=True, exist_ok=True)
    # What stops a trial is told by whoever catches it, and Ctrl-C is no error of a trial.
    optuna.logging.set_verbosity(optuna.logging.CRITICAL)
    study = optuna.create_study(
        study_name="adaptgns",
        storage=_storage(config),
        load_if_exists=True,
    )
    _refuse_other(study, config, split.path.parent)

    def objective(trial: optuna.Trial) -> float:
        # By the trial's number, which no other process has.
        study.sampler = _sampler(config, config.seed + trial.number)
        found = measure(simulator, split, config, **_suggest(trial, config, space))
        for name, value in found.items():
            trial.set_user_attr(name, value)
        if config.edges is not None:
            trial.set_constraint("edges", found["edges"] - config.edges)
        error = found["mse"]
        return error if math.isfinite(error) else 1e9  # which samplers can compare

    def tell(study: optuna.Study, trial: FrozenTrial) -> None:
        console.print(
            f"{_ended(study, config)} of {wanted}: {_described(trial.params)}: MSE@{config.steps} "
            f"{trial.user_attrs['mse']:.2e}, {trial.user_attrs['edges']:,.0f} edges a step",
            highlight=False,
        )

    wanted = config.trials or DRAWN
    if config.sampler == "grid":
        wanted = min(math.prod(map(len, space.values())), config.trials or sys.maxsize)
    while _ended(study, config) < wanted:
        if config.sampler == "grid":
            study.enqueue_trial(_next_combination(study, space))
        study.optimize(objective, n_trials=1, callbacks=[tell])
    trials = list(_complete(study).values())
    result = _result(config, trials)
    write_json(config.out / RESULT, result)
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        save(_heat_map(config, trials), config.out, HEAT_MAP)
    return result


def measure(
    simulator: Simulator,
    split: Trajectories,
    config: SweepConfig,
    *,
    tau: float,
    factor: float,
    radius: float,
) -> dict[str, float]:
    """Means over the trajectories, under one rule: ``mse`` at the last step, ``edges`` per step,
    ``clumping`` at the last step (edges within the data's radius, predicted over true) and
    ``milliseconds`` of a step's graph and model."""
    metadata = simulator.metadata
    rows = []
    for index in range(min(len(split), config.trajectories or len(split))):
        trajectory = split[index]
        rule, seed = AdaptiveConfig(tau, factor), config.seed + index
        policy = make_policy(config.policy, rule, k=0, seed=seed)
        true = trajectory.positions[HISTORY:][: config.steps]
        mobile = metadata.mobile(trajectory.particle_type)
        made = list(steps(simulator, trajectory, policy, len(true), radius=radius))
        last, target = made[-1].positions[None], true[-1:]
        density = (edge_counts(p, metadata.radius, mobile, metadata.box) for p in (last, target))
        rows.append(
            {
                "mse": position_mse(last, target, mobile, metadata.box)[0],
                "edges": np.mean([step.edges for step in made]),
                "clumping": clumping(*density)[0],
                "milliseconds": np.median([step.graph_ms + step.model_ms for step in made]),
            }
        )
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _complete(study: optuna.Study) -> dict[Combination, FrozenTrial]:
    """The trials that have ended well, one of each combination."""
    ended = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return {tuple(sorted(trial.params.items())): trial for trial in ended}


def _ended(study: optuna.Study, config: SweepConfig) -> int:
    """How many trials count: of a grid each combination once."""
    if config.sampler == "grid":
        return len(_complete(study))
    return len(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))


def _next_combination(study: optuna.Study, space: dict[str, tuple[float, ...]]) -> dict[str, float]:
    """One that has not been tried; rather one that nobody seems to be at, but an interrupted trial
    may look so for ever."""
    done = _complete(study)
    running = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
    taken = {tuple(sorted(trial.params.items())) for trial in running}
    grid = [dict(zip(space, values, strict=True)) for values in product(*space.values())]
    left = [each for each in grid if tuple(sorted(each.items())) not in done]
    free = [each for each in left if tuple(sorted(each.items())) not in taken]
    return (free or left)[0]


def _storage(config: SweepConfig) -> JournalStorage | RDBStorage:
    if config.storage is not None:
        try:
            return RDBStorage(config.storage)
        except (ImportError, SQLAlchemyError) as error:
            raise ValueError(f"storage: {config.storage}: {error}") from error
    return JournalStorage(JournalFileBackend(str(config.out / JOURNAL)))


def _sampler(config: SweepConfig, seed: int) -> optuna.samplers.BaseSampler:
    match config.sampler:
        case "tpe":
            return optuna.samplers.TPESampler(seed=seed)
        case _:  # of a grid each combination is named
            return optuna.samplers.RandomSampler(seed=seed)


def _suggest(
    trial: optuna.Trial, config: SweepConfig, space: dict[str, tuple[float, ...]]
) -> dict[str, float]:
    if config.sampler == "grid":
        return {name: trial.suggest_categorical(name, values) for name, values in space.items()}
    return {
        name: trial.suggest_float(name, min(values), max(values)) for name, values in space.items()
    }


def _refuse_other(study: optuna.Study, config: SweepConfig, folder: Path) -> None:
    """Trials of one journal must be comparable."""
    weights = hashlib.sha256(checkpoint_file(config.checkpoint).read_bytes()).hexdigest()
    asked = to_json(config) | {"weights": weights[:16], "folder": str(folder.resolve())}
    local = ["checkpoint", "data", "out", "trials", "storage", "device", "edges"]
    if config.policy != "random":
        local.append("seed")
    asked = {name: value for name, value in asked.items() if name not in local}
    asked = {name: list(v) if isinstance(v, tuple) else v for name, v in asked.items()}
    begun = study.user_attrs.get("config")
    if begun is None:
        study.set_user_attr("config", asked)
        return
    # Older journals name none of these, but the checkpoint's path, and the data as they were given.
    begun = {"policy": "adaptive", **{name: asked[name] for name in ("weights", "folder")}} | begun
    different = sorted(name for name in asked if begun.get(name) != asked[name])
    if different:
        raise ValueError(
            f"out: {config.storage or config.out} holds trials with other {', '.join(different)}; "
            "name another folder"
        )


def _result(config: SweepConfig, trials: Sequence[FrozenTrial]) -> dict[str, Any]:
    rows = sorted(
        ({**trial.params, **trial.user_attrs} for trial in trials),
        key=lambda row: row["mse"] if math.isfinite(row["mse"]) else math.inf,
    )
    within = [
        row
        for row in rows
        if math.isfinite(row["mse"]) and (config.edges is None or row["edges"] <= config.edges)
    ]
    if not within and config.edges is None:
        raise ValueError("every trial diverged; look at the model, or at fewer --steps")
    if not within:
        fewest = min(row["edges"] for row in rows)
        raise ValueError(
            f"edges: no trial is within {config.edges:,.0f} edges a step, the thriftiest has "
            f"{fewest:,.0f}; accepted are smaller --radius, --factor or larger --tau, or more edges"
        )
    settings = {
        name: value
        for name, value in to_json(config).items()
        if name not in {"out", "checkpoint", "storage", "device", "data"}
    }
    return {"settings": settings, "chosen": within[0], "trials": rows}


def _heat_map(config: SweepConfig, trials: Sequence[FrozenTrial]) -> Figure:
    """The error over tau and factor, a panel a radius; of samplers that draw, the trials as
    points."""
    grid = config.sampler == "grid"
    radii = sorted(set(config.radius)) if grid else [None]
    figure = Figure(figsize=(1.2 + 2.2 * len(radii), 2.6), layout="constrained")
    panels = figure.subplots(1, len(radii), squeeze=False, sharey=True)[0]
    errors = np.array([trial.user_attrs["mse"] for trial in trials])
    finite = errors[np.isfinite(errors)]
    low, high = (finite.min(), finite.max()) if len(finite) else (1e-3, 1.0)
    scale: dict[str, Any] = {"cmap": "viridis_r", "norm": LogNorm(low, max(high, low * 1.001))}
    for ax, radius in zip(panels, radii, strict=True):
        if grid:
            taus, factors = sorted(set(config.tau)), sorted(set(config.factor))
            cells = np.full((len(factors), len(taus)), np.nan)
            for trial in trials:
                if trial.params["radius"] == radius:
                    row = factors.index(trial.params["factor"])
                    column = taus.index(trial.params["tau"])
                    cells[row, column] = trial.user_attrs["mse"]
                    ax.annotate(
                        f"{trial.user_attrs['mse']:.1e}\n{trial.user_attrs['edges']:,.0f}",
                        (column, row),
                        ha="center",
                        va="center",
                        fontsize=6,
                        color="white",
                        path_effects=[withStroke(linewidth=1.2, foreground="#222")],
                    )
            ax.imshow(cells, aspect="auto", origin="lower", **scale)
            ax.set_xticks(range(len(taus)), [f"{tau:g}" for tau in taus])
            ax.set_yticks(range(len(factors)), [f"{factor:g}" for factor in factors])
            ax.set_title(f"r = {radius:g}")
        else:
            points = np.array([[trial.params["tau"], trial.params["factor"]] for trial in trials])
            ax.scatter(*points.T, c=errors, s=18, **scale)
        ax.set_xlabel("tau, percentile")
    panels[0].set_ylabel("factor")
    figure.colorbar(ScalarMappable(**scale), ax=list(panels), label=f"MSE@{config.steps}, length²")
    return figure


def _described(params: dict[str, float]) -> str:
    return f"tau {params['tau']:g}, factor {params['factor']:g}, radius {params['radius']:g}"


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command with ``argv``, or with the process's own arguments."""
    console = Console()
    with plain_errors(torch.OutOfMemoryError):
        config = tyro.cli(
            SweepConfig,
            args=argv,
            prog="python -m adaptgns.sweep",
            description="Search tau, factor and radius of the adaptive graph on validation "
            "rollouts. Trials that were made are kept; several processes may work on one folder.",
        )
        result = sweep(config, console)
    table = Table("tau", "factor", "radius", f"MSE@{config.steps}", "edges a step", "clumping")
    for row in result["trials"][:10]:
        table.add_row(
            *(f"{row[name]:g}" for name in ("tau", "factor", "radius")),
            f"{row['mse']:.2e}",
            f"{row['edges']:,.0f}",
            f"{row['clumping']:.2f}",
        )
    console.print(table)
    console.print(
        f"chosen: {_described(result['chosen'])}; {config.out / RESULT}",
        highlight=False,
        soft_wrap=True,
    )


if __name__ == "__main__":
    main()
