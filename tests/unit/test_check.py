"""Problems with the contents of a split."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from adaptgns.data import DataError, DataWarning, Metadata, open_split
from adaptgns.data import check as check_module
from adaptgns.data.check import check_split, find_problems


def save(path: Path, *positions: np.ndarray, types: list[int] | None = None) -> None:
    """Without the writer's own checks."""
    with h5py.File(path, "w") as file:
        for index, one in enumerate(positions):
            file[f"{index:05d}/position"] = one.astype(np.float32)
            file[f"{index:05d}/particle_type"] = types or [5] * one.shape[1]


@pytest.fixture(params=[1, 1 << 22], ids=["frame by frame", "whole"])
def block(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check_module, "_BLOCK_VALUES", request.param)


def inside(frames: int = 9, particles: int = 3) -> np.ndarray:
    return np.random.default_rng(frames).uniform(0.1, 0.9, (frames, particles, 2))


@pytest.mark.usefixtures("block")
def test_good_data_passes(tmp_path: Path, metadata: Metadata) -> None:
    walls = inside()
    walls[0, 0] = 0.1, 0.9
    save(tmp_path / "train.h5", walls, inside(20))
    assert check_split(open_split(tmp_path, "train"), metadata) == (5,)


@pytest.mark.usefixtures("block")
def test_particles_outside_are_counted(tmp_path: Path, metadata: Metadata) -> None:
    first, second = inside(), inside(20)
    first[4, 1, 0] = 0.95
    first[5:8, 1, 0] = 0.05
    second[19, 2] = 2.0, 3.0
    save(tmp_path / "train.h5", inside(), first, second)
    expected = (
        r"train\.h5: 5 of 114 positions, in 2 trajectories, lie outside the bounds .* by up to "
        r"2\.1; first trajectory 00001: frame 4: particle 1 at \[0\.94\d*, "
    )
    with pytest.warns(DataWarning, match=expected):
        check_split(open_split(tmp_path, "train"), metadata)


def test_periodic_axes_and_kinematic_particles_have_no_outside(
    tmp_path: Path, metadata: Metadata
) -> None:
    positions = inside()
    positions[:, 0] = 5.0
    positions[:, 1:, 1] = -3.0
    save(tmp_path / "train.h5", positions, types=[7, 5, 3])
    with h5py.File(tmp_path / "train.h5", "a") as file:
        file["00001/position"] = inside(particles=1).astype(np.float32)
        file["00001/particle_type"] = [6]
    metadata = replace(metadata, periodic=(False, True), kinematic_types=(3, 7))
    positions[:, 0] = 5.0
    types = check_split(open_split(tmp_path, "train"), metadata)
    assert types == (3, 5, 6, 7), "of all trajectories"


@pytest.mark.usefixtures("block")
def test_every_unusable_trajectory_is_told(tmp_path: Path, metadata: Metadata) -> None:
    first, second, outside = inside(), inside(20), inside(30)
    first[2, 0] = np.nan
    second[13, 1] = np.inf
    outside[29] = 1.0
    save(tmp_path / "train.h5", first, inside(), second, outside)
    split = open_split(tmp_path, "train")
    problems = list(find_problems(split, metadata))
    assert [problem.fatal for problem in problems] == [True, True, False]
    assert "train.h5: trajectory 00000: frame 2: particle 0" in problems[0].message
    assert "train.h5: trajectory 00002: frame 13: particle 1" in problems[1].message
    assert "first trajectory 00003: frame 29" in problems[2].message
    with pytest.raises(DataError, match="trajectory 00000: frame 2"):
        check_split(split, metadata)
