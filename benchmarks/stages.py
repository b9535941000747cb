"""Where a rollout step and a training step of the laptop preset spend their time.

    python benchmarks/stages.py [--out benchmarks/results/stages.json] [--data waterdrop]

Each stage counts without the stages within it; its figure is the median over the steps of all
rounds, in which the forms take turns. The torch form is the network as before the Rust core. Then
the speed of training, and the share of its time that it waits for data, with 0, 1 and 2 processes
that load them.
"""

from __future__ import annotations

import argparse
import functools
import json
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from machine import machine
from rich.console import Console
from torch import Tensor

from adaptgns import fit, fused, rollout, windows
from adaptgns.config import AdaptiveConfig, TrainConfig
from adaptgns.data.default import dataset_folder
from adaptgns.data.metadata import read_metadata
from adaptgns.data.trajectories import open_split
from adaptgns.network import EncodeProcessDecode
from adaptgns.policies import Adaptive, State
from adaptgns.presets import PRESETS
from adaptgns.segment import Graph
from adaptgns.simulator import Simulator
from adaptgns.threads import divide_threads

WARM_UP = 10
"""Steps at the start of each round that do not count"""


LOADING = ("waiting for data", "reading and noise", "batches", "graph", "edges by sender")
"""Stages of the main process that are done before a step can begin"""


