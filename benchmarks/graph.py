"""Time the graph builders side by side with their peers.

    python benchmarks/graph.py [--out benchmarks/results/graph.json] [--quick]
    python benchmarks/graph.py --plot benchmarks/results/graph.json  # and the README's table

Each line is one system of uniformly random particles, its radius chosen for a mean degree.
Builders take turns in one process, so that a busy machine slows all of them alike; figures are
medians. Peers are those of the extra ``bench`` that are installed, each called the fastest way it
has: scipy's ``cKDTree(pos)`` and ``query_pairs`` (each pair once, unsorted); vesin's, matscipy's
and freud's lists of both directions, for the last two the arrays that they want made beforehand;
torch_cluster's ``radius_graph``. The roofline is the time that the memory would need to read the
positions and to write the edges, by the bandwidth measured in the same run. The plot is written to
docs/images.
"""

# ruff: noqa: PLC0415 (peers are imported where they are at hand)
import argparse
import json
import math
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from adaptgns.atomic import replace_text
from adaptgns.graph import adaptive_graph, radius_graph
from adaptgns.palette import SERIES

SYSTEMS = [  # particles, dimensions, mean degree away from walls
    (567, 2, 5.4),
    (1_270, 2, 6.8),
    (20_000, 2, 6.8),
    (100_000, 2, 6.8),
    (1_000_000, 2, 6.8),
    (2_000, 3, 20.0),
    (100_000, 3, 20.0),
    (1_000_000, 3, 20.0),
]
COST = [(10_000, 2, 6.8), (10_000_000, 2, 6.8)]
"""Systems that the cost per particle is compared over, beside those above"""
LARGEST_OF_PEERS = 1_000_000
PEERS = ("scipy", "vesin", "matscipy", "freud", "torch_cluster")
TAU, FACTOR = 70.0, 1.267
SIGMAS = ("random", "smooth")

SLOW = 2.0
"""Seconds of a call above which it is timed once"""
TURN = 40_000
"""Particles that a builder deals with in its turn, in as many frames as that makes"""
MOST = {"freud": 100_000, "torch_cluster": 100_000}
"""Particles beyond which a peer is left out: a minute and more"""


def timed(frames: list[dict[str, Callable[[], Any]]], seconds: float) -> dict[str, float]:
    """Median milliseconds of each builder over rounds of all, for about ``seconds``.

    In its turn a builder goes through all ``frames``, as in a rollout, twice, the second time
    timed: what the builder before it left in the caches, of the system's memory and of threads that
    are still awake is not its own cost, and no branch predictor learns particles by heart.
    """
    times: dict[str, list[float]] = {name: [] for name in frames[0]}

    def call(builder: Callable[[], Any]) -> float:
        start = time.perf_counter()
        builder()
        return time.perf_counter() - start

    end = time.perf_counter() + seconds
    rounds = 0
    while rounds < 3 or time.perf_counter() < end:
        rounds += 1
        for name, taken in times.items():
            if taken and taken[0] > SLOW:
                continue
            for builders in frames:
                call(builders[name])
            taken.extend(call(builders[name]) for builders in frames)
    return {name: 1e3 * statistics.median(values) for name, values in times.items()}


def peers(pos: Any, r: float) -> dict[str, Callable[[], Any]]:
    """Those at hand for ``pos`` ``[N, d]``, d of them open axes."""
    n, d = pos.shape
    solid = np.zeros((n, 3))
    solid[:, :d] = pos
    found: dict[str, Callable[[], Any]] = {
        "scipy": lambda: cKDTree(pos).query_pairs(r, output_type="ndarray")
    }
    with suppress(ImportError):
        from vesin import NeighborList

        nowhere = np.zeros((3, 3))
        found["vesin"] = lambda: NeighborList(cutoff=r, full_list=True).compute(
            points=solid, box=nowhere, periodic=False, quantities="ij"
        )
    with suppress(ImportError):
        from matscipy.neighbours import neighbour_list

        open_axes = np.zeros(3, dtype=bool)
        found["matscipy"] = lambda: neighbour_list(
            "ij", positions=solid, cutoff=r, cell=np.eye(3), pbc=open_axes
        )
    with suppress(ImportError):
        import freud

        box = freud.box.Box(4, 4, is2D=True) if d == 2 else freud.box.Box.cube(4)
        points = solid.astype(np.float32)
        asked = {"r_max": r, "exclude_ii": True}
        found["freud"] = lambda: (
            freud.locality.AABBQuery(box, points).query(points, asked).toNeighborList()
        )
    with suppress(ImportError):
        import torch
        from torch_cluster import radius_graph as clustered

        tensor = torch.from_numpy(pos)
        found["torch_cluster"] = lambda: clustered(tensor, r, max_num_neighbors=1_000)
    return {name: call for name, call in found.items() if n <= MOST.get(name, n)}


