"""The viewer's page of 5,000 particles over 1,000 steps: bytes, and frames a second in Chromium.

    python benchmarks/viewer.py

The browser has no window and no graphics card. Writes `results/viewer.json` next to this file and
prints the same. Needs Chromium with its driver, and the `test` extra.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from selenium import webdriver

from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectory import Trajectory
from adaptgns.plot import viewer
from adaptgns.rollout_file import RolloutWriter

PARTICLES, STEPS, DT = 5000, 1000, 0.0025
RADII = {2: 0.0115, 3: 0.04}  # about ten neighbours at first in 2D, twenty in 3D
SECONDS = 4.0
SHOWN = {
    "sigma": "element('extra').checked = false",
    "error": "element('colour').value = 'error'",
    "speed": "element('colour').value = 'speed'",
    "sigma and extra edges": "element('colour').value = 'sigma'; element('extra').checked = true",
    "sigma and all edges": "element('edges').checked = true",
}


@dataclass(frozen=True)
class Step:
    """What a simulator gives for a step, as far as the page shows it."""

    positions: np.ndarray
    sigma: np.ndarray
    squared_error: np.ndarray
    edges: int = 0
    graph_ms: float = 0.0
    model_ms: float = 0.0


def course(dim: int, rng: np.random.Generator) -> np.ndarray:
    """``[6 + STEPS, PARTICLES, dim]`` positions of a block that falls, swirls and bounces."""
    side = int(np.ceil(PARTICLES ** (1 / dim)))
    lattice = np.stack(np.meshgrid(*[np.linspace(0.2, 0.65, side)] * dim), axis=-1)
    x = lattice.reshape(-1, dim)[:PARTICLES] + rng.normal(0, 2e-3, (PARTICLES, dim))
    v, frames = np.zeros_like(x), []
    for frame in range(6 + STEPS):
        v += rng.normal(0, 1.5e-4, x.shape) + 2e-4 * np.sin(8 * x[:, ::-1] + frame / 60)
        v[:, 1] -= 1.5e-5
        v *= 0.995
        x = x + v
        v = np.where((x < 0.1) | (x > 0.9), -0.5 * v, v)
        x = np.clip(np.where(x < 0.1, 0.2 - x, np.where(x > 0.9, 1.8 - x, x)), 0.1, 0.9)
        frames.append(x)
    return np.array(frames, dtype=np.float32)


def steps_of(trajectory: Trajectory, rng: np.random.Generator) -> Iterator[Step]:
    nothing = np.zeros(PARTICLES, dtype=np.float32)
    for number, true in enumerate(trajectory.positions[6:]):
        off = 1e-5 * number * np.sin(9 * true) + rng.normal(0, 1e-4, true.shape)
        sigma = np.exp(np.sin(9 * true[:, 0] + number / 40) + rng.normal(0, 0.1, PARTICLES))
        yield Step((true + off).astype(np.float32), sigma.astype(np.float32), nothing)


def write_page(dim: int, folder: Path) -> Path:
    rng = np.random.default_rng(0)
    metadata = Metadata(
        dim=dim,
        dt=DT,
        bounds=((0.1, 0.9),) * dim,
        periodic=(False,) * dim,
        radius=RADII[dim],
        velocity_mean=(0.0,) * dim,
        velocity_std=(1.0,) * dim,
        acceleration_mean=(0.0,) * dim,
        acceleration_std=(1.0,) * dim,
        kinematic_types=(3,),
    )
    trajectory = Trajectory("block", course(dim, rng), np.full(PARTICLES, 5))
    settings = {"policy": "adaptive", "adaptive": {"tau": 70.0, "factor": 1.267}}
    rollout, page = folder / f"{dim}.h5", folder / f"{dim}.html"
    with RolloutWriter(rollout, metadata=metadata, settings=settings) as writer:
        writer.add(trajectory, steps_of(trajectory, rng))
    viewer(rollout, page)
    return page


def measure(browser: Any, page: Path) -> dict[str, Any]:
    start = time.perf_counter()
    browser.get(page.as_uri())
    while not browser.execute_script("return Boolean(window.viewer && viewer.draws)"):
        time.sleep(0.05)
    loaded = time.perf_counter() - start
    rates = {}
    now = "return [viewer.draws, performance.now()]"
    for name, script in SHOWN.items():
        browser.execute_script(
            f"{script}; element('rate').value = 60; viewer.show(200); viewer.play(true)"
        )
        time.sleep(1.0)
        draws, at = browser.execute_script(now)
        time.sleep(SECONDS)
        more, later = browser.execute_script(now)
        browser.execute_script("viewer.play(false)")
        rates[name] = round(1000 * (more - draws) / (later - at), 1)
    return {
        "megabytes": round(page.stat().st_size / 1e6, 1),
        "every": browser.execute_script("return viewer.rollout.every"),
        "seconds_to_load": round(loaded, 1),
        "frames_per_second": rates,
    }


def main() -> None:
    options = webdriver.ChromeOptions()
    for argument in ("headless=new", "no-sandbox", "disable-gpu", "window-size=1280,860"):
        options.add_argument(f"--{argument}")
    # Named, since selenium would otherwise look for newer ones on the network.
    options.binary_location = shutil.which("chromium") or ""
    service = webdriver.ChromeService(executable_path=shutil.which("chromedriver"))
    report: dict[str, Any] = {
        "cpus": os.cpu_count(),
        "machine": platform.machine(),
        "load_before": os.getloadavg()[0],
        "particles": PARTICLES,
        "steps": STEPS,
    }
    with (
        tempfile.TemporaryDirectory() as name,
        webdriver.Chrome(options=options, service=service) as browser,
    ):
        report["browser"] = browser.capabilities["browserVersion"]
        for dim in RADII:
            report[f"{dim}D"] = measure(browser, write_page(dim, Path(name)))
    text = json.dumps(report, indent=1)
    (Path(__file__).parent / "results" / "viewer.json").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