class Clock:
    """Seconds in each stage, without those in the stages within it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.inner: list[float] = []
        self.steps: list[dict[str, float]] = []
        self.began = time.perf_counter()

    def step(self) -> None:
        """A step of the loop begins, and the one before, if any, is over."""
        now = time.perf_counter()
        self.steps.append({"all": now - self.began, **self.seconds})
        self.seconds.clear()
        self.began = now

    def take(self, count: int) -> list[dict[str, float]]:
        """Seconds of the last ``count`` steps; forgets all."""
        taken = self.steps[-count:]
        self.steps.clear()
        return taken

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self.inner.append(0.0)
        started = time.perf_counter()
        try:
            yield
        finally:
            taken = time.perf_counter() - started
            self.seconds[name] += taken - self.inner.pop()
            if self.inner:
                self.inner[-1] += taken

    def watch(self, owner: Any, attribute: str, name: str) -> None:
        """From now on every call of ``owner.attribute`` is the stage ``name``."""
        call = getattr(owner, attribute)

        @functools.wraps(call)
        def timed(*args: Any, **options: Any) -> Any:
            with self.stage(name):
                return call(*args, **options)

        static = isinstance(vars(owner).get(attribute), staticmethod)
        setattr(owner, attribute, staticmethod(timed) if static else timed)


CLOCK = Clock()


def watch_all() -> None:
    """What is called a stage."""
    for owner, attribute, name in (
        (State, "base", "graph"),
        (State, "expanded", "graph"),
        (windows, "radius_graph", "graph"),
        (fit, "radius_graph", "graph"),
        (Graph, "from_edges", "edges by sender"),
        (Simulator, "node_features", "features"),
        (Simulator, "edge_features", "features"),
        (Simulator, "advance", "integration"),
        (Simulator, "target", "targets"),
        (EncodeProcessDecode, "forward", "network"),
        (fused, "network_backward", "network, backward"),
        (windows.Windows, "__getitem__", "reading and noise"),
        (windows.Windows, "collate", "batches"),
        (fit, "training_loss", "loss"),
        (Tensor, "backward", "backward"),
        (torch.nn.utils, "clip_grad_norm_", "clipping"),
        (torch.optim.Adam, "step", "optimizer"),
        (torch.optim.Adam, "zero_grad", "optimizer"),
        (fit.Log, "write", "log"),
    ):
        CLOCK.watch(owner, attribute, name)
    batches = fit.training_batches

    def timed(*args: Any, **options: Any) -> Iterator[Any]:
        loader = iter(batches(*args, **options))
        for _ in range(len(loader)):
            CLOCK.step()
            with CLOCK.stage("waiting for data"):
                batch = next(loader)
            yield batch

    fit.training_batches = timed


def use(form: str, threads: int) -> None:
    """The network in the core or in torch."""
    fused.applies = lambda _: form == "core"
    divide_threads(threads)
    if form == "torch":
        torch.set_num_threads(threads)


def medians(steps: list[dict[str, float]]) -> dict[str, float]:
    """Milliseconds of each stage, of all together, and of the rest."""
    names = {name: None for step in steps for name in step}
    stages = {
        name: 1e3 * statistics.median(step.get(name, 0.0) for step in steps) for name in names
    }
    return stages | {"rest": 2 * stages["all"] - sum(stages.values())}


def train(
    config: TrainConfig, folder: Path, count: int, *, unrolled: bool
) -> list[dict[str, float]]:
    """``count`` steps that count, of the unrolled half of a training where ``unrolled``."""
    steps = 2 * (count + WARM_UP)
    if not unrolled:
        config = replace(config, unroll=1)
    config = replace(config, steps=steps, checkpoint_every=10 * steps)
    with tempfile.TemporaryDirectory() as run:
        trainer = fit.Trainer(
            config, read_metadata(folder), Path(run), train=open_split(folder, "train"), valid=None
        )
        trainer.step = steps // 2
        trainer.save = lambda: None  # type: ignore[method-assign]
        trainer.run(Console(quiet=True))
    CLOCK.step()
    return CLOCK.take(count)


def roll(config: TrainConfig, folder: Path, count: int) -> list[dict[str, float]]:
    """``count`` steps that count of an adaptive rollout, weights at random."""
    torch.manual_seed(0)
    simulator = fit.build_simulator(config, read_metadata(folder)).eval()
    trajectory = open_split(folder, "test")[0]
    taken = rollout.steps(simulator, trajectory, Adaptive(AdaptiveConfig()), WARM_UP + count)
    for _ in taken:
        CLOCK.step()
    return CLOCK.take(count)


def measure(data: str, rounds: int, count: int, threads: int) -> dict[str, Any]:
    config, folder = replace(PRESETS["laptop"], device="cpu"), dataset_folder(data)
    parts: dict[str, Callable[[], list[dict[str, float]]]] = {
        "rollout": functools.partial(roll, config, folder, count),
        "training, one frame": functools.partial(train, config, folder, count, unrolled=False),
        "training, three frames": functools.partial(train, config, folder, count, unrolled=True),
    }
    taken: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    for _ in range(rounds):
        for part, call in parts.items():
            for form in ("torch", "core"):
                use(form, threads)
                taken[part, form] += call()
    result: dict[str, Any] = {}
    for (part, form), counted in taken.items():
        stages = medians(counted)
        result.setdefault(part, {})[form] = stages
        total = stages["all"]
        print(f"{part}, {form}: {total:.2f} ms")
        for name, ms in sorted(stages.items(), key=lambda item: -item[1]):
            print(f"    {name:20} {ms:7.3f} ms {ms / total:6.1%}")
    return result


def loading(data: str, rounds: int, count: int, threads: int) -> dict[str, Any]:
    """Training steps a second by the number of loading processes, and the share of waiting."""
    config, folder = replace(PRESETS["laptop"], device="cpu"), dataset_folder(data)
    use("core", threads)
    taken: dict[int, list[dict[str, float]]] = defaultdict(list)
    for _ in range(rounds):
        for workers in (0, 1, 2):
            taken[workers] += train(replace(config, workers=workers), folder, count, unrolled=False)
    result = {}
    for workers, counted in taken.items():
        stages = medians(counted)
        # Unrolled steps build graphs, too; these do not, and what there is of it is loading.
        waiting = sum(stages.get(name, 0.0) for name in LOADING) / stages["all"]
        result[str(workers)] = {"steps_per_second": 1e3 / stages["all"], "waiting": waiting}
        print(f"{workers} workers: {1e3 / stages['all']:.1f} steps/s, {waiting:.1%} for data")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", default="waterdrop")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=60, help="that count, in each round")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    report: dict[str, Any] = {"machine": machine(), "rounds": options.rounds}
    threads = report["threads_used"] = options.threads
    watch_all()
    report["stages"] = measure(options.data, options.rounds, options.steps, threads)
    report["loading"] = loading(options.data, options.rounds, options.steps, threads)
    if options.out:
        options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
