"""`python -m adaptgns.inspect`: what a data set holds, its graphs, and what is wrong with it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro
from rich import box as boxes
from rich.console import Console
from rich.table import Table

from adaptgns.command import plain_errors
from adaptgns.data.check import Problem, find_problems, vector_text
from adaptgns.data.default import dataset_folder
from adaptgns.data.errors import DataError
from adaptgns.data.metadata import RADIUS_KEY, Metadata, read_metadata, states_radius
from adaptgns.data.radius import NEIGHBOURS, DegreeCurve, advise_radius
from adaptgns.data.statistics import FILE_KEYS, compute_statistics
from adaptgns.data.trajectories import SPLITS, Trajectories, find_split, open_split
from adaptgns.graph import radius_graph
from adaptgns.graph_statistics import GraphStatistics, graph_statistics

if TYPE_CHECKING:
    from collections.abc import Sequence

_TIMES = 9
"""Frames at which the degree over time is shown."""

_RADII = (0.6, 0.8, 1.0, 1.2, 1.5, 2.0)
"""Multiples of the radius at which the degree is shown."""

_FEW, _MANY = 0.5, 4.0
"""Mean degrees below and above these multiples of the usual one are told."""


@dataclass(frozen=True)
class InspectConfig:
    """Show what a data set holds, its graph statistics and the problems found in it.

    Exits with 1 if the data can be read but not used, with 2 if they cannot be read.
    """

    data: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Folder of the data set, or the name of an embedded one (waterdrop, sand)."""
    split: Literal["train", "valid", "test"] = "test"
    """Split whose graphs are looked at."""
    frame: int = 100
    """Frame of the graph statistics, from 0; the last one in shorter trajectories."""
    radius: float | None = None
    """Connectivity radius, in the data's length unit; None: the one of metadata.json."""


def inspect(config: InspectConfig, console: Console) -> list[Problem]:
    """Prints the report and returns the problems found.

    Raises:
        DataError: the data set, its metadata or the split is missing or can't be read.
    """
    if config.frame < 0:
        raise DataError(f"frame is {config.frame}; 0 or more is accepted")
    if config.radius is not None and not (np.isfinite(config.radius) and config.radius > 0):
        raise DataError(f"radius is {config.radius}; a finite number above 0 is accepted")
    folder = dataset_folder(config.data)
    problems: list[Problem] = []
    splits = _open_all(folder, problems)
    metadata = _read_metadata(folder, config, splits, problems)
    radius = metadata.radius if config.radius is None else config.radius
    _print_overview(console, folder, metadata, splits)
    if "train" in splits:
        _print_motion(console, metadata, splits["train"], problems)
    if config.split in splits:
        _print_graphs(
            console,
            config=config,
            radius=radius,
            metadata=_bounded(metadata, folder, config.split),
            split=splits[config.split],
            problems=problems,
        )
    elif find_split(folder, config.split) is None:
        open_split(folder, config.split)  # its error says what the folder holds
    absent = [split for split in SPLITS if find_split(folder, split) is None]
    if "train" in splits and absent:
        problems.append(
            Problem(
                f"{folder}: train, but no {' and no '.join(absent)} split; all three are needed",
                fatal=False,
            )
        )
    for split, trajectories in splits.items():
        bounded = _bounded(metadata, folder, split)
        found = {problem.message for problem in problems}
        problems += [
            problem
            for problem in find_problems(trajectories, bounded)
            if problem.message not in found
        ]
    _print_problems(console, problems)
    return problems


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command with `argv`, or with the process's own arguments."""
    config = tyro.cli(InspectConfig, args=argv, prog="python -m adaptgns.inspect")
    with plain_errors():
        problems = inspect(config, Console(highlight=False))
    if any(problem.fatal for problem in problems):
        raise SystemExit(1)


def _bounded(metadata: Metadata, folder: Path, split: str) -> Metadata:
    """With the bounds of that split: those of the test split may be its own."""
    return metadata.suited(folder, split)[0]


