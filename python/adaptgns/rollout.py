"""`python -m adaptgns.rollout`: step a trained simulator forward over a split."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count as count_from

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from adaptgns.checkpoint import Checkpoint, read_checkpoint
from adaptgns.command import plain_errors
from adaptgns.config import HISTORY, RolloutConfig, to_json, torch_device
from adaptgns.data.default import dataset_folder
from adaptgns.data.errors import DataError
from adaptgns.data.trajectories import Trajectories, Trajectory, open_split
from adaptgns.network import Prediction
from adaptgns.policies import Edges, Policy, State, make_policy
from adaptgns.rollout_file import RolloutWriter
from adaptgns.segment import Graph
from adaptgns.simulator import Simulator


@dataclass(frozen=True)
class Step:
    """One step of a rollout."""

    positions: NDArray[np.float32]
    """``[N, d]``, predicted; kinematic particles as given"""
    sigma: NDArray[np.float32] | None
    """``[N]``, square root of the predicted variance, normalized units"""
    squared_error: NDArray[np.float32]
    """``[N]``, of the acceleration that would lead to the true next position, summed over
    dimensions, normalized units"""
    edges: int
    """Directed edges without self-edges"""
    graph_ms: float
    """Milliseconds for choosing the edges and bringing them to the model's device"""
    model_ms: float
    """Milliseconds for all forward passes of the step and the integration"""


def steps(
    simulator: Simulator,
    trajectory: Trajectory,
    policy: Policy,
    count: int,
    *,
    radius: float | None = None,
    teacher_forcing: bool = False,
    every: int = 1,
) -> Iterator[Step]:
    """The ``count`` steps that follow the first ``HISTORY`` frames of ``trajectory``; a policy that
    draws or remembers goes on from where it is.

    ``radius`` (length units of the data) changes the graph only: features stay divided by the
    radius the model was trained with. With ``teacher_forcing`` every step starts from the true
    positions, and of the steps only the first of ``every`` are returned; those between are made
    where the policy looks back.

    Where the positions become infinite or NaN, those of all later steps are NaN.

    Raises ValueError for a trajectory or a policy that does not go with the model.
    """
    _check(simulator, trajectory, policy, count)
    if every < 1 or (every > 1 and not teacher_forcing):
        raise ValueError(f"every: got {every}; accepted is 1, with teacher forcing 1 or more")
    device = simulator.lower.device
    true = torch.from_numpy(trajectory.positions).to(device)  # [T, N, d]
    particle_type = torch.from_numpy(trajectory.particle_type).to(device)
    given = trajectory.material_property
    material = None if given is None else torch.from_numpy(given).to(device)
    mobile = simulator.metadata.mobile(trajectory.particle_type)
    kinematic = torch.from_numpy(~mobile).to(device)
    window = true[:HISTORY].transpose(0, 1).contiguous()  # [N, H, d]
    sigma: NDArray[np.float32] | None = None
    asking = 0.0  # seconds that a policy's question for sigma took the model

    def predict(graph: Graph | None) -> Prediction:
        with torch.inference_mode():
            return simulator(window, particle_type, graph, material)  # type: ignore[no-any-return]

    def predict_sigma(edges: Edges) -> NDArray[np.float32]:
        nonlocal asking
        graph = Graph.for_inference(*edges).send(device)
        before = time.perf_counter()
        sigma = to_sigma(predict(graph))
        asking += time.perf_counter() - before
        return sigma

    for index in range(HISTORY, HISTORY + count):
        wanted = (index - HISTORY) % every == 0
        if not (wanted or policy.looks_back):
            window = torch.cat([window[:, 1:], true[index, :, None]], dim=1)
            continue
        started = time.perf_counter()
        asking = 0.0
        edges = graph = None
        if simulator.config.edges:
            state = State(
                history=window.cpu().numpy(),
                sigma=sigma,
                mobile=mobile,
                radius=simulator.radius if radius is None else radius,
                self_edges=simulator.config.self_edges,
                box=simulator.metadata.box,
                predict_sigma=predict_sigma,
            )
            edges = policy.edges(state)
            graph = Graph.for_inference(*edges).send(device)
        built = time.perf_counter()
        prediction = predict(graph)
        following = simulator.advance(window, prediction.acceleration)
        following = torch.where(kinematic[:, None], true[index], following)
        positions = following.cpu().numpy()
        finished = time.perf_counter()
        error = prediction.acceleration - simulator.target(window, true[index])
        if prediction.variance is not None:
            sigma = to_sigma(prediction)
        if wanted:
            yield Step(
                positions=positions,
                sigma=sigma,
                squared_error=error.square().sum(1).cpu().numpy(),
                edges=0 if edges is None else directed_edges(edges, simulator.config.self_edges),
                graph_ms=1e3 * (built - started - asking),
                model_ms=1e3 * (finished - built + asking),
            )
        if not (teacher_forcing or np.isfinite(positions).all()):
            yield from _lost(positions, sigma, index + 1 - HISTORY, count)
            return
        newest = true[index] if teacher_forcing else following
        window = torch.cat([window[:, 1:], newest[:, None]], dim=1)


