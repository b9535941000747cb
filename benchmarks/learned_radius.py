"""A radius that each particle learns for itself: whether it can be trained, and whether it helps.

    python benchmarks/learned_radius.py [--out benchmarks/results/learned_radius.json]

A third head beside those of the acceleration and the variance says how far each particle sees one
step later, LOW to HIGH times the base radius; an edge is there where one of its ends sees the
other, as in the adaptive graph. Whether it is there has no derivative, so in training a message
counts by a gate, g = sigmoid((max(r_i, r_j) - d_ij) / T) with lengths in base radii. Two forms:

- soft: messages are multiplied by g, and T falls until there is little between 0 and 1;
- straight: messages are there or not, as at test, and only the derivative is that of g.

Both hold the number of edges to that of the fixed graph by a price on them: a multiplier that rises
while there are more, and falls, below zero if need be, while there are fewer.

All arms start from the pretrained model of the data set and see the same windows, noise and loss,
for as many steps: on the fixed graph, on the paper's adaptive one, on the learned ones. At test all
gates are hard. Trained arms and what was measured of them lie in ``runs/learned_radius``; what is
there is not made again.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import torch
from machine import machine
from numpy.typing import NDArray
from scipy.stats import t as student
from torch import Tensor, nn

from adaptgns import fused
from adaptgns.checkpoint import Checkpoint, read_checkpoint
from adaptgns.config import HISTORY, AdaptiveConfig, to_json
from adaptgns.data.default import dataset_folder
from adaptgns.data.trajectories import Trajectories, Trajectory, open_split
from adaptgns.graph import adaptive_graph, radius_graph
from adaptgns.losses import training_loss
from adaptgns.metrics import edge_counts, position_mse, spearman
from adaptgns.network import VARIANCE_FLOOR, InteractionLayer, Prediction, mlp
from adaptgns.periodic import minimum_image
from adaptgns.policies import Adaptive, Edges, Fixed, Policy, State
from adaptgns.rollout import steps, to_sigma
from adaptgns.segment import Graph, at_receivers, at_senders, sum_at_receivers
from adaptgns.simulator import Simulator
from adaptgns.windows import Batch, Windows, training_batches

Arm = Literal["fixed", "adaptive", "soft", "straight"]
LEARNED = ("soft", "straight")

LOW, HIGH = 0.8, 1.5
"""What a particle may see, in base radii."""
WARM, COLD = 0.1, 0.02
"""The gates' T at the first step and from SETTLED of the steps on, in base radii; between them it
falls by the same factor each step."""
SETTLED = 0.8
CUT = 4.0
"""Edges longer than the radius by this many T are left out: their gates are below 1.8 %."""
RISE, PUSH = 0.05, 3.0
"""How much the price of the edges changes each step, and is moved beside that, for each share of
edges too many."""
UNROLL, PARTICLES = 2, 600
"""Frames each sample predicts one after the other, and particles of a batch at most: less than in
the pretraining, for the time."""
HEAD_LR = 10.0
"""Learning rate of the radius head, which starts untrained, in units of the others'."""
WARMUP = 100
"""Steps of linear increase of the learning rate."""
LOG_EVERY = 100
MARKS = (50, 100, 200)
ONE_STEP_EVERY = 20
NEIGHBOURS = ((0, 0), (1, 2), (3, 4), (5, 6), (7, 9))
TRAINING_EVERY = 8
"""Training trajectories between those whose radii are looked at"""


