"""Time the graph builders side by side with scipy's k-d tree.

    python benchmarks/graph.py [--out benchmarks/results/graph.json] [--quick]

Each line is one system of uniformly random particles, its radius chosen for a mean degree.
Builders take turns in one process, so that a busy machine slows all of them alike; figures
are medians. scipy's time is that of ``cKDTree(pos)`` and ``query_pairs`` together, which
finds each pair once and unsorted.
"""

import argparse
import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from scipy.spatial import cKDTree

from adaptgns.graph import adaptive_graph, radius_graph

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
TAU, FACTOR = 70.0, 1.267


def timed(builders: dict[str, Callable[[], Any]], seconds: float) -> dict[str, float]:
    """Median milliseconds of each builder over rounds of all, for about ``seconds``.

    Every timed call follows an untimed one of the same builder, as in a loop over steps: what the
    builder before it left in the caches and of the system's memory is not its own cost.
    """
    times: dict[str, list[float]] = {name: [] for name in builders}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(times["scipy"]) < 3:
        for name, build in builders.items():
            build()
            start = time.perf_counter()
            build()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in times.items()}


def measure(n: int, d: int, degree: float, kind: str, seconds: float) -> dict[str, Any]:
    rng = np.random.default_rng(n + d)
    pos = rng.random((n, d)).astype(kind)
    ball = math.pi if d == 2 else 4 / 3 * math.pi
    r = (degree / (n * ball)) ** (1 / d)
    random = rng.random(n).astype(kind)
    smooth = np.sin(2 * math.pi * pos).sum(axis=1) + d

    def adaptive(sigma: Any) -> Any:
        return adaptive_graph(pos, sigma, r, TAU, FACTOR)

    times = timed(
        {
            "scipy": lambda: cKDTree(pos).query_pairs(r, output_type="ndarray"),
            "base": lambda: radius_graph(pos, r),
            "base, one thread": lambda: radius_graph(pos, r, threads=1),
            "adaptive, random sigma": lambda: adaptive(random),
            "adaptive, smooth sigma": lambda: adaptive(smooth),
        },
        seconds,
    )
    edges = radius_graph(pos, r).shape[1]

    def per_edge(name: str, sigma: Any) -> float:
        return times[name] / adaptive(sigma).shape[1] / (times["base"] / edges)

    return {
        "particles": n,
        "dimensions": d,
        "dtype": kind,
        "mean degree": edges / n,
        "milliseconds": times,
        "scipy over base": times["scipy"] / times["base"],
        "scipy over base, one thread": times["scipy"] / times["base, one thread"],
        "adaptive over base per edge, random sigma": per_edge("adaptive, random sigma", random),
        "adaptive over base per edge, smooth sigma": per_edge("adaptive, smooth sigma", smooth),
    }


def machine() -> dict[str, Any]:
    model = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = lines[0].split(":", 1)[1].strip() if lines else model
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "load before": os.getloadavg()[0],
        "system": platform.system(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="where to write the figures as JSON")
    parser.add_argument("--quick", action="store_true", help="a fifth of the time, no large system")
    options = parser.parse_args()
    result: dict[str, Any] = {"machine": machine(), "systems": []}
    print("     N  d dtype    degree   scipy ms    base ms   x  (1 thr)  adaptive/base per edge")
    for n, d, degree in SYSTEMS:
        if options.quick and n > 100_000:
            continue
        for kind in ("float32", "float64"):
            row = measure(n, d, degree, kind, 0.6 if options.quick else 3.0)
            result["systems"].append(row)
            ms = row["milliseconds"]
            print(
                f"{n:8} {d} {kind:8} {row['mean degree']:5.1f} {ms['scipy']:10.3f} "
                f"{ms['base']:10.4f} {row['scipy over base']:5.1f} "
                f"({row['scipy over base, one thread']:4.1f})   "
                f"{row['adaptive over base per edge, random sigma']:.2f} random  "
                f"{row['adaptive over base per edge, smooth sigma']:.2f} smooth"
            )
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
