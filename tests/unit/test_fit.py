"""The training loop: it learns, resumes to the bit, and loses nothing when it is stopped."""

from __future__ import annotations

import errno
import json
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from rich.console import Console

from adaptgns import fit, validation
from adaptgns.checkpoint import BEST, LAST, build_simulator, read_checkpoint
from adaptgns.config import AdaptiveConfig, Precision, TrainConfig
from adaptgns.data import Trajectory
from adaptgns.data.dataset import write_dataset
from adaptgns.data.errors import DataError
from adaptgns.data.metadata import read_metadata
from adaptgns.data.trajectories import open_split
from adaptgns.fit import Trainer, TrainingStopped
from adaptgns.graph import adaptive_graph, radius_graph
from adaptgns.network import Prediction
from adaptgns.policies import Adaptive
from adaptgns.processes import Processes
from adaptgns.rollout import Step, steps, to_sigma
from adaptgns.segment import Graph
from tests.conftest import graph_of

QUIET = Console(quiet=True)


def trainer(
    drops: Path,
    folder: Path,
    config: TrainConfig,
    *,
    resume: bool = False,
    types: tuple[int, ...] = (5,),
) -> Trainer:
    folder.mkdir(exist_ok=True)
    return Trainer(
        config,
        read_metadata(drops),
        folder,
        train=open_split(drops, "train"),
        valid=open_split(drops, "valid"),
        types=types,
        checkpoint=read_checkpoint(folder / LAST) if resume else None,
    )