class Reaching(Simulator):
    """A simulator that also says how far every particle should see one step later."""

    reach: Tensor
    """``[N]`` of the last call, base radii"""

    def __init__(self, checkpoint: Checkpoint) -> None:
        config = checkpoint.config
        super().__init__(config.model, checkpoint.metadata, noise=config.noise, variance=True)
        self.load_state_dict(checkpoint.group("model"))
        self.head = mlp(config.model.latent, config.model.latent, 1, 1, norm=False)
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)  # at first all see one base radius
        nn.init.constant_(last.bias, math.log((1 - LOW) / (HIGH - 1)))

    def forward(
        self,
        window: Tensor,
        particle_type: Tensor,
        graph: Graph | None,
        material: Tensor | None = None,
        gates: Tensor | None = None,
    ) -> Prediction:
        """As the simulator's, every message counting by its gate ``[E]``."""
        assert graph is not None
        node_features = self.node_features(window, particle_type, material)
        edge_features = self.edge_features(window, graph)
        if gates is None:
            perceptrons = [*self.network._perceptrons(), self.head]
            outputs = fused.network(perceptrons, node_features, edge_features, graph, heads=3)
        else:
            nodes = self.network.node_encoder(node_features)
            edges = self.network.edge_encoder(edge_features)
            for layer in self.network.layers:
                nodes, edges = gated_step(layer, nodes, edges, graph, gates)
            outputs = [head(nodes) for head in (*self.network._heads(), self.head)]
        acceleration, variance, reach = outputs
        self.reach = LOW + (HIGH - LOW) * reach.sigmoid().squeeze(1)
        variance = nn.functional.softplus(variance).squeeze(1) + VARIANCE_FLOOR
        return Prediction(acceleration, variance)


def gated_step(
    layer: InteractionLayer, nodes: Tensor, edges: Tensor, graph: Graph, gates: Tensor
) -> tuple[Tensor, Tensor]:
    """One step of message passing. The edges' own latents need no gate: they are heard of through
    the messages alone."""
    first = layer.edge_mlp[0]
    receiver_part, sender_part, edge_part = first.weight.chunk(3, dim=1)
    hidden = nn.functional.linear(edges, edge_part, first.bias)
    hidden = hidden + at_receivers(nn.functional.linear(nodes, receiver_part), graph)
    hidden = hidden + at_senders(nn.functional.linear(nodes, sender_part), graph)
    messages = layer.edge_mlp[1:](hidden)
    incoming = sum_at_receivers(messages * gates[:, None], graph)
    return nodes + layer.node_mlp(torch.cat([incoming, nodes], dim=1)), edges + messages


@dataclass(frozen=True)
class Wiring:
    """A graph, and what is told of its edges."""

    graph: Graph
    gates: Tensor | None = None
    """``[E]``"""
    soft: Tensor | None = None
    """Sum of g over the number of edges of the fixed graph, no self-edges"""
    hard: float = 1.0
    """Number of edges with hard gates over that"""


def base_wiring(simulator: Simulator, positions: NDArray[np.float32], ptr: Any) -> Wiring:
    return Wiring(Graph.from_numpy(*build(simulator, positions, simulator.radius, ptr)))


def build(simulator: Simulator, positions: Any, radius: Any, ptr: Any) -> Edges:
    return radius_graph(
        positions,
        radius,
        ptr=ptr,
        box=simulator.metadata.box,
        self_edges=simulator.config.self_edges,
        return_offsets=True,
    )


def gated_wiring(
    simulator: Simulator, window: Tensor, ptr: Any, reach: Tensor, temperature: float, form: str
) -> Wiring:
    """The graph of ``window`` ``[N, H, d]`` for ``reach`` ``[N]``, with gates of the ``form``."""
    positions = window[:, -1].detach()
    # With all edges of the fixed graph, which are counted, too.
    radii = simulator.radius * (reach.detach() + CUT * temperature).clamp_min(1).double()
    graph = Graph.from_numpy(*build(simulator, positions.numpy(), radii.numpy(), ptr))
    across = positions[graph.senders] - positions[graph.receivers]
    distance = simulator.displacement(across, torch.zeros(())).norm(dim=1) / simulator.radius
    between = graph.senders != graph.receivers
    seen = torch.maximum(at_senders(reach[:, None], graph), at_receivers(reach[:, None], graph))
    gap = seen.squeeze(1) - distance
    soft = torch.where(between, (gap / temperature).sigmoid(), 1.0)
    hard = ((gap >= 0) | ~between).float()
    gates = soft if form == "soft" else hard + soft - soft.detach()
    fixed = float((between & (distance <= 1)).sum())
    return Wiring(
        graph, gates, soft[between].sum() / fixed, float(hard.detach()[between].sum()) / fixed
    )