def _check(simulator: Simulator, trajectory: Trajectory, policy: Policy, count: int) -> None:
    """Raise ValueError unless the policy and so many steps of the trajectory go with the model."""
    if policy.needs_sigma and simulator.network.variance_head is None:
        raise ValueError(
            f"policy: got {policy.name}, which needs the model's variance; this model was trained "
            "with the loss mse, which has none; accepted are fixed, knn, acceleration and "
            "divergence"
        )
    given = trajectory.material_property
    columns, known = 0 if given is None else given.shape[1], simulator.metadata.material_properties
    if columns != known:
        raise ValueError(
            f"data: trajectory {trajectory.name} has {columns} material properties; this model was "
            f"trained on {known}"
        )
    if policy.name != "fixed" and not simulator.config.edges:
        raise ValueError(
            f"policy: got {policy.name}; this model has no edges and takes fixed alone"
        )
    dim = trajectory.positions.shape[2]
    if dim != simulator.metadata.dim:
        raise ValueError(
            f"data: trajectory {trajectory.name} has {dim} dimensions; this model was trained on "
            f"{simulator.metadata.dim}"
        )
    frames = len(trajectory.positions)
    if not 0 < count <= frames - HISTORY:
        raise ValueError(
            f"count: {trajectory.name} has {frames} frames, so 1 to {frames - HISTORY} steps can "
            f"follow the first {HISTORY}; got {count}"
        )


def _lost(
    positions: NDArray[np.float32], sigma: NDArray[np.float32] | None, done: int, count: int
) -> Iterator[Step]:
    """The steps after the ``done`` first of ``count``, of particles whose positions are no longer
    finite: there is no graph of them."""
    nothing = np.full(len(positions), np.nan, np.float32)
    for _ in range(done, count):
        yield Step(
            positions=np.full_like(positions, np.nan),
            sigma=None if sigma is None else nothing,
            squared_error=nothing,
            edges=0,
            graph_ms=0.0,
            model_ms=0.0,
        )


def to_sigma(prediction: Prediction) -> NDArray[np.float32]:
    """``[N]`` standard deviations in normalized units, of a model with a variance head."""
    assert prediction.variance is not None
    sigma: NDArray[np.float32] = prediction.variance.detach().sqrt().cpu().numpy()
    return sigma


def directed_edges(edges: Edges, self_edges: bool) -> int:
    """Number of directed edges between different particles."""
    index, offsets = edges
    return int(index.shape[1]) - (len(offsets) - 1) * self_edges


def open_data(
    checkpoint: Checkpoint, data: str | None, split: str, console: Console
) -> tuple[Simulator, Trajectories]:
    """A split of ``data``, or of what the model was trained on, and the simulator in the bounds
    there; tells what the model takes to be otherwise.

    DataError where there is none, or none that the model can step forward.
    """
    try:
        folder = dataset_folder(data or checkpoint.config.data)
    except DataError as error:
        if data is not None:
            raise
        raise DataError(
            f"{error} (the checkpoint was trained on it; --data names where data are now)"
        ) from error
    metadata, notes = checkpoint.metadata.suited(folder, split)
    for note in notes:
        console.print(f"note: {note}", highlight=False, soft_wrap=True)
    return replace(checkpoint, metadata=metadata).simulator(), open_split(folder, split)


