"""Generated scenes of every kind are trained on and rolled out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adaptgns.data import open_split
from adaptgns.data.scenes import SceneName
from adaptgns.data.trajectory import INPUT_FRAMES
from adaptgns.generate import GenerateConfig, generate
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