class Tuning:
    """The training of one arm."""

    def __init__(self, arm: Arm, checkpoint: Checkpoint, options: argparse.Namespace) -> None:
        self.arm = arm
        # The base graph of the window one frame earlier comes with every batch, in all arms.
        self.config = replace(
            checkpoint.config,
            graph="adaptive",
            steps=options.steps,
            lr=options.lr,
            seed=options.seed,
            unroll=UNROLL,
            batch_particles=PARTICLES,
        )
        torch.manual_seed(options.seed)
        self.simulator = Reaching(checkpoint)
        head = list(self.simulator.head.parameters())
        others = [p for p in self.simulator.parameters() if all(p is not own for own in head)]
        self.optimizer = torch.optim.Adam([{"params": others}, {"params": head}], fused=True)
        self.step = 0
        self.price = self.owed = 0.0
        self.hard = 1.0
        train = open_split(dataset_folder(checkpoint.config.data), "train")
        self.windows = Windows(
            train, checkpoint.metadata, self.config, noise=checkpoint.config.noise
        )

    @property
    def learned(self) -> bool:
        return self.arm in LEARNED

    def temperature(self) -> float:
        return WARM * (COLD / WARM) ** min(1.0, self.step / (SETTLED * self.config.steps))

    def learning_rate(self) -> float:
        if self.step < WARMUP:
            return self.config.lr * (self.step + 1) / WARMUP
        progress = (self.step - WARMUP) / (self.config.steps - WARMUP)
        return self.config.lr * 0.5 * (1 + math.cos(math.pi * progress))

    def run(self) -> list[dict[str, float]]:
        """Train; what was logged on the way."""
        log: list[dict[str, float]] = []
        recent: list[dict[str, float]] = []
        began = time.perf_counter()
        for batch in training_batches(self.windows, self.config, 0, pin=False):
            for group, factor in zip(self.optimizer.param_groups, (1, HEAD_LR), strict=True):
                group["lr"] = factor * self.learning_rate()
            self.optimizer.zero_grad()
            loss, told = self.loss(batch)
            loss.backward()
            nn.utils.clip_grad_norm_(self.simulator.parameters(), self.config.clip or math.inf)
            self.optimizer.step()
            self.step += 1
            recent.append(told)
            if self.learned:
                excess = self.hard - 1
                self.owed += RISE * excess
                self.price = self.owed + PUSH * excess
            if self.step % LOG_EVERY == 0 or self.step == 1:
                means = {name: float(np.mean([each[name] for each in recent])) for name in told}
                seconds = time.perf_counter() - began
                log.append({"step": self.step, **means, "seconds": seconds})
                print(self.arm, short(log[-1]), flush=True)
                recent.clear()
        return log

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """The loss over the unrolled frames, as in training, and what the edges cost."""
        simulator, mobile = self.simulator, batch.mobile
        ptr, window = batch.ptr.numpy(), batch.window
        earlier = None
        if self.arm != "fixed":
            with torch.set_grad_enabled(self.learned):
                earlier = simulator(
                    batch.earlier_window, batch.particle_type, batch.graph, batch.material
                )
        losses, errors, ratios, hard, reaches = [], [], [], [], []
        variance = None
        for following in batch.following.unbind(1):
            wiring = self.wiring(window, ptr, earlier, mobile)
            if wiring.soft is not None:
                ratios.append(wiring.soft)
                reaches.append(simulator.reach.detach())
            hard.append(wiring.hard)
            earlier = simulator(
                window, batch.particle_type, wiring.graph, batch.material, wiring.gates
            )
            target = simulator.target(window, following)
            losses.append(
                training_loss(self.config.loss, earlier, target, mobile, variance=variance)
            )
            errors.append(float((earlier.acceleration - target).detach().square().mean()))
            variance = earlier.variance if variance is None else variance
            position = simulator.advance(window, earlier.acceleration)
            position = torch.where(mobile[:, None], position, following)
            window = torch.cat([window[:, 1:], position[:, None]], dim=1)
        loss = torch.stack(losses).mean()
        self.hard = float(np.mean(hard))
        told = {"loss": float(loss.detach()), "mse": errors[0], "edges": self.hard}
        if ratios:
            soft = torch.stack(ratios).mean()
            loss = loss + self.price * (soft - 1)
            told |= {"soft_edges": float(soft.detach()), "price": self.price}
            told |= {"temperature": self.temperature(), **spread(torch.cat(reaches).numpy())}
        return loss, told

    def wiring(self, window: Tensor, ptr: Any, earlier: Prediction | None, mobile: Any) -> Wiring:
        simulator = self.simulator
        if self.learned:
            return gated_wiring(
                simulator, window, ptr, simulator.reach, self.temperature(), self.arm
            )
        positions = np.ascontiguousarray(window[:, -1].detach().numpy())
        if earlier is None or self.arm == "fixed":
            return base_wiring(simulator, positions, ptr)
        edges = adaptive_graph(
            positions,
            to_sigma(earlier),
            simulator.radius,
            self.config.adaptive.tau,
            self.config.adaptive.factor,
            ptr=ptr,
            box=simulator.metadata.box,
            self_edges=simulator.config.self_edges,
            eligible=mobile.numpy(),
            return_offsets=True,
        )
        return Wiring(Graph.from_numpy(*edges))


