"""Times a step of the network against the plain form of the same, and measures its memory.

    python benchmarks/step.py [--out benchmarks/results/step.json] [--rounds 15] [--device cuda]
    python benchmarks/step.py --plot benchmarks/results/step.json

The plain form is what peers compute: a concatenation of gathered ends, linear layers and a sum by
``index_add_``, with the same weights. All forms are timed in turn, round after round, and the
medians compared. Memory is that of a process that takes one training step, above what it has
before; on a GPU, the most that tensors take of it. The plot is written to
docs/images.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import torch
from machine import machine, resident
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn.functional import softplus

from adaptgns import fused
from adaptgns._core import radius_graph
from adaptgns.network import VARIANCE_FLOOR, EncodeProcessDecode
from adaptgns.palette import SERIES
from adaptgns.segment import Graph

SIZES = {
    "width 128, 10 steps, 951 particles": (951, 5_865, 128, 2, 10),
    "width 128, 10 steps, 359 particles": (359, 2_237, 128, 2, 10),
    "width 128, 10 steps, 5,000 particles": (5_000, 30_750, 128, 2, 10),
    "width 64, 5 steps, 722 particles": (722, 3_430, 64, 1, 5),
}
"""Particles, edges (about, self-edges included), width, hidden layers, message-passing steps"""
TINY = "nothing to speak of"
GPU_SIZES = {
    "width 128, 10 steps, 1,000 particles": (1_000, 7_800, 128, 2, 10),
    "width 128, 10 steps, 20,000 particles": (20_000, 156_000, 128, 2, 10),
    "width 128, 10 steps, 200,000 particles": (200_000, 1_560_000, 128, 2, 10),
}
FORMS = ("plain", "torch", "core", "plain bf16", "torch bf16", "core bf16")
"""plain: see above; torch: what runs on GPUs; core: what runs on CPUs; bf16: plain under autocast,
the others as ``--precision bf16`` has them"""
GPU_FORMS = ("plain", "torch", "compiled", "plain bf16", "torch bf16", "compiled bf16")
"""compiled: torch by torch.compile, any number of particles and edges"""


def plain(net: EncodeProcessDecode, nodes: Tensor, edges: Tensor, graph: Graph) -> list[Tensor]:
    """The network as peers write it."""
    assert net.edge_encoder is not None
    assert net.variance_head is not None
    nodes, edges = net.node_encoder(nodes), net.edge_encoder(edges)
    for layer in net.layers:
        messages = layer.edge_mlp(
            torch.cat([nodes[graph.receivers], nodes[graph.senders], edges], dim=1)
        )
        incoming = torch.zeros_like(nodes, dtype=messages.dtype)
        incoming = incoming.index_add_(0, graph.receivers, messages)
        nodes = nodes + layer.node_mlp(torch.cat([incoming, nodes], dim=1))
        edges = edges + messages
    return [net.decoder(nodes), softplus(net.variance_head(nodes)).squeeze(1) + VARIANCE_FLOOR]


class Case:
    def __init__(self, size: str, device: str) -> None:
        sizes = {**SIZES, **GPU_SIZES, TINY: (20, 60, 8, 1, 2)}
        particles, edges, width, hidden_layers, steps = sizes[size]
        self.device = torch.device(device)
        torch.manual_seed(0)
        rng = np.random.default_rng(0)
        self.net = EncodeProcessDecode(
            30,
            3,
            2,
            latent=width,
            hidden_layers=hidden_layers,
            steps=steps,
            edges=True,
            variance=True,
        ).to(self.device)
        self.compiled = torch.compile(self.net, dynamic=True)
        positions = rng.random((particles, 2))
        radius = ((edges / particles - 1) / (np.pi * particles)) ** 0.5
        self.graph = Graph.from_numpy(
            *radius_graph(positions, radius, self_edges=True, return_offsets=True)
        ).to(self.device)
        self.nodes = torch.randn(particles, 30).to(self.device)
        self.edges = torch.randn(len(self.graph.senders), 3).to(self.device)

    def outputs(self, form: str) -> list[Tensor]:
        fused.applies = lambda _: form.startswith("core")
        low = "bf16" in form
        if form.startswith("plain"):
            with torch.autocast(self.device.type, torch.bfloat16) if low else nullcontext():
                return plain(self.net, self.nodes, self.edges, self.graph)
        self.net.precision = "bf16" if low else "float32"
        net = self.compiled if form.startswith("compiled") else self.net
        prediction = net(self.nodes, self.edges, self.graph)
        return [prediction.acceleration, prediction.variance]

    def wait(self) -> None:
        """Until the device has done all that it was asked for."""
        if self.device.type == "cuda":
            torch.cuda.synchronize()

    def forward(self, form: str) -> None:
        with torch.inference_mode():
            self.outputs(form)
        self.wait()

    def step(self, form: str) -> None:
        self.net.zero_grad()
        acceleration, variance = self.outputs(form)
        ((acceleration.square().sum(1) / variance).mean() + variance.log().mean()).backward()
        self.wait()


def medians(calls: dict[str, Callable[[], None]], rounds: int) -> dict[str, float]:
    """Milliseconds of each call, timed in turn."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for round_number in range(rounds + 2):
        for name, call in calls.items():
            call()  # what another form has freed is not paid for here
            started = time.perf_counter()
            call()
            if round_number >= 2:
                times[name].append(1e3 * (time.perf_counter() - started))
    return {name: statistics.median(values) for name, values in times.items()}