def bandwidth() -> float:
    """Bytes per second that two threads read and write together, copying what no cache holds."""
    halves = [(np.ones(1 << 25), np.empty(1 << 25)) for _ in range(os.cpu_count() or 1)]

    def copy(pair: tuple[Any, Any]) -> None:
        np.copyto(pair[1], pair[0])

    best = math.inf
    with ThreadPoolExecutor(len(halves)) as pool:
        for _ in range(6):
            start = time.perf_counter()
            list(pool.map(copy, halves))
            best = min(best, time.perf_counter() - start)
    return 2 * sum(source.nbytes for source, _ in halves) / best


def measure(
    n: int, d: int, degree: float, kind: str, seconds: float, per_second: float
) -> dict[str, Any]:
    rng = np.random.default_rng(n + d)
    ball = math.pi if d == 2 else 4 / 3 * math.pi
    r = (degree / (n * ball)) ** (1 / d)
    frames = []
    for _ in range(max(1, TURN // n)):
        pos = rng.random((n, d)).astype(kind)
        random = rng.random(n).astype(kind)
        smooth = np.sin(2 * math.pi * pos).sum(axis=1) + d
        frames.append((pos, random, smooth))

    def builders(pos: Any, random: Any, smooth: Any) -> dict[str, Callable[[], Any]]:
        return {
            **(peers(pos, r) if n <= LARGEST_OF_PEERS else {}),
            "base": lambda: radius_graph(pos, r),
            "base, one thread": lambda: radius_graph(pos, r, threads=1),
            "adaptive, random sigma": lambda: adaptive_graph(pos, random, r, TAU, FACTOR),
            "adaptive, smooth sigma": lambda: adaptive_graph(pos, smooth, r, TAU, FACTOR),
        }

    every = [builders(*frame) for frame in frames]
    times = timed(every, seconds)
    edges, *adaptive = (
        statistics.mean(builders[name]().shape[1] for builders in every)
        for name in ("base", *(f"adaptive, {name} sigma" for name in SIGMAS))
    )

    def per_edge(name: str) -> float:
        written = adaptive[SIGMAS.index(name)] / edges
        return times[f"adaptive, {name} sigma"] / times["base"] / written

    pos = frames[0][0]

    others = {name: times[name] for name in PEERS if name in times}
    moved = pos.nbytes + 2 * edges * np.dtype(np.int64).itemsize
    roofline = 1e3 * moved / per_second
    return {
        "particles": n,
        "dimensions": d,
        "dtype": kind,
        "mean degree": edges / n,
        "milliseconds": times,
        "over base": {name: taken / times["base"] for name, taken in others.items()},
        "base, nanoseconds per particle": 1e6 * times["base"] / n,
        "bytes moved at least": moved,
        "share of the roofline": roofline / times["base"],
        "adaptive over base": {
            name: times[f"adaptive, {name} sigma"] / times["base"] for name in SIGMAS
        },
        "adaptive over base per edge, random sigma": per_edge("random"),
        "adaptive over base per edge, smooth sigma": per_edge("smooth"),
    }


def _shown(results: Path) -> list[dict[str, Any]]:
    """The systems in float32, small ones first, 2D before 3D."""
    rows = [r for r in json.loads(results.read_text())["systems"] if r["dtype"] == "float32"]
    return sorted(rows, key=lambda row: (row["dimensions"], row["particles"]))


def plot(results: Path) -> Path:
    """How many times as fast as each peer, and the cost per particle."""
    rows = _shown(results)
    figure = Figure(figsize=(6.6, 2.8), layout="constrained")
    ratios, cost = figure.subplots(1, 2)
    for name, tint in zip(PEERS, SERIES, strict=False):
        for d, dash in ((2, "-"), (3, "--")):
            own = [r for r in rows if r["dimensions"] == d and name in r["over base"]]
            ratios.plot(
                [r["particles"] for r in own],
                [r["over base"][name] for r in own],
                color=tint,
                linestyle=dash,
                marker="o",
                markersize=3,
                label=name if d == 2 and own else None,
            )
    for d, dash in ((2, "-"), (3, "--")):
        own = [
            (r["particles"], r["base, nanoseconds per particle"])
            for r in rows
            if r["dimensions"] == d
        ]
        cost.plot(
            *zip(*own, strict=True),
            color=SERIES[1],
            linestyle=dash,
            marker="o",
            markersize=3,
            label=f"{d}D",
        )
    ratios.axhline(10, color="#9aa3ad", linewidth=0.8)
    ratios.set(title="time of a peer over ours (3D dashed)", xscale="log", yscale="log")
    ratios.set_yticks([5, 10, 20, 50, 100, 200, 500], minor=False)
    ratios.yaxis.set_major_formatter("{x:g}×")
    ratios.yaxis.set_minor_formatter("")
    cost.set(title="nanoseconds per particle", xscale="log", ylim=(0, None))
    for axes in (ratios, cost):
        axes.set_xlabel("particles")
        axes.legend(fontsize=7)
    path = Path(__file__).parents[1] / "docs" / "images" / f"{results.stem}.png"
    figure.savefig(path, dpi=150)
    return path


def _three_digits(value: float) -> str:
    return f"{value:.3g}" if value < 100 else f"{float(f'{value:.3g}'):,.0f}"


def table(results: Path) -> str:
    """Milliseconds of ours and of each peer, and how many times as long it took, in Markdown."""
    rows = _shown(results)
    names = [name for name in PEERS if any(name in r["over base"] for r in rows)]
    lines = [
        "| particles | neighbours | AdaptGNS | " + " | ".join(names) + " | adaptive, per edge |",
        "|" + "---|" * (len(names) + 4),
    ]
    for row in rows:
        times, over = row["milliseconds"], row["over base"]
        cells = [
            f"{row['particles']:,} in {row['dimensions']}D",
            f"{row['mean degree']:.1f}",
            f"{_three_digits(times['base'])} ms",
            *(
                f"{_three_digits(times[n])} ms, {_three_digits(over[n])}×" if n in over else "–"
                for n in names
            ),
            f"{max(row[f'adaptive over base per edge, {s} sigma'] for s in SIGMAS):.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="where to write the figures as JSON")
    parser.add_argument("--quick", action="store_true", help="a fifth of the time, no large system")
    parser.add_argument("--plot", type=Path, help="draw the figures of this JSON, measure nothing")
    options = parser.parse_args()
    if options.plot:
        print(plot(options.plot), table(options.plot), sep="\n")
        return
    per_second = bandwidth()
    versions = {name: version(name) for name in ("numpy", "scipy")}
    for name, package in (
        ("vesin", "vesin"),
        ("matscipy", "matscipy"),
        ("freud", "freud-analysis"),
        ("torch_cluster", "torch-cluster"),
    ):
        with suppress(PackageNotFoundError):
            versions[name] = version(package)
    result: dict[str, Any] = {
        "machine": {**machine(), **versions, "bytes_per_second": per_second},
        "systems": [],
    }
    print(f"bandwidth {per_second / 1e9:.1f} GB/s")
    for n, d, degree in [*SYSTEMS, *COST]:
        if options.quick and n > 100_000:
            continue
        kinds = ("float32", "float64") if n <= LARGEST_OF_PEERS else ("float32",)
        for kind in kinds:
            row = measure(n, d, degree, kind, 0.6 if options.quick else 3.0, per_second)
            result["systems"].append(row)
            over = "  ".join(f"{name} {ratio:.1f}x" for name, ratio in row["over base"].items())
            print(
                f"{n:9,} {d}D {kind} {row['milliseconds']['base']:9.4f} ms "
                f"{row['base, nanoseconds per particle']:5.1f} ns a particle, "
                f"{row['share of the roofline']:.0%} of the roofline  {over}  adaptive per edge "
                f"{row['adaptive over base per edge, random sigma']:.2f} random "
                f"{row['adaptive over base per edge, smooth sigma']:.2f} smooth"
            )
            if options.out:  # as far as it has come
                replace_text(options.out, json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