def spread(reach: NDArray[np.float32]) -> dict[str, float]:
    """The distribution of radii, base radii, and the shares within 2 % of the range at its ends."""
    margin = 0.02 * (HIGH - LOW)
    low, median, high = np.percentile(reach, (5, 50, 95))
    return {
        "reach": float(reach.mean()),
        "reach_std": float(reach.std()),
        "reach_5": float(low),
        "reach_50": float(median),
        "reach_95": float(high),
        "at_low": float((reach < LOW + margin).mean()),
        "at_high": float((reach > HIGH - margin).mean()),
    }


def noise_to_signal(tuning: Tuning, batches: int) -> dict[str, float | None]:
    """For the parameters of the radius head and for all others, how large the noise of one batch's
    gradient is beside its mean, sqrt(tr(covariance) / |mean|^2); None where the mean cannot be told
    from zero. The squared length of the mean is freed of its own noise."""
    simulator = tuning.simulator
    groups = {
        "radius head": list(simulator.head.parameters()),
        "network": [*simulator.type_embedding.parameters(), *simulator.network.parameters()],
    }
    seen: dict[str, list[Tensor]] = {name: [] for name in groups}
    config = replace(tuning.config, steps=batches, seed=tuning.config.seed + 1)
    for batch in training_batches(tuning.windows, config, 0, pin=False):
        simulator.zero_grad()
        tuning.loss(batch)[0].backward()
        for name, parameters in groups.items():
            seen[name].append(torch.cat([p.grad.flatten() for p in parameters]))  # type: ignore[union-attr]
    simulator.zero_grad()
    result: dict[str, float | None] = {}
    for name, gradients in seen.items():
        every = torch.stack(gradients).double()
        noise = float(every.var(dim=0).sum())
        signal = float(every.mean(dim=0).square().sum()) - noise / batches
        result[name] = math.sqrt(noise / signal) if signal > 0 else None
    return result


@dataclass(frozen=True)
class Learned:
    """Every particle sees as far as the model said one step ago, or another one drawn at random."""

    name: ClassVar[str] = "learned"
    needs_sigma: ClassVar[bool] = True
    simulator: Reaching
    rng: np.random.Generator | None = None
    """Deals the radii out anew at every step: as many of each, to whom it may be."""

    def edges(self, state: State) -> Edges:
        if state.sigma is None:
            return state.base()
        radii = state.radius * self.simulator.reach.numpy().astype(np.float64)
        return state.base(radii if self.rng is None else self.rng.permutation(radii))