def peak_memory(size: str, form: str, device: str) -> float:
    """MiB that a training step takes, the median of three processes that take one."""
    command = [sys.executable, __file__, "--device", device, "--memory", size, form]
    return statistics.median(
        float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        for _ in range(3)
    )


def print_memory(size: str, form: str, device: str) -> None:
    case = Case(size, device)
    if device == "cuda":
        before = torch.cuda.memory_allocated()
        case.step(form)
        print((torch.cuda.max_memory_allocated() - before) / 2**20)
        return
    Case(TINY, device).step(form)  # libraries are loaded
    before = resident("VmRSS")
    case.step(form)
    print(resident("VmHWM") - before)


def measure(rounds: int, device: str) -> dict[str, object]:
    results = {}
    sizes, forms = (GPU_SIZES, GPU_FORMS) if device == "cuda" else (SIZES, FORMS)
    for size in sizes:
        case = Case(size, device)
        with torch.inference_mode():
            exact = case.outputs("plain")
        rounds_here = max(3, rounds // 3) if len(case.nodes) > 1_000 else rounds
        forward = medians({form: partial(case.forward, form) for form in forms}, rounds_here)
        step = medians({form: partial(case.step, form) for form in forms}, rounds_here)
        rows = {}
        for form in forms:
            with torch.inference_mode():
                outputs = case.outputs(form)
            off = [float((a - b).norm() / b.norm()) for a, b in zip(outputs, exact, strict=True)]
            rows[form] = {
                "forward_ms": forward[form],
                "step_ms": step[form],
                "forward_ratio": forward["plain"] / forward[form],
                "step_ratio": step["plain"] / step[form],
                "step_mib": peak_memory(size, form, device),
                "relative_difference": max(off),
            }
        results[size] = {"edges": len(case.graph.senders), "forms": rows}
        for form, row in rows.items():
            print(f"{size:40} {form:12}", "  ".join(f"{k} {v:.3g}" for k, v in row.items()))
    return results


def draw(results: Path) -> Path:
    """A picture of ``results`` beside them: how many times as fast as the plain form."""
    sizes = json.loads(results.read_text())["sizes"]
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    for axes, part, title in zip(
        figure.subplots(1, 2, sharey=True),
        ("forward", "step"),
        ("forward", "forward and backward"),
        strict=True,
    ):
        forms = [form for form in next(iter(sizes.values()))["forms"] if form != "plain"]
        for number, (form, colour) in enumerate(zip(forms, SERIES, strict=False)):
            ratios = [row["forms"][form][f"{part}_ratio"] for row in sizes.values()]
            places = np.arange(len(sizes)) + (number - (len(forms) - 1) / 2) / (len(forms) + 1)
            axes.bar(places, ratios, 1 / (len(forms) + 1), color=colour, label=form)
        axes.axhline(1, color="#9aa3ad", linewidth=1)
        labels = [size.replace(", ", ",\n") for size in sizes]
        axes.set_xticks(range(len(sizes)), labels, fontsize=6)
        axes.set_title(title, fontsize=8, loc="left")
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("times as fast as the plain form", fontsize=8)
    figure.axes[1].legend(fontsize=7, frameon=False)
    picture = Path(__file__).parents[1] / "docs" / "images" / f"{results.stem}.png"
    figure.savefig(picture, dpi=200)
    return picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--plot", type=Path, metavar="RESULTS", help="draw these, measure nothing")
    parser.add_argument("--memory", nargs=2, metavar=("SIZE", "FORM"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory:
        print_memory(*options.memory, options.device)
        return
    if options.plot:
        print(draw(options.plot))
        return
    report = {
        "machine": machine(),
        "rounds": options.rounds,
        "sizes": measure(options.rounds, options.device),
    }
    if options.out:
        options.out.write_text(json.dumps(report, indent=1) + "\n")
        print(draw(options.out))


if __name__ == "__main__":
    main()