def log(folder: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_two_sides_that_overlap_are_not_trained_on(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    config = replace(small_config, loss="nll", adaptive=AdaptiveConfig(tau=20, low_tau=30))
    trainer(drops, tmp_path, replace(config, graph="adaptive"))
    with pytest.raises(ValueError, match="low_tau: got 30; accepted for two-sided graphs"):
        trainer(drops, tmp_path, replace(config, graph="two-sided"))


@pytest.mark.parametrize("graph", ["base", "adaptive", "two-sided"])
def test_one_batch_can_be_overfitted(
    drops: Path, tmp_path: Path, small_config: TrainConfig, graph: str
) -> None:
    config = replace(small_config, graph=graph, steps=400, lr=3e-3, noise=3e-4, loss="nll")
    run = trainer(drops, tmp_path, config)
    batch = run.windows.collate([run.windows[0, 10], run.windows[0, 40]])
    losses = []
    for run.step in range(300):
        losses.append(float(run.train_step(batch)))
    assert np.mean(losses[-10:]) < losses[0] - 1


@pytest.mark.parametrize("precision", ["float32", "bf16"])
def test_resumed_equals_uninterrupted(
    drops: Path, tmp_path: Path, small_config: TrainConfig, precision: Precision
) -> None:
    config = replace(small_config, clip=1.0, mirror=True, warmup=3, unroll=2, precision=precision)
    trainer(drops, tmp_path / "whole", config).run(QUIET)

    run = trainer(drops, tmp_path / "parts", config)
    for batch in list(fit.training_batches(run.windows, config, 0, pin=False))[:8]:
        run.train_step(batch)
        run.step += 1
    run.save()
    trainer(drops, tmp_path / "parts", config, resume=True).run(QUIET)

    whole, parts = (read_checkpoint(tmp_path / f / LAST).tensors for f in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    assert any(name.startswith("optimizer.") for name in whole)
    for name, tensor in whole.items():
        assert torch.equal(tensor, parts[name]), name


def test_metrics_best_checkpoint_and_log_after_a_resume(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    trainer(drops, tmp_path, small_config).run(QUIET)
    best = read_checkpoint(tmp_path / BEST)
    assert best.types == (5,)
    assert best.step in (6, 12)
    assert not best.group("optimizer")
    scores = {e["step"]: e["valid_rollout_mse"] for e in log(tmp_path) if "valid_rollout_mse" in e}
    assert list(scores) == [6, 12]
    assert best.best_score == min(scores.values()) == scores[best.step]

    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 99, "loss": 1}\n{"step": 100, "lo')
    longer = replace(small_config, steps=14)
    trainer(drops, tmp_path, longer, resume=True, types=(3,)).run(QUIET)
    assert read_checkpoint(tmp_path / LAST).types == (3, 5), "of what came before, too"
    assert [e["step"] for e in log(tmp_path)] == [6, 12, 12, 14, 14]
    assert any((tmp_path / "tensorboard").iterdir())


def test_among_the_settled_only_a_better_one_is_best(
    drops: Path, tmp_path: Path, small_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also at a last step that is no multiple of the steps between validations."""
    scores, validate = iter([5.0, 1.0, 3.0, 4.0]), fit.validate

    def scored(*arguments: Any) -> Any:
        validation = validate(*arguments)
        better = {**validation.scores, "valid_rollout_mse": next(scores)}
        return replace(validation, scores=better)

    monkeypatch.setattr(fit, "validate", scored)
    trainer(drops, tmp_path, replace(small_config, steps=10, validate_every=3)).run(QUIET)
    best = read_checkpoint(tmp_path / BEST)
    assert (best.step, best.best_score) == (9, 3.0), "of those at 9 and 10, not at 3 and 6"


def test_a_broken_log_is_named(drops: Path, tmp_path: Path, small_config: TrainConfig) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\nnothing\n')
    with pytest.raises(ValueError, match=r"metrics\.jsonl: line 2 is no JSON object"):
        trainer(drops, tmp_path, small_config).run(QUIET)


def test_a_loss_that_is_not_finite_stops_with_what_to_look_at(
    drops: Path, tmp_path: Path, small_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = trainer(drops, tmp_path, small_config)
    original, calls = fit.training_loss, []

    def sometimes_nan(*args: object, **options: object) -> torch.Tensor:
        calls.append(None)
        return original(*args, **options) * (torch.nan if len(calls) == 10 else 1)

    monkeypatch.setattr(fit, "training_loss", sometimes_nan)
    with pytest.raises(
        TrainingStopped, match=r"loss became nan.*last good state.*--lr.*--clip"
    ) as stopped:
        run.run(QUIET)
    assert not stopped.value.alone
    kept = read_checkpoint(tmp_path / LAST)
    assert kept.step == 8
    assert all(t.isfinite().all() for t in kept.tensors.values())


@pytest.mark.parametrize("graph", ["base", "adaptive"])
def test_positions_that_are_not_finite_stop_likewise(
    drops: Path, tmp_path: Path, small_config: TrainConfig, graph: Literal["base", "adaptive"]
) -> None:
    run = trainer(drops, tmp_path, replace(small_config, unroll=2, graph=graph))
    run.step = small_config.steps // 2
    batch = run.windows.collate([run.windows[0, 0]])
    run.save()
    with torch.no_grad():
        next(run.simulator.network.decoder.parameters()).fill_(torch.nan)
        next(run.simulator.network.node_encoder.parameters()).fill_(torch.nan)
    with pytest.raises(
        TrainingStopped, match=r"became infinite or NaN.*last good state.*--lr"
    ) as stopped:
        run.train_step(batch)
    assert stopped.value.alone


def test_adaptive_training_needs_edges_and_a_variance(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    no_edges = replace(small_config, model=replace(small_config.model, edges=False))
    for config in (replace(small_config, loss="mse"), no_edges):
        with pytest.raises(ValueError, match="graph: adaptive needs a model with edges"):
            trainer(drops, tmp_path, replace(config, graph="adaptive"))


def test_weights_that_are_not_finite_are_not_saved(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    run = trainer(drops, tmp_path, small_config)
    run.save()
    kept = (tmp_path / LAST).read_bytes()
    with torch.no_grad():
        next(run.simulator.parameters()).fill_(torch.nan)
    with pytest.raises(TrainingStopped, match=r"weights became.*last good state"):
        run.save()
    assert (tmp_path / LAST).read_bytes() == kept


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_save_and_say_how_to_go_on(
    drops: Path,
    tmp_path: Path,
    small_config: TrainConfig,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
) -> None:
    run = trainer(drops, tmp_path, small_config)
    original = run.train_step

    def interrupted_step(batch: fit.Batch) -> torch.Tensor:
        if run.step == 5:
            os.kill(os.getpid(), number)
        return original(batch)

    monkeypatch.setattr(run, "train_step", interrupted_step)
    with pytest.raises(TrainingStopped, match=rf"{number.name} after step 6.*\n.*--resume"):
        run.run(QUIET)
    assert read_checkpoint(tmp_path / LAST).step == 6


def test_what_a_worker_cannot_read_is_told_in_one_line_and_nothing_is_lost(
    drops: Path, tmp_path: Path, small_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(*_: object) -> None:
        raise DataError("train.h5: gone")

    run = trainer(drops, tmp_path, replace(small_config, workers=1))
    monkeypatch.setattr(fit.Windows, "collate_share", unreadable)
    with pytest.raises(DataError, match=r"^train\.h5: gone$"):
        run.run(QUIET)
    assert read_checkpoint(tmp_path / LAST).step == 0


def test_only_what_collapsed_is_stopped(
    drops: Path, tmp_path: Path, small_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not what began without a neighbour and came together as it should."""
    metadata = read_metadata(drops)
    spread = np.random.default_rng(0).uniform(-0.1, 0.1, (300, 2))

    def falling(closest: float) -> Trajectory:
        scale = np.maximum(10 - np.arange(30.0), closest)[:, None, None]
        positions = (0.5 + scale * spread).astype(np.float32)
        return Trajectory("", positions, np.full(300, 5))

    rain, pile = falling(1.0), falling(0.01)
    write_dataset(
        tmp_path / "rain", {"train": [rain], "valid": [rain], "test": [rain]}, dt=metadata.dt,
        bounds=metadata.bounds, radius=metadata.radius,
    )  # fmt: skip
    run = trainer(drops, tmp_path / "run", replace(small_config, validate_horizon=20))
    valid = open_split(tmp_path / "rain", "valid")
    for predicted, collapsed in ((rain, False), (pile, True)):

        def rolled(*_: object, predicted: Trajectory = predicted) -> Iterator[Step]:
            for positions in predicted.positions[6:26]:
                edges = radius_graph(positions, metadata.radius).shape[1]
                yield Step(positions, None, np.zeros(300, np.float32), edges, 0.0, 0.0)

        monkeypatch.setattr(validation, "steps", rolled)
        score = validation.validate(run.simulator, valid, run.config).scores
        assert np.isinf(score["valid_rollout_mse"]) == collapsed


def test_of_those_that_collapsed_the_last_is_kept_until_one_does_not(
    drops: Path, tmp_path: Path, small_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = trainer(drops, tmp_path, replace(small_config, schedule="exponential"))
    true = validation.validate
    scores = iter((np.inf, np.inf, 1.0, 2.0))

    def given(*arguments: Any) -> validation.Validation:
        made = true(*arguments)
        return replace(made, scores=made.scores | {"valid_rollout_mse": next(scores)})

    monkeypatch.setattr(fit, "validate", given)
    kept = []
    with fit.Log(tmp_path, 0) as log:
        for run.step in (10, 20, 30, 40):
            run._validate(log)
            kept.append(read_checkpoint(tmp_path / BEST).step)
    assert kept == [10, 20, 30, 30]


def test_what_is_lost_counts_as_infinitely_far(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    run = trainer(drops, tmp_path, small_config)
    with torch.no_grad():
        run.simulator.acceleration_std.fill_(torch.inf)
    assert run.valid is not None
    score = validation.validate(run.simulator, run.valid, run.config).scores["valid_rollout_mse"]
    assert score == np.inf


class Two(Processes):
    """Two processes of which the other one does as this one; it gets a signal in step 3."""

    def __init__(self) -> None:
        super().__init__(rank=0, count=2)
        self.asked: list[str] = []

    def any(self, mine: bool) -> bool:
        self.asked.append("any")
        return mine or self.asked.count("any") == 4

    def wait(self) -> None:
        self.asked.append("wait")

    def mean_gradients(self, _: object, loss: torch.Tensor | None, __: int) -> torch.Tensor:
        assert loss is not None
        return loss.detach()


def test_a_signal_to_another_process_stops_at_once_and_none_leaves_before_it_is_saved(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    run = trainer(drops, tmp_path, small_config)
    run.processes = two = Two()
    with pytest.raises(TrainingStopped, match="a signal to another process after step 3"):
        run.run(QUIET)
    assert two.asked == [*["any"] * 4, "wait"]
    assert read_checkpoint(tmp_path / LAST).step == 3


def test_a_run_that_ends_in_a_validation_goes_on_with_it(
    drops: Path, tmp_path: Path, small_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fit, "validate", fail)
        with pytest.raises(KeyboardInterrupt):
            trainer(drops, tmp_path, small_config).run(QUIET)
    kept = read_checkpoint(tmp_path / LAST)
    assert (kept.step, kept.validated) == (6, False)

    trainer(drops, tmp_path, small_config, resume=True).run(QUIET)
    scores = {e["step"]: e["valid_rollout_mse"] for e in log(tmp_path) if "valid_rollout_mse" in e}
    assert list(scores) == [6, 12]
    kept = read_checkpoint(tmp_path / LAST)
    assert kept.validated
    assert kept.best_score == min(scores.values())


def test_a_full_disk_keeps_the_last_checkpoint(
    drops: Path, tmp_path: Path, small_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = trainer(drops, tmp_path, small_config)
    original = os.fsync

    def full_later(descriptor: int) -> None:
        if run.step >= 8:
            raise OSError(errno.ENOSPC, "No space left on device")
        original(descriptor)

    monkeypatch.setattr(os, "fsync", full_later)
    with pytest.raises(OSError, match="No space left"):
        run.run(QUIET)
    assert read_checkpoint(tmp_path / LAST).step == 6


def test_learning_rate_schedules(drops: Path, tmp_path: Path, small_config: TrainConfig) -> None:
    config = replace(small_config, steps=100, lr=1e-3, lr_final=1e-6, warmup=10)
    run = trainer(drops, tmp_path, config)
    rates = []
    for run.step in range(101):
        rates.append(run.learning_rate())
    assert rates[0] == pytest.approx(1e-4)
    assert max(rates) == rates[10] == pytest.approx(1e-3)
    assert rates[100] == pytest.approx(1e-6)
    run = trainer(drops, tmp_path, replace(config, schedule="exponential", warmup=0))
    run.step = 5_000_000
    assert run.learning_rate() == pytest.approx(1e-6 + (1e-3 - 1e-6) * 0.1)


def test_the_lagged_training_graph_is_that_of_a_rollout(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    """On true positions, the graph of training is the second one of an adaptive rollout."""
    rule = AdaptiveConfig(tau=60, factor=1.5)
    config = replace(small_config, graph="adaptive", noise=0.0, adaptive=rule)
    run = trainer(drops, tmp_path, config)
    trajectory = open_split(drops, "train")[0]
    rolled = list(steps(run.simulator.eval(), trajectory, Adaptive(rule), 2, teacher_forcing=True))
    graph = run._first_graph(run.windows.collate([run.windows[0, 0]]))
    assert graph is not None
    assert len(graph.senders) - len(trajectory.particle_type) == rolled[1].edges
    assert rolled[1].edges != rolled[0].edges


@pytest.mark.parametrize("graph", ["base", "adaptive"])
def test_unrolled_windows_are_those_of_a_rollout(
    drops: Path, tmp_path: Path, small_config: TrainConfig, graph: Literal["base", "adaptive"]
) -> None:
    rule = AdaptiveConfig(tau=60, factor=1.5)
    lead = int(graph == "adaptive")
    config = replace(small_config, graph=graph, noise=0.0, adaptive=rule, unroll=3)
    run = trainer(drops, tmp_path, config)
    batch = run.windows.collate([run.windows[0, 0]])
    seen: list[torch.Tensor] = []
    graphs: list[Graph] = []
    sigmas: list[np.ndarray] = []

    def record(_: object, arguments: tuple[torch.Tensor, object, Graph], out: Prediction) -> None:
        seen.append(arguments[0][:, -1])
        graphs.append(arguments[2])
        sigmas.append(to_sigma(out))

    run.simulator.register_forward_hook(record)
    run.train_step(batch)
    assert len(seen) == 1 + lead  # single steps in the first half

    run = trainer(drops, tmp_path, config)
    true = torch.from_numpy(open_split(drops, "train")[0].positions).transpose(0, 1)
    window = true[:, lead : lead + 6].contiguous()
    expected = []
    with torch.no_grad():
        for k in range(3):
            before = true[:, :6].contiguous() if lead and not k else window
            positions = window[:, -1].numpy()
            if lead:
                if not k:
                    sigma = to_sigma(
                        run.simulator(before, batch.particle_type, batch.graph, batch.material)
                    )
                index, offsets = adaptive_graph(
                    positions,
                    sigma,
                    run.simulator.radius,
                    rule.tau,
                    rule.factor,
                    self_edges=True,
                    return_offsets=True,
                )
                used = Graph.from_numpy(index, offsets)
            else:
                used = graph_of(positions, run.simulator.radius)
            out = run.simulator(window, batch.particle_type, used, batch.material)
            sigma = to_sigma(out)
            expected.append((window[:, -1], used.senders))
            following = run.simulator.advance(window, out.acceleration)
            window = torch.cat([window[:, 1:], following[:, None]], dim=1)
    for record_ in (seen, graphs, sigmas):
        record_.clear()
    run.simulator.register_forward_hook(record)
    run.step = config.steps // 2
    run.train_step(batch)
    assert len(seen) == 3 + lead
    assert [p.requires_grad for p in seen[lead:]] == [False, True, True]
    for position, graph_, (where, senders) in zip(
        seen[lead:], graphs[lead:], expected, strict=True
    ):
        torch.testing.assert_close(position.detach(), where, rtol=0, atol=1e-6)
        assert torch.equal(graph_.senders, senders)


def test_a_decoupled_variance_teaches_the_rest_nothing_unless_asked(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    """The accelerations' weights after some steps are those of the loss mse, to rounding."""

    def trained(**changes: object) -> dict[str, torch.Tensor]:
        run = trainer(drops, tmp_path, replace(small_config, **changes))
        batch = run.windows.collate([run.windows[0, 10], run.windows[0, 40]])
        # As the variance head draws its weights last, those before it are the same.
        for run.step in range(5):
            run.train_step(batch)
        return run.simulator.state_dict()

    alone, mse = trained(loss="decoupled"), trained(loss="mse")
    together = trained(loss="decoupled", variance_weight=0.5)
    for name, value in mse.items():
        torch.testing.assert_close(alone[name], value, rtol=1e-4, atol=1e-6)
    heads = [name for name in alone if name not in mse]
    assert heads
    assert all("variance_head" in name for name in heads)
    fresh = build_simulator(replace(small_config, loss="decoupled"), read_metadata(drops))
    assert any(not torch.equal(alone[name], fresh.state_dict()[name]) for name in heads)
    assert any((together[name] - mse[name]).abs().max() > 1e-4 for name in mse)


@pytest.mark.parametrize("step", [0, 8])
def test_a_variance_ahead_learns_the_error_of_the_next_frame(
    drops: Path, tmp_path: Path, small_config: TrainConfig, step: int
) -> None:
    config = replace(
        small_config,
        loss="decoupled",
        variance_ahead=True,
        unroll=2,
        variance_weight=0.3,
        noise=0.0,
    )
    run = trainer(drops, tmp_path, config)
    run.step = step  # of 12: one frame in the first half, two in the second
    batch = run.windows.collate([run.windows[0, 10]])
    loss = run._loss(batch)
    window, losses, variances = batch.window, [], []
    with torch.no_grad():
        for following in batch.following.unbind(1):
            graph = graph_of(window[:, -1].numpy(), run.simulator.radius)
            out = run.simulator(window, batch.particle_type, graph, batch.material)
            error = (out.acceleration - run.simulator.target(window, following)).square().sum(1)
            losses.append(error.mean() / 2)
            variances.append(out.variance)
            after = run.simulator.advance(window, out.acceleration)
            window = torch.cat([window[:, 1:], after[:, None]], dim=1)
    likelihood = (error / (2 * variances[0]) + variances[0].log()).mean()
    counted = losses[:1] if step == 0 else losses
    torch.testing.assert_close(
        loss.detach(), torch.stack(counted).mean() + 0.3 * likelihood, rtol=1e-4, atol=1e-6
    )


def test_training_with_a_variance_ahead_comes_to_its_end(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    """Through its validations, which look one frame ahead alone."""
    config = replace(small_config, loss="decoupled", variance_ahead=True, unroll=2)
    trainer(drops, tmp_path, config).run(QUIET)
    last = read_checkpoint(tmp_path / LAST)
    assert last.step == config.steps
    assert last.validated


def test_a_variance_ahead_needs_a_frame_ahead() -> None:
    with pytest.raises(ValueError, match=r"variance_ahead: needs the loss decoupled and unroll"):
        TrainConfig(loss="decoupled", variance_ahead=True, unroll=1)
    with pytest.raises(ValueError, match="got nll and 3"):
        TrainConfig(loss="nll", variance_ahead=True, unroll=3)