def _read_metadata(
    folder: Path, config: InspectConfig, splits: dict[str, Trajectories], problems: list[Problem]
) -> Metadata:
    """With the radius asked for, or an advised one, where the file states none: that is a problem,
    but the rest can be looked at."""
    if states_radius(folder):
        return read_metadata(folder)
    metadata = read_metadata(folder, radius=config.radius or 1.0)
    radius, origin = config.radius, "as asked for"
    if radius is None:
        split = splits.get(config.split) or next(iter(splits.values()), None)
        frames = [] if split is None else _frames(split, config.frame, [])[1]
        radius = advise_radius(frames, metadata.box) if frames else None
        if radius is None:
            low, high = np.array(metadata.bounds).T
            radius = float((high - low).max())
        origin = "as below"
    problems.append(
        Problem(
            f"{folder / 'metadata.json'}: no {RADIUS_KEY}; here it is {radius:.4g}, {origin}. "
            "Training needs one: write it in",
            fatal=True,
        )
    )
    return replace(metadata, radius=float(f"{radius:.4g}"))


def _open_all(folder: Path, problems: list[Problem]) -> dict[str, Trajectories]:
    splits = {}
    for split in SPLITS:
        if find_split(folder, split) is not None:
            try:
                splits[split] = open_split(folder, split)
            except DataError as error:
                problems.append(Problem(str(error), fatal=True))
    return splits


def _table(console: Console, title: str, *columns: str) -> Table:
    """An empty table under a printed title; plain when piped, folded in a narrow terminal."""
    console.print(f"\n{title}", style="bold")
    table = Table(
        box=boxes.SIMPLE_HEAD if console.is_terminal else boxes.ASCII,
        show_edge=False,
    )
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right", overflow="fold")
    return table


def _print_overview(
    console: Console, folder: Path, metadata: Metadata, splits: dict[str, Trajectories]
) -> None:
    console.print(str(folder), markup=False, soft_wrap=True)
    table = _table(console, "splits", "split", "trajectories", "frames", "particles")
    for name, split in splits.items():
        table.add_row(name, str(len(split)), _range(split.lengths), _range(split.particle_counts))
    console.print(table)
    table = _table(console, "metadata", "property", "value")
    bounds = ", ".join(
        f"{low:g} to {high:g}{' periodic' if wraps else ''}"
        for (low, high), wraps in zip(metadata.bounds, metadata.periodic, strict=True)
    )
    table.add_row("dimensions", str(metadata.dim))
    table.add_row("time per frame", f"{metadata.dt:g}")
    table.add_row("bounds", bounds)
    table.add_row("connectivity radius", f"{metadata.radius:g}")
    table.add_row("kinematic types", ", ".join(map(str, metadata.kinematic_types)) or "none")
    table.add_row("material properties", str(metadata.material_properties))
    console.print(table)


def _print_motion(
    console: Console, metadata: Metadata, train: Trajectories, problems: list[Problem]
) -> None:
    try:
        computed = compute_statistics(
            train, box=metadata.box, kinematic_types=metadata.kinematic_types
        )
    except DataError as error:
        problems.append(Problem(str(error), fatal=True))
        return
    table = _table(console, "motion per frame, train", "statistic", "stored", "computed")
    for name, key in FILE_KEYS.items():
        stored, own = np.array(getattr(metadata, name)), np.array(getattr(computed, name))
        table.add_row(key, vector_text(stored), vector_text(own))
    console.print(table)


def _print_graphs(
    console: Console,
    *,
    config: InspectConfig,
    radius: float,
    metadata: Metadata,
    split: Trajectories,
    problems: list[Problem],
) -> None:
    """Statistics over the trajectories that can be read; the others become problems."""
    usable, frames, types = _frames(split, config.frame, problems)
    if not usable:
        return
    console.print(f"\nparticle types in {config.split}: {', '.join(map(str, sorted(types)))}")
    statistics = [graph_statistics(positions, radius, metadata.box) for positions in frames]
    short = int((split.lengths <= config.frame).sum())
    note = f" (the last frame in {short} shorter ones)" if short else ""
    title = f"graph at r = {radius:g}, frame {config.frame}{note}, {len(usable)} trajectories"
    _print_statistics(console, title, statistics)
    _print_degree_over_time(console, radius, metadata, split, usable)
    _print_degree_by_radius(console, radius, metadata, frames, problems)