@torch.no_grad()
def roll(
    simulator: Reaching, policy: Callable[[int], Policy], trajectories: Sequence[Trajectory]
) -> dict[str, Any]:
    """Errors, edges, and clumping of the rollouts, each a list over trajectories."""
    simulator.eval()
    found: dict[str, Any] = {f"mse@{mark}": [] for mark in MARKS}
    found |= {"edges": [], **{f"ratio@{mark}": [] for mark in MARKS}}
    for index, trajectory in enumerate(trajectories):
        taken = list(steps(simulator, trajectory, policy(index), MARKS[-1]))
        predicted = np.stack([step.positions for step in taken])
        mobile = simulator.metadata.mobile(trajectory.particle_type)
        true = trajectory.positions[HISTORY : HISTORY + len(taken)]
        error = position_mse(predicted, true, mobile, simulator.metadata.box)
        found["edges"].append(float(np.mean([step.edges for step in taken])))
        for mark in MARKS:
            row = slice(mark - 1, mark)
            counts = [
                edge_counts(each[row], simulator.radius, mobile, simulator.metadata.box)
                for each in (predicted, true)
            ]
            found[f"mse@{mark}"].append(float(error[mark - 1]))
            found[f"ratio@{mark}"].append(float((counts[0] / counts[1])[0]))
    return found


@torch.no_grad()
def one_step(
    simulator: Reaching, trajectories: Sequence[Trajectory], *, learned: bool, seed: int
) -> dict[str, Any]:
    """Errors of single steps from true positions under the fixed graph, and for a model that has
    ``learned`` radii, which come from the window one frame earlier, under those with hard and soft
    gates, dealt out anew, and under one radius for all that gives each frame as many edges; and
    what the radii go with."""
    simulator.eval()
    rng = np.random.default_rng(seed)
    errors: dict[str, list[NDArray[np.float32]]] = {}
    seen: dict[str, list[NDArray[np.float32]]] = {}
    for trajectory in trajectories:
        true = torch.from_numpy(trajectory.positions)
        kind = torch.from_numpy(trajectory.particle_type)
        mobile = simulator.metadata.mobile(trajectory.particle_type)
        for frame in range(HISTORY + 1, HISTORY + MARKS[-1], ONE_STEP_EVERY):
            before, window = (
                true[end - HISTORY : end].transpose(0, 1).contiguous() for end in (frame - 1, frame)
            )
            first = base_wiring(simulator, before[:, -1].contiguous().numpy(), None)
            sigma = to_sigma(simulator(before, kind, first.graph))
            reach = simulator.reach
            base = base_wiring(simulator, window[:, -1].contiguous().numpy(), None)
            wirings = {"fixed": base}
            if learned:
                dealt = reach[torch.from_numpy(rng.permutation(len(reach)))]
                gated = partial(gated_wiring, simulator, window, None)
                hard = gated(reach, COLD, "straight")
                wirings |= {
                    "hard": hard,
                    "soft, cold": gated(reach, COLD, "soft"),
                    "soft, warm": gated(reach, WARM, "soft"),
                    "dealt anew": gated(dealt, COLD, "straight"),
                    "one for all": gated(matched(simulator, window, hard), COLD, "straight"),
                }
            target = simulator.target(window, true[frame])
            for name, wiring in wirings.items():
                prediction = simulator(window, kind, wiring.graph, gates=wiring.gates)
                error = (prediction.acceleration - target).square().sum(1).numpy()[mobile]
                errors.setdefault(name, []).append(error)
            velocity = simulator.displacement(window[:, -1], window[:, -2])
            for name, values in {
                "reach": reach.numpy(),
                "sigma": sigma,
                "neighbours": base.graph.receiver_offsets.diff().numpy().astype(np.float32),
                "speed": velocity.norm(dim=1).numpy(),
                "acceleration": target.norm(dim=1).numpy(),
            }.items():
                seen.setdefault(name, []).append(values[mobile])
    pooled = {name: np.concatenate(values) for name, values in (seen | errors).items()}
    dim = simulator.metadata.dim
    found: dict[str, Any] = {"mse": {name: float(pooled[name].mean()) / dim for name in errors}}
    if learned:
        reach = pooled.pop("reach")
        found["reach"] = spread(reach)
        found["rank_correlation_of_reach"] = {
            name: spearman(reach, pooled[name]) for name in ("hard", *seen) if name in pooled
        }
    return found


