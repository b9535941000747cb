"""The training loop: steps, validation, checkpoints, and what stops it."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from adaptgns.atomic import replace_text
from adaptgns.checkpoint import (
    BEST,
    LAST,
    Checkpoint,
    build_simulator,
    with_prefix,
    write_checkpoint,
)
from adaptgns.config import TrainConfig, torch_device
from adaptgns.data.errors import DataError
from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectories import Trajectories
from adaptgns.graph import adaptive_graph, radius_graph
from adaptgns.interruption import interruption
from adaptgns.losses import training_loss, variance_loss
from adaptgns.network import Prediction
from adaptgns.policies import two_sided
from adaptgns.processes import ALONE, Processes
from adaptgns.progress import progress_bar
from adaptgns.rollout import to_sigma
from adaptgns.run_folder import LOG, read_log
from adaptgns.segment import Graph
from adaptgns.snapshot import snapshot
from adaptgns.threads import thread_count
from adaptgns.validation import Validation, validate
from adaptgns.windows import Batch, Windows, training_batches

LOG_EVERY = 100
"""Steps between lines of the metrics log."""
SHOW_EVERY = 10
"""Steps between what the progress bar shows; divides those between lines of the log."""

SETTLED = 0.8
"""Share of a cosine schedule after which checkpoints compete for the best: while the learning rate
is high, rollouts of neighbouring checkpoints differ by chance, and few trajectories crown the
luckiest."""


class TrainingStopped(Exception):  # noqa: N818 (not an error: nothing is lost)
    """A run ended before its end; the message says why and how to go on.

    With ``alone``, this one of several processes met it, and perhaps no other.
    """

    def __init__(self, message: str, *, alone: bool = False) -> None:
        super().__init__(message)
        self.alone = alone


class Diverged(TrainingStopped):
    """It ended since a loss or a weight became infinite or NaN."""


class Trainer:
    """A run: its simulator and optimizer, and the step they are at."""

    def __init__(
        self,
        config: TrainConfig,
        metadata: Metadata,
        folder: Path,
        *,
        train: Trajectories,
        valid: Trajectories | None,
        types: tuple[int, ...] | None = None,
        checkpoint: Checkpoint | None = None,
        processes: Processes = ALONE,
    ) -> None:
        if config.graph != "base" and (config.loss == "mse" or not config.model.edges):
            raise ValueError(
                f"graph: {config.graph} needs a model with edges and a variance; got the loss "
                f"{config.loss} and model.edges {config.model.edges}"
            )
        if config.batch < processes.count:
            raise ValueError(
                f"batch: got {config.batch} samples a step for {processes.count} processes; "
                "accepted is at least one each"
            )
        if config.graph == "two-sided":
            config.adaptive.require_two_sides()
        self.config, self.metadata, self.folder, self.valid = config, metadata, folder, valid
        self.types, self.processes = types, processes
        self.device = torch_device(config.device)
        torch.manual_seed(config.seed)
        self.simulator = build_simulator(config, metadata).to(self.device)
        self.optimizer = torch.optim.Adam(self.simulator.parameters(), fused=True)
        self.step = 0
        self.best_score = math.inf
        self.validated = True
        if checkpoint is not None:
            self._restore(checkpoint)
        self.windows = Windows(train, metadata, config, noise=config.noise)
        if not len(self.windows):
            raise ValueError(
                f"{train.path}: a sample needs {self.windows.frames} frames with unroll "
                f"{config.unroll} and graph {config.graph}; no trajectory has them"
            )

    def _restore(self, checkpoint: Checkpoint) -> None:
        before, now = (
            {**vars(c.model), "loss": c.loss, "noise": c.noise}
            for c in (checkpoint.config, self.config)
        )
        for name, given in now.items():
            if given != (saved := before[name]):
                raise ValueError(
                    f"{name}: the run was started with {saved}; got {given}; what a checkpoint's "
                    "weights are made for stays as it is, or is trained anew in another folder"
                )
        if self.config.steps < checkpoint.step:
            raise ValueError(
                f"steps: the run has trained {checkpoint.step} steps; got {self.config.steps}, "
                "accepted is as many or more"
            )
        self.simulator.load_state_dict(checkpoint.group("model"))
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in checkpoint.group("optimizer").items():
            index, key = name.split(".")
            state.setdefault(int(index), {})[key] = tensor
        groups = self.optimizer.state_dict()["param_groups"]
        self.optimizer.load_state_dict({"state": state, "param_groups": groups})
        if self.types is not None:  # as well as those of what it was trained on before
            self.types = tuple(sorted({*self.types, *(checkpoint.types or ())}))
        self.step, self.best_score = checkpoint.step, checkpoint.best_score
        self.validated = checkpoint.validated or self.valid is None

    def checkpoint(self, *, resumable: bool) -> Checkpoint:
        """The run as it stands; ``resumable`` with all that training needs to go on."""
        tensors = with_prefix("model", self.simulator.state_dict())
        if resumable:
            for index, state in self.optimizer.state_dict()["state"].items():
                tensors |= with_prefix(f"optimizer.{index}", state)
        return Checkpoint(
            self.config,
            self.metadata,
            self.step,
            self.best_score,
            tensors,
            self.validated,
            self.types,
        )

    def save(self) -> None:
        """Write the checkpoint that training goes on from; all processes wait until it is there.

        Raises :class:`TrainingStopped`, and keeps the one before, where a weight is not finite:
        the losses so far were those before the last update.
        """
        if not all(p.isfinite().all() for p in self.simulator.parameters()):
            raise self._diverged("the weights became infinite or NaN")
        if self.processes.first:
            write_checkpoint(self.folder / LAST, self.checkpoint(resumable=True))
        self.processes.wait()

    def run(self, console: Console) -> None:
        """Train to the last step.

        Raises :class:`TrainingStopped` on SIGINT, SIGTERM (after saving) and a loss that is not
        finite (the last good checkpoint stays).
        """
        config = self.config
        batches = iter(
            training_batches(
                self.windows,
                config,
                self.step,
                pin=self.device.type == "cuda",
                rank=self.processes.rank,
                processes=self.processes.count,
            )
        )
        fields = "steps, loss {task.fields[loss]}, {task.fields[speed]} a second,"
        progress = progress_bar(console, fields)
        self.simulator.train()
        losses: list[Tensor] = []
        with (
            Log(self.folder, self.step) if self.processes.first else nullcontext() as log,
            interruption(insistent=self.processes.count == 1) as interrupted,
            progress,
            _workers_end_with(batches),
        ):
            task = progress.add_task(
                "training", total=config.steps, completed=self.step, loss="-", speed="-"
            )
            logged = time.perf_counter()
            while self.step < config.steps or not self.validated:
                if self.processes.any(bool(interrupted)):
                    self._mean_loss(losses)
                    self.save()
                    signals = interrupted or ["a signal to another process"]
                    raise TrainingStopped(
                        f"stopped by {signals[0]} after step {self.step}; nothing is lost. "
                        f"Go on with\n  python -m adaptgns.train --resume {self.folder}"
                    )
                if not self.validated:
                    self.validated = True
                    if log is not None:
                        self._validate(log)
                    self.save()
                    logged = time.perf_counter()
                    continue
                batch = self._next(batches)
                losses.append(self.train_step(None if batch is None else batch.to(self.device)))
                self.step += 1
                progress.advance(task)
                last = self.step == config.steps
                due = self.valid is not None and (self.step % config.validate_every == 0 or last)
                self.validated = not due
                if self.step % SHOW_EVERY == 0 or last:
                    loss = float(torch.stack(losses).mean())
                    speed = len(losses) / (time.perf_counter() - logged)
                    progress.update(task, loss=f"{loss:.4g}", speed=f"{speed:.1f}")
                if self.step % LOG_EVERY == 0 or last:
                    mean = self._mean_loss(losses)
                    if log is not None:
                        values = {"lr": self.learning_rate(), "steps_per_second": speed}
                        log.write(self.step, {"loss": mean, **values})
                    losses.clear()
                    logged = time.perf_counter()
                # Before a validation, too: it may outlast the time that a launcher gives to end.
                if self.step % config.checkpoint_every == 0 or last or due:
                    self._mean_loss(losses)
                    self.save()

    def _next(self, batches: Iterator[Batch | None]) -> Batch | None:
        try:
            return next(batches)
        except (DataError, MemoryError, OSError) as error:
            kind, told = type(error), str(error)
        if self.processes.count == 1:  # else the others are not here to save with
            self.save()
        if told.startswith("Caught "):  # in a worker, whose trace torch adds
            told = told.rstrip().splitlines()[-1].split("Error: ", 1)[-1]
        raise kind(told)

    def train_step(self, batch: Batch | None) -> Tensor:
        """One optimizer step on ``batch``, this process's share of it, None where that is nothing;
        the loss of the whole batch before the step."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate()
        self.optimizer.zero_grad()
        loss = None
        if batch is not None:
            loss = self._loss(batch)
            loss.backward()  # type: ignore[no-untyped-call]
        if self.processes.count > 1:
            particles = 0 if batch is None else int(batch.mobile.sum())
            parameters = self.simulator.parameters()
            loss = self.processes.mean_gradients(parameters, loss, particles)
        assert loss is not None, "one process alone has all samples"
        if self.config.clip is not None:
            torch.nn.utils.clip_grad_norm_(self.simulator.parameters(), self.config.clip)
        self.optimizer.step()
        return loss.detach()

    def _loss(self, batch: Batch) -> Tensor:
        """The mean loss of ``batch`` over particles and frames."""
        config, mobile = self.config, batch.mobile
        window, graph = batch.window, self._first_graph(batch)
        unrolled = config.unroll if 2 * self.step >= config.steps else 1
        # The error one frame later is needed for a variance that stands for it.
        frames = max(unrolled, 2) if config.variance_ahead else unrolled
        losses: list[Tensor] = []
        variance = likelihood = None
        for number, following in enumerate(batch.following[:, :frames].unbind(1)):
            with torch.set_grad_enabled(number < unrolled):
                prediction = self.simulator(window, batch.particle_type, graph, batch.material)
            target = self.simulator.target(window, following)
            if number < unrolled:
                loss = training_loss(
                    "mse" if config.variance_ahead else config.loss,
                    prediction,
                    target,
                    mobile,
                    variance=variance,
                    variance_weight=config.variance_weight or 1.0,
                )
                losses.append(loss)
            if config.variance_ahead and number == 1:
                assert variance is not None, "the first frame's"
                error = (prediction.acceleration - target).square().sum(1)[mobile]
                likelihood = variance_loss(variance[mobile], error, target.shape[1])
            if number + 1 < frames:
                variance = prediction.variance if variance is None else variance
                position = self.simulator.advance(window, prediction.acceleration)
                position = torch.where(mobile[:, None], position, following)
                window = torch.cat([window[:, 1:], position[:, None]], dim=1)
                graph = self._graph(batch, window, prediction)
        loss = torch.stack(losses).mean()
        return loss if likelihood is None else loss + (config.variance_weight or 1.0) * likelihood

    def learning_rate(self) -> float:
        """The learning rate of the current step."""
        c = self.config
        decayed: float
        if self.step < c.warmup:
            return c.lr * (self.step + 1) / c.warmup
        if c.schedule == "exponential":
            decayed = 0.1 ** (self.step / 5e6)
        else:
            progress = (self.step - c.warmup) / max(1, c.steps - c.warmup)
            decayed = 0.5 * (1 + math.cos(math.pi * progress))
        return c.lr_final + (c.lr - c.lr_final) * decayed

    def _first_graph(self, batch: Batch) -> Graph | None:
        """The graph of the batch's window. The adaptive one that a rollout would have there takes
        its sigma from a pass without gradient over the window one frame earlier, on that window's
        base graph."""
        if self.config.graph == "base":
            return batch.graph
        with torch.no_grad():
            earlier = self.simulator(
                batch.earlier_window, batch.particle_type, batch.graph, batch.material
            )
        return self._graph(batch, batch.window, earlier)

    def _graph(self, batch: Batch, window: Tensor, earlier: Prediction) -> Graph | None:
        """The graph of ``window`` after the prediction one frame ``earlier``."""
        if not self.config.model.edges:
            return None
        positions = window[:, -1].detach().cpu().numpy()
        if not np.isfinite(positions).all():
            raise self._diverged("the predicted positions became infinite or NaN", alone=True)
        build = partial(radius_graph, positions, self.simulator.radius)
        if self.config.graph != "base":
            sigma = to_sigma(earlier)
            if not np.isfinite(sigma).all():
                raise self._diverged("the predicted variance became infinite or NaN", alone=True)
            mobile, rule = batch.mobile.cpu().numpy(), self.config.adaptive
            if self.config.graph == "adaptive":
                build = partial(
                    adaptive_graph,
                    positions,
                    sigma,
                    self.simulator.radius,
                    rule.tau,
                    rule.factor,
                    eligible=mobile,
                )
            else:
                graphs = [slice(*ends) for ends in pairwise(batch.ptr.tolist())]
                factors = [two_sided(sigma[own], rule, mobile[own]) for own in graphs]
                radii = self.simulator.radius * np.concatenate(factors)
                build = partial(radius_graph, positions, radii)
        edges = build(
            ptr=batch.ptr.numpy(),
            box=self.metadata.box,
            self_edges=self.config.model.self_edges,
            threads=thread_count(),
            return_offsets=True,
        )
        return Graph.from_numpy(*edges).send(self.device)

    def _mean_loss(self, losses: list[Tensor]) -> float:
        """Mean of ``losses``; raises :class:`TrainingStopped` unless it is finite."""
        if not losses:
            return math.nan
        mean = float(torch.stack(losses).mean())
        if not math.isfinite(mean):
            raise self._diverged(f"the loss became {mean} in the last {len(losses)} steps")
        return mean

    def _diverged(self, what: str, *, alone: bool = False) -> Diverged:
        last = self.folder / LAST
        kept = f"{last} holds the last good state. " if last.exists() else ""
        return Diverged(
            f"{what}, by step {self.step}. {kept}Look at: the learning rate (--lr, now "
            f"{self.config.lr}), gradient clipping (--clip), and the data "
            f"(python -m adaptgns.inspect {self.config.data})",
            alone=alone,
        )

    def _validate(self, log: Log) -> None:
        assert self.valid is not None
        self.simulator.eval()
        validation = validate(self.simulator, self.valid, self.config)
        self.simulator.train()
        scores = validation.scores
        log.write(self.step, scores)
        log.show(self.step, self.metadata, validation)
        c = self.config
        before = (self.step - 1) // c.validate_every * c.validate_every  # the last validation
        first_settled = c.schedule == "cosine" and self.step >= SETTLED * c.steps > before
        score = scores["valid_rollout_mse"]
        # Of those that collapsed the last is as good as any.
        if first_settled or score < self.best_score or not math.isfinite(self.best_score):
            self.best_score = score
            write_checkpoint(self.folder / BEST, self.checkpoint(resumable=False))


