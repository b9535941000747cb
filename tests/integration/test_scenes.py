"""Generated scenes of every kind are trained on and rolled out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adaptgns.data import open_split, read_metadata
from adaptgns.data.scenes import SceneName
from adaptgns.data.trajectory import INPUT_FRAMES
from adaptgns.generate import GenerateConfig, generate
from adaptgns.periodic import minimum_image
from adaptgns.rollout_file import RolloutFile
from adaptgns.train import main

SMALL = GenerateConfig(
    scene="waterdrop", out=Path(), train=2, valid=1, test=1, frames=40, particles=(40, 60)
)


@pytest.mark.parametrize(
    ("scene", "dim", "types"),
    [
        ("waterdrop", 3, {5}),
        ("sand", 3, {6}),
        ("goop", 2, {7}),
        ("jelly", 2, {7}),
        ("multimaterial", 2, {5, 6, 7}),
        ("waterramps", 2, {3, 5}),
        ("stirrer", 2, {3, 5}),
    ],
)
def test_a_scene_trains_and_rolls_out(
    tmp_path: Path, scene: SceneName, dim: int, types: set[int]
) -> None:
    data, run = tmp_path / "data", tmp_path / "run"
    generate(replace(SMALL, scene=scene, dim=dim, out=data))  # type: ignore[arg-type]
    main(["--preset", "smoke", "--data", str(data), "--out", str(run), "--steps", "4"])
    given = open_split(data, "test")[0]
    assert set(given.particle_type.tolist()) <= types
    with RolloutFile(run / "rollouts" / "adaptive.h5") as file:
        rollout = file[0]
        assert rollout.edges.min() > 0
        assert np.isfinite(rollout.predicted).all()
        obstacle = rollout.particle_type == 3
        assert obstacle.any() == (3 in types)
        following = given.positions[INPUT_FRAMES : INPUT_FRAMES + rollout.steps, obstacle]
        np.testing.assert_array_equal(rollout.predicted[:, obstacle], following)
        assert (rollout.predicted[:, ~obstacle] != rollout.true[:, ~obstacle]).any()


@pytest.mark.parametrize(("dim", "particles"), [(2, 2_500), (3, 8_000)])
def test_a_periodic_set_trains_and_rolls_out(tmp_path: Path, dim: int, particles: int) -> None:
    data, run = tmp_path / "data", tmp_path / "run"
    frames = 20 if dim == 2 else 14
    generate(replace(SMALL, scene="vortices", dim=dim, out=data, particles=None, frames=frames))  # type: ignore[arg-type]
    metadata = read_metadata(data)
    assert metadata.periodic == (True,) * dim
    given = open_split(data, "train")[0]
    assert given.positions.shape == (frames, particles, dim)
    moved = np.diff(given.positions, axis=0)
    assert np.abs(moved).max() > 0.5, "some come in on the other side"
    assert np.abs(minimum_image(moved, metadata.box)).max() < metadata.radius
    # Statistics are of the true motion, not of the jumps.
    assert max(metadata.velocity_std) < metadata.radius
    horizon = ["--test-horizon", "4", "--test-trajectories", "1", "--validate-horizon", "3"]
    main(["--preset", "smoke", "--data", str(data), "--out", str(run), "--steps", "3", *horizon])
    with RolloutFile(run / "rollouts" / "adaptive.h5") as file:
        rollout = file[0]
        low, high = metadata.bounds[0]
        assert rollout.predicted.min() >= low - 1e-6
        assert rollout.predicted.max() <= high + 1e-6
        assert rollout.edges.min() > 4 * particles