def tell_short(
    split: Trajectories, count: int | None, wanted: int | None, console: Console
) -> None:
    """Say how many of the first ``count`` trajectories end before ``wanted`` steps."""
    lengths = split.lengths[:count]
    short = 0 if wanted is None else np.count_nonzero(lengths < HISTORY + wanted)
    if short:
        console.print(
            f"note: {short} of {len(lengths)} trajectories end before step {wanted}, and their "
            "rollouts with them",
            highlight=False,
            soft_wrap=True,
        )


def _check_neighbours(config: RolloutConfig, split: Trajectories, count: int) -> None:
    """Refuse, before any rollout, more nearest neighbours than a trajectory has particles."""
    smallest = int(np.argmin(split.particle_counts[:count]))
    particles = int(split.particle_counts[smallest])
    if config.policy == "knn" and config.k >= particles:
        raise ValueError(
            f"k: got {config.k}; trajectory {split.names[smallest]} of {split.path} has "
            f"{particles} particles, so that fewer than that are accepted"
        )


def write_rollouts(config: RolloutConfig, console: Console) -> None:
    """Roll out the trajectories that ``config`` asks for, and write them to ``config.out``."""
    checkpoint = read_checkpoint(config.checkpoint)
    simulator, split = open_data(checkpoint, config.data, config.split, console)
    simulator = simulator.to(torch_device(config.device))
    simulator.network.precision = config.precision
    count = len(split) if config.trajectories is None else min(config.trajectories, len(split))
    tell_short(split, count, config.steps, console)
    _check_neighbours(config, split, count)
    known = set(checkpoint.types or ())
    network = "GNS" if simulator.config.edges else "MLP"
    other = simulator.config.edges and simulator.radius != simulator.metadata.radius
    trained_at = f", trained at r = {simulator.radius:g}" if other else ""
    settings = {
        **to_json(config),
        "label": f"{network} {checkpoint.config.loss}{trained_at}",
        "trained_radius": simulator.radius,
        "training": to_json(checkpoint.config),
        "training_steps": checkpoint.step,
    }
    with (
        RolloutWriter(config.out, metadata=simulator.metadata, settings=settings) as writer,
        Progress(console=console, transient=True) as progress,
    ):
        for index in progress.track(range(count), description=f"{config.policy} rollouts"):
            trajectory = split[index]
            new = set(trajectory.particle_type.tolist()) - known
            if checkpoint.types is not None and new:
                known |= new
                console.print(
                    f"note: trajectory {trajectory.name} has particles of type "
                    f"{', '.join(map(str, sorted(new)))}; the model was trained on type "
                    f"{', '.join(map(str, checkpoint.types))} alone",
                    highlight=False,
                    soft_wrap=True,
                )
            frames = len(trajectory.positions) - HISTORY
            horizon = frames if config.steps is None else min(config.steps, frames)

            roll = partial(steps, simulator, trajectory, count=horizon, radius=config.radius)
            # A policy each: the random one goes on drawing from where it was.
            free, forced = (
                make_policy(config.policy, config.adaptive, k=config.k, seed=config.seed + index)
                for _ in range(2)
            )
            every = config.one_step_every
            one_step = roll(policy=forced, teacher_forcing=True, every=every)
            writer.add(trajectory, roll(policy=free), zip(count_from(HISTORY, every), one_step))


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command with ``argv``, or with the process's own arguments."""
    console = Console()
    with plain_errors(torch.OutOfMemoryError):
        config = tyro.cli(
            RolloutConfig,
            args=argv,
            prog="python -m adaptgns.rollout",
            config=(tyro.conf.OmitArgPrefixes,),
        )
        if config.out.exists():
            raise ValueError(f"--out: {config.out} is there already; remove it or name another")
        write_rollouts(config, console)
    console.print(f"{config.out}", highlight=False)


if __name__ == "__main__":
    main()