def matched(simulator: Simulator, window: Tensor, wiring: Wiring) -> Tensor:
    """``[N]`` times the one radius at which there are as many edges as in ``wiring``."""
    assert wiring.gates is not None
    positions = window[:, -1].contiguous().numpy()
    (senders, receivers), _ = build(simulator, positions, HIGH * simulator.radius, None)
    across = minimum_image(positions[senders] - positions[receivers], simulator.metadata.box)
    distance = np.sort(np.linalg.norm(across, axis=1)) / simulator.radius  # self-edges first
    last = distance[int(wiring.gates.sum()) - 1]
    return torch.full((len(positions),), float(last) * (1 + 1e-6))


@torch.no_grad()
def by_neighbours(simulator: Reaching, trajectories: Sequence[Trajectory]) -> dict[str, Any]:
    """Radii on true positions by the number of neighbours within the base radius, and how they are
    correlated with sigma among particles with as many."""
    reaches, sigmas, counts = [], [], []
    for trajectory in trajectories:
        true = torch.from_numpy(trajectory.positions)
        kind = torch.from_numpy(trajectory.particle_type)
        for frame in range(HISTORY, HISTORY + MARKS[-1], ONE_STEP_EVERY):
            window = true[frame - HISTORY : frame].transpose(0, 1).contiguous()
            graph = base_wiring(simulator, window[:, -1].contiguous().numpy(), None).graph
            sigmas.append(to_sigma(simulator(window, kind, graph)))
            reaches.append(simulator.reach.numpy())
            counts.append(graph.receiver_offsets.diff().numpy() - simulator.config.self_edges)
    reach, sigma, count = (np.concatenate(each) for each in (reaches, sigmas, counts))
    found: dict[str, Any] = {"all": spread(reach)}
    for fewest, most in NEIGHBOURS:
        chosen = (count >= fewest) & (count <= most)
        found[f"{fewest} to {most}"] = {
            "share": float(chosen.mean()),
            "reach": float(reach[chosen].mean()),
            "reach_5_95": [float(each) for each in np.percentile(reach[chosen], (5, 95))],
            "rank_correlation_with_sigma": spearman(reach[chosen], sigma[chosen]),
        }
    return found


def beside(one: dict[str, Any], other: dict[str, Any]) -> dict[str, list[float]]:
    """The difference of two rollouts' means in percent of the second, and its 95 % interval over
    the trajectories."""
    result = {}
    for name, values in one.items():
        pairs = 100 * (np.array(values) - np.array(other[name])) / np.mean(other[name])
        half = student.ppf(0.975, len(pairs) - 1) * pairs.std(ddof=1) / math.sqrt(len(pairs))
        mean = pairs.mean()
        result[name] = [float(each) for each in (mean, mean - half, mean + half)]
    return result


def short(values: dict[str, float]) -> dict[str, float]:
    return {name: float(f"{value:.4g}") for name, value in values.items()}


def trained(
    arm: Arm, checkpoint: Checkpoint, options: argparse.Namespace
) -> tuple[Reaching, dict[str, Any]]:
    """The model of an ``arm``, from its file where it is there, and what its training told."""
    made = {name: value for name, value in vars(options).items() if name in ("steps", "lr", "seed")}
    path = options.runs / f"{checkpoint.config.data}-{arm}.pt"
    if path.exists():
        kept = torch.load(path, weights_only=True)
        if kept["made"] != made:
            raise SystemExit(f"{path}: was made with {kept['made']}; remove it first")
        simulator = Reaching(checkpoint)
        simulator.load_state_dict(kept["model"])
        return simulator, kept["told"]
    tuning = Tuning(arm, checkpoint, options)
    told: dict[str, Any] = {}
    if tuning.learned:
        told["noise_to_signal_before"] = noise_to_signal(tuning, options.gradients)
    told["log"] = tuning.run()
    if tuning.learned:
        told["noise_to_signal_after"] = noise_to_signal(tuning, options.gradients)
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"made": made, "model": tuning.simulator.state_dict(), "told": told}, path)
    return tuning.simulator, told


