"""The embedded data generator beside the published data sets: statistics and speed.

    python benchmarks/generate.py [--trajectories 30] [--threads 2]

Writes `results/generate.json` next to this file and prints the same as a table. Needs the
`bench` extra.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import networkx as nx
import numpy as np
from scipy.spatial import cKDTree

from adaptgns._core import simulate

RADIUS = 0.015
# WaterDrop's 1,000 training, 30 validation and 30 test trajectories.
FULL_SET = 1060
# Standard deviations are per step over all frames, graph figures at frame 100. A relative
# mark is the largest factor either way, an absolute one the largest difference.
PUBLISHED = {
    "waterdrop": {
        "frames": 1000,
        "particles": 567.0,
        "degree": 5.42,
        "clustering": 0.494,
        "vel_std": [1.37e-3, 1.31e-3],
        "acc_std": [6.7e-5, 8.7e-5],
    },
    "sand": {
        "frames": 320,
        "particles": 1270.0,
        "degree": 6.76,
        "clustering": 0.500,
        "vel_std": [2.20e-3, 2.67e-3],
        "acc_std": [2.58e-4, 2.96e-4],
    },
}
FACTORS = {"particles": 1.30, "degree": 1.15, "vel_std": 2.0, "acc_std": 2.5}
DIFFERENCES = {"clustering": 0.08}
CURVE_FRAMES = (0, 20, 40, 50, 60, 80, 100, 150, 200, 300, 500, 999)


def degree_and_clustering(positions: np.ndarray) -> tuple[float, float]:
    """Mean degree and networkx's average clustering, without self-edges."""
    pairs = cKDTree(positions).query_pairs(RADIUS, output_type="ndarray")
    graph = nx.Graph(pairs.tolist())
    graph.add_nodes_from(range(len(positions)))
    return 2 * len(pairs) / len(positions), nx.average_clustering(graph)


def degree(positions: np.ndarray) -> float:
    return 2 * len(cKDTree(positions).query_pairs(RADIUS)) / len(positions)


def holds(name: str, measured: np.ndarray, published: np.ndarray) -> bool:
    if name in DIFFERENCES:
        return bool(np.all(np.abs(measured - published) <= DIFFERENCES[name]))
    ratio = measured / published
    # "Within 15 per cent" is symmetric as a difference, "within a factor 2" as a ratio.
    low = 2 - FACTORS[name] if FACTORS[name] < 2 else 1 / FACTORS[name]
    return bool(np.all((low <= ratio) & (ratio <= FACTORS[name])))


def compare(scene: str, trajectories: int, threads: int) -> dict[str, object]:
    published = PUBLISHED[scene]
    frames = int(published["frames"])  # type: ignore[call-overload]
    with ThreadPoolExecutor(threads) as pool:
        start = time.perf_counter()
        made = list(
            pool.map(lambda seed: simulate(scene, seed=seed, frames=frames)[0], range(trajectories))
        )
        seconds = time.perf_counter() - start

    counts = np.array([len(positions[0]) for positions in made])
    graphs = np.array([degree_and_clustering(positions[100]) for positions in made])
    velocities = [np.diff(positions.astype(np.float64), axis=0) for positions in made]
    accelerations = [np.diff(velocity, axis=0) for velocity in velocities]
    measured = {
        "particles": counts.mean(),
        "degree": graphs[:, 0].mean(),
        "clustering": graphs[:, 1].mean(),
        "vel_std": np.concatenate([v.reshape(-1, 2) for v in velocities]).std(axis=0),
        "acc_std": np.concatenate([a.reshape(-1, 2) for a in accelerations]).std(axis=0),
    }
    return {
        "frames": frames,
        "trajectories": trajectories,
        "statistics": {
            name: {
                "measured": np.round(value, 7).tolist(),
                "published": published[name],
                "holds": holds(name, np.asarray(value), np.asarray(published[name])),
            }
            for name, value in measured.items()
        },
        "spread": {
            "particles": counts.std().round(1),
            "degree": graphs[:, 0].std().round(3),
            "clustering": graphs[:, 1].std().round(4),
        },
        "degree_over_time": {
            frame: round(float(np.mean([degree(positions[frame]) for positions in made])), 3)
            for frame in CURVE_FRAMES
            if frame < frames
        },
        "seconds": round(seconds, 2),
        "milliseconds_per_frame_and_thread": round(
            seconds * threads / (trajectories * frames) * 1e3, 4
        ),
        "minutes_for_full_set": round(seconds / trajectories * FULL_SET / 60, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trajectories", type=int, default=30)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()

    results: dict[str, object] = {
        "machine": platform.machine(),
        "threads": arguments.threads,
        "full_set": FULL_SET,
    }
    for scene in PUBLISHED:
        result = compare(scene, arguments.trajectories, arguments.threads)
        results[scene] = result
        print(f"{scene}: {arguments.trajectories} trajectories of {result['frames']} frames")
        for name, row in result["statistics"].items():  # type: ignore[attr-defined]
            verdict = "holds" if row["holds"] else "FAILS"
            print(f"  {name:10}  {row['measured']!s:26}  {row['published']!s:20}  {verdict}")
        print(f"  degree over time {result['degree_over_time']}")
        print(f"  {FULL_SET} trajectories in {result['minutes_for_full_set']} minutes")
    path = Path(__file__).parent / "results" / "generate.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
