"""Checkpoints hold all that is needed, and are whole or absent."""

from __future__ import annotations

import errno
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from adaptgns._core import simulate
from adaptgns.checkpoint import (
    BEST,
    LAST,
    PRETRAINED,
    Checkpoint,
    CheckpointError,
    build_simulator,
    read_checkpoint,
    with_prefix,
    write_checkpoint,
)
from adaptgns.config import (
    AdaptiveConfig,
    ConfigError,
    ModelConfig,
    RolloutConfig,
    TrainConfig,
    from_json,
    to_json,
)
from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectory import Trajectory
from adaptgns.policies import Fixed
from adaptgns.rollout import steps


@pytest.fixture
def checkpoint(small_config: TrainConfig, metadata: Metadata) -> Checkpoint:
    simulator = build_simulator(small_config, metadata)
    return Checkpoint(small_config, metadata, 7, 0.5, with_prefix("model", simulator.state_dict()))


def test_round_trip(checkpoint: Checkpoint, tmp_path: Path) -> None:
    write_checkpoint(tmp_path / LAST, checkpoint)
    back = read_checkpoint(tmp_path)
    assert (back.config, back.metadata, back.step, back.best_score, back.types) == (
        checkpoint.config,
        checkpoint.metadata,
        7,
        0.5,
        None,
    )
    write_checkpoint(tmp_path / LAST, replace(checkpoint, types=(3, 5)))
    assert read_checkpoint(tmp_path).types == (3, 5)
    ours, theirs = checkpoint.simulator().state_dict(), back.simulator().state_dict()
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[k], theirs[k]) for k in ours)


def test_a_run_folder_means_its_best(checkpoint: Checkpoint, tmp_path: Path) -> None:
    write_checkpoint(tmp_path / LAST, checkpoint)
    write_checkpoint(tmp_path / BEST, replace(checkpoint, step=5))
    assert read_checkpoint(tmp_path).step == 5
    assert read_checkpoint(tmp_path / LAST).step == 7


def test_missing_and_damaged_files_are_named(checkpoint: Checkpoint, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"nowhere: not found; accepted are"):
        read_checkpoint(tmp_path / "nowhere")
    path = tmp_path / LAST
    write_checkpoint(path, checkpoint)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match=r"last\.safetensors: cannot be read as"):
        read_checkpoint(path)


def test_a_full_disk_keeps_the_old_checkpoint(
    checkpoint: Checkpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_checkpoint(tmp_path / LAST, checkpoint)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_checkpoint(tmp_path / LAST, replace(checkpoint, step=8))
    assert read_checkpoint(tmp_path).step == 7
    assert [p.name for p in tmp_path.iterdir()] == [LAST]


def test_configuration_round_trip(small_config: TrainConfig) -> None:
    config = replace(small_config, out=Path("a/b"))
    assert from_json(TrainConfig, to_json(config), source="test") == config


def test_unknown_keys_and_wrong_kinds_are_refused(small_config: TrainConfig) -> None:
    values = to_json(small_config)
    with pytest.raises(ConfigError, match=r"config\.json.*learning_rate"):
        from_json(TrainConfig, values | {"learning_rate": 1}, source="config.json")
    with pytest.raises(ConfigError, match="latents"):
        from_json(TrainConfig, values | {"model": {"latents": 3}}, source="x")
    with pytest.raises(ConfigError, match="loss"):
        from_json(TrainConfig, values | {"loss": "mae"}, source="x")
    with pytest.raises(ConfigError, match="batch: got 0; accepted are whole numbers >= 1"):
        from_json(TrainConfig, values | {"batch": 0}, source="x")
    for name, value, accepted in (
        ("mirror", "false", "type bool"),
        ("steps", 99.9, "type int"),
        ("steps", True, "type int"),
        ("lr", "1", "type float"),
        ("data", None, "type str"),
        ("out", 3, "type str"),
        ("loss", "mae", "nll, beta-nll, decoupled, mse"),
        ("model", [], "an object is accepted"),
    ):
        with pytest.raises(ConfigError, match=rf"x: .*{accepted} @ \$\.{name}"):
            from_json(TrainConfig, values | {name: value}, source="x")
    assert from_json(TrainConfig, values | {"lr": 1}, source="x").lr == 1.0


@pytest.mark.parametrize(
    ("config", "name", "value"),
    [
        (TrainConfig(), "steps", 0),
        (TrainConfig(), "lr", math.nan),
        (TrainConfig(), "noise", math.inf),
        (TrainConfig(), "position_correction", 1.5),
        (ModelConfig(), "latent", 0),
        (ModelConfig(), "radius", -0.1),
        (AdaptiveConfig(), "tau", 200),
        (AdaptiveConfig(), "factor", 0.9),
        (RolloutConfig(Path("run"), Path("out.h5")), "k", 0),
        (RolloutConfig(Path("run"), Path("out.h5")), "one_step_every", 0),
    ],
)
def test_values_outside_their_range_are_refused(
    config: TrainConfig | ModelConfig | AdaptiveConfig | RolloutConfig, name: str, value: float
) -> None:
    with pytest.raises(ValueError, match=f"{name}: got {value}; accepted are"):
        replace(config, **{name: value})


@pytest.mark.parametrize("name", ["waterdrop", "sand"])
def test_pretrained_models_come_with_the_package(name: str) -> None:
    checkpoint = read_checkpoint(Path(name))
    assert checkpoint.config.data == name
    assert checkpoint.config.out is None
    assert (PRETRAINED / f"{name}.safetensors").stat().st_size < 2 << 20
    trajectory = Trajectory("new", *simulate(name, seed=7, frames=300, particles=(200, 300)))
    assert checkpoint.types == tuple(np.unique(trajectory.particle_type))
    simulator = checkpoint.simulator()
    made = list(steps(simulator, trajectory, Fixed(), 250, teacher_forcing=True))
    true = np.diff(trajectory.positions.astype(np.float64), n=2, axis=0)
    nothing = np.square(true / simulator.acceleration_std.numpy()).sum(2).mean()
    assert np.mean([step.squared_error.mean() for step in made]) < 0.7 * nothing


def test_a_folder_goes_before_a_pretrained_model_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("sand").mkdir()
    with pytest.raises(CheckpointError, match="checkpoint sand: not found"):
        read_checkpoint(Path("sand"))
    with pytest.raises(CheckpointError, match="the pretrained sand, waterdrop"):
        read_checkpoint(Path("snow"))