def _frames(
    split: Trajectories, frame: int, problems: list[Problem]
) -> tuple[list[int], list[np.ndarray], set[int]]:
    """Of each trajectory that can be read its index and positions `[N, d]` at the frame, or the
    last; and the particle types in them. The others become problems."""
    usable, frames, types = [], [], set[int]()
    for index, length in enumerate(split.lengths.tolist()):
        at = min(frame, length - 1)
        try:
            snapshot = split.window(index, at, at + 1)
        except DataError as error:
            problems.append(Problem(str(error), fatal=True))
            continue
        usable.append(index)
        frames.append(snapshot.positions[0])
        types.update(snapshot.particle_type.tolist())
    return usable, frames, types


def _print_statistics(console: Console, title: str, statistics: list[GraphStatistics]) -> None:
    table = _table(console, title, "per graph", "mean", "std")
    names = {"edges": "undirected edges", "degree": "mean degree", "clustering": "mean clustering"}
    rows = [asdict(one) for one in statistics]
    for key in rows[0]:
        values = np.array([row[key] for row in rows], dtype=np.float64)
        table.add_row(names.get(key, key), _figures(values.mean(), 4), _figures(values.std(), 3))
    console.print(table)


def _print_degree_over_time(
    console: Console, radius: float, metadata: Metadata, split: Trajectories, usable: list[int]
) -> None:
    table = _table(console, f"mean degree over time, r = {radius:g}", "frame", "mean", "std")
    last = int(split.lengths[usable].min()) - 1
    for frame in np.unique(np.linspace(0, last, _TIMES).astype(int)).tolist():
        degrees = []
        for index in usable:
            try:
                positions = split.window(index, frame, frame + 1).positions[0]
            except DataError:
                continue  # told by find_problems, which reads every frame
            senders, _ = radius_graph(positions, radius, box=metadata.box)
            degrees.append(len(senders) / len(positions))
        if degrees:
            table.add_row(str(frame), _figures(np.mean(degrees), 3), _figures(np.std(degrees), 2))
    console.print(table)


def _print_degree_by_radius(
    console: Console,
    radius: float,
    metadata: Metadata,
    frames: list[np.ndarray],
    problems: list[Problem],
) -> None:
    curve = DegreeCurve(frames, radius * max(_RADII), metadata.box)
    table = _table(console, "mean degree by radius", "radius", "mean degree")
    for factor in _RADII:
        table.add_row(f"{factor * radius:.4g}", f"{curve.degree(factor * radius):.3g}")
    console.print(table)
    target = NEIGHBOURS[metadata.dim]
    advised = curve.advice()
    if advised is None:
        text = (
            f"too few particles for {target:g} neighbours each; any radius that joins them is fine"
        )
    else:
        degree = curve.degree(radius)
        text = (
            f"r = {advised:.4g} gives {target:g} neighbours on average, the usual number in "
            f"{metadata.dim}D; r = {radius:g} gives {degree:.3g}"
        )
        if not _FEW * target <= degree <= _MANY * target:
            problems.append(Problem(f"radius: {text}", fatal=False))
    console.print(f"radius: {text}", soft_wrap=True)


def _print_problems(console: Console, problems: list[Problem]) -> None:
    if not problems:
        console.print("\nno problems found")
        return
    console.print(f"\nproblems: {len(problems)}", style="bold")
    for problem in problems:
        kind = "error" if problem.fatal else "warning"
        console.print(f"  {kind}: {problem.message}", markup=False, soft_wrap=True)


def _range(values: np.ndarray) -> str:
    low, high = int(values.min()), int(values.max())
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"


def _figures(value: np.floating[Any], digits: int) -> str:
    """A number of so many significant digits, never in exponential notation."""
    return np.format_float_positional(
        value, precision=digits, unique=False, fractional=False, trim="-"
    )


if __name__ == "__main__":
    main()