def measured(
    name: str, simulator: Reaching, split: Trajectories, options: argparse.Namespace
) -> dict[str, Any]:
    """Single steps and rollouts of the model ``name`` on the graphs that concern it, from its file
    where it is there."""
    data = split.path.parent.name.split("-")[0]
    path = options.runs / f"{data}-{name}-{options.trajectories}.json"
    if path.exists():
        kept: dict[str, Any] = json.loads(path.read_text())
        return kept
    policies: dict[str, Callable[[int], Policy]] = {"fixed": lambda _: Fixed()}
    learned = name in LEARNED
    if name == "pretrained":
        policies["adaptive"] = lambda _: Adaptive(AdaptiveConfig())
    elif name == "adaptive":
        policies = {"adaptive": lambda _: Adaptive(AdaptiveConfig())}
    elif learned:
        policies["learned"] = lambda _: Learned(simulator)
        policies["dealt anew"] = lambda index: Learned(
            simulator, np.random.default_rng([options.seed, index])
        )
    trajectories = [split[index] for index in range(options.trajectories)]
    found: dict[str, Any] = {
        "one_step": one_step(simulator, trajectories, learned=learned, seed=options.seed),
        "rollouts": {},
    }
    print(name, json.dumps(found["one_step"]), flush=True)
    for graph, policy in policies.items():
        values = found["rollouts"][graph] = roll(simulator, policy, trajectories)
        means = {key: float(np.mean(each)) for key, each in values.items()}
        print(f"{name}, {graph}", short(means), flush=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(found))
    return found


def measure(data: str, options: argparse.Namespace) -> dict[str, Any]:
    checkpoint = read_checkpoint(Path(data))
    split = open_split(dataset_folder(data), "test")
    report: dict[str, Any] = {"checkpoint": to_json(checkpoint.config), "training": {}}
    models = {"pretrained": Reaching(checkpoint)}
    for arm in options.arms:
        models[arm], report["training"][arm] = trained(arm, checkpoint, options)
    report["one_step"], rollouts = {}, {}
    for name, simulator in models.items():
        found = measured(name, simulator, split, options)
        report["one_step"][name] = found["one_step"]
        if name in LEARNED:
            train = open_split(dataset_folder(data), "train")
            report.setdefault("by_neighbours", {})[name] = {
                "train": by_neighbours(simulator, list(islice(train, 0, None, TRAINING_EVERY))),
                "test": by_neighbours(simulator, list(islice(split, options.trajectories))),
            }
        rollouts |= {f"{name}, {graph}": each for graph, each in found["rollouts"].items()}
    control = rollouts["fixed, fixed"]
    report["rollouts"] = rollouts
    report["percent_beside_the_fixed_arm"] = {
        name: beside(found, control) for name, found in rollouts.items() if found is not control
    }
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", nargs="+", default=["waterdrop"])
    parser.add_argument("--arms", nargs="+", default=get_args(Arm), help="fixed among them")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--runs", type=Path, default=Path("runs/learned_radius"))
    parser.add_argument("--steps", type=int, default=1_200)
    parser.add_argument("--lr", type=float, default=3e-4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gradients", type=int, default=40, help="batches for their noise")
    parser.add_argument("--trajectories", type=int, default=8)
    options = parser.parse_args()
    torch.set_num_threads(1)
    report: dict[str, Any] = {"machine": machine()}
    settings = ("steps", "lr", "seed", "gradients", "trajectories")
    report["options"] = {name: vars(options)[name] for name in settings}
    report["constants"] = {
        "low": LOW, "high": HIGH, "warm": WARM, "cold": COLD, "settled": SETTLED,
        "rise": RISE, "push": PUSH, "warmup": WARMUP,
        "unroll": UNROLL, "particles": PARTICLES, "head_lr": HEAD_LR,
    }  # fmt: skip
    for data in options.data:
        report[data] = measure(data, options)
        if options.out:
            options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