@contextmanager
def _workers_end_with(batches: object) -> Iterator[None]:
    """End the workers behind an iterator of batches with the block. Torch does so when the iterator
    goes, which the trace of an exception may keep, and then by a SIGTERM that they ignore; at exit
    they would be waited for."""
    try:
        yield
    finally:
        getattr(batches, "_shutdown_workers", lambda: None)()
        for worker in getattr(batches, "_workers", ()):  # one that was busy may be there yet
            worker.kill()


class Log:
    """Metrics as JSON lines in ``metrics.jsonl`` and as TensorBoard events.

    Opened at a step, it forgets what an interrupted run logged past that step.
    """

    def __init__(self, folder: Path, step: int) -> None:
        path = folder / LOG
        lines = read_log(path) if path.exists() else []
        kept = [json.dumps(line) + "\n" for line in lines if line["step"] <= step]
        replace_text(path, "".join(kept))
        self.file = path.open("a")
        self.board = SummaryWriter(folder / "tensorboard", purge_step=step + 1)

    def write(self, step: int, values: dict[str, float]) -> None:
        """Log ``values`` at ``step``."""
        # JSON has no infinity: a diverged rollout's error is null.
        finite = {name: v if math.isfinite(v) else None for name, v in values.items()}
        self.file.write(json.dumps({"step": step, **finite}) + "\n")
        self.file.flush()
        for name, value in values.items():
            self.board.add_scalar(name, value, step)

    def show(self, step: int, metadata: Metadata, validation: Validation) -> None:
        """Put a picture of the rollout on the TensorBoard."""
        v = validation
        picture = snapshot(metadata, v.true, v.predicted, v.sigma, v.mobile)
        self.board.add_image("valid_rollout", picture, step, dataformats="HWC")

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()
        self.board.close()
