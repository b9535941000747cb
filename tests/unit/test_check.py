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
from adaptgns.data.statistics import compute_statistics


def save(path: Path, *positions: np.ndarray, types: list[int] | None = None) -> None:
    """Without the writer's own checks."""
    with h5py.File(path, "w") as file:
        for index, one in enumerate(positions):
            file[f"{index:05d}/position"] = one.astype(np.float32)
            file[f"{index:05d}/particle_type"] = types or [5] * one.shape[1]


@pytest.fixture
def wide(metadata: Metadata) -> Metadata:
    """With a radius that no particle in these tests jumps farther than."""
    return replace(metadata, radius=2.0)


@pytest.fixture(params=[1, 1 << 22], ids=["frame by frame", "whole"])
def block(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check_module, "_BLOCK_VALUES", request.param)


def inside(frames: int = 9, particles: int = 3) -> np.ndarray:
    return np.random.default_rng(frames).uniform(0.1, 0.9, (frames, particles, 2))


@pytest.mark.usefixtures("block")
def test_good_data_passes(tmp_path: Path, wide: Metadata) -> None:
    walls = inside()
    walls[0, 0] = 0.1, 0.9
    save(tmp_path / "valid.h5", walls, inside(20))
    assert check_split(open_split(tmp_path, "valid"), wide) == (5,)


@pytest.mark.usefixtures("block")
def test_particles_outside_are_counted(tmp_path: Path, wide: Metadata) -> None:
    first, second = inside(), inside(20)
    first[4, 1, 0] = 0.95
    first[5:8, 1, 0] = 0.05
    second[19, 2] = 2.0, 3.0
    save(tmp_path / "valid.h5", inside(), first, second)
    expected = (
        r"valid\.h5: 5 of 114 positions, in 2 trajectories, lie outside the bounds .* by up to "
        r"2\.1; first trajectory 00001: frame 4: particle 1 at \[0\.94\d*, "
    )
    with pytest.warns(DataWarning, match=expected):
        check_split(open_split(tmp_path, "valid"), wide)


def test_periodic_axes_and_kinematic_particles_have_no_outside(
    tmp_path: Path, wide: Metadata
) -> None:
    positions = inside()
    positions[:, 0] = 5.0
    positions[:, 1:, 1] = -3.0
    save(tmp_path / "valid.h5", positions, types=[7, 5, 3])
    with h5py.File(tmp_path / "valid.h5", "a") as file:
        file["00001/position"] = inside(particles=1).astype(np.float32)
        file["00001/particle_type"] = [6]
    some = replace(wide, periodic=(False, True), kinematic_types=(3, 7))
    types = check_split(open_split(tmp_path, "valid"), some)
    assert types == (3, 5, 6, 7), "of all trajectories"


@pytest.mark.usefixtures("block")
def test_every_unusable_trajectory_is_told(tmp_path: Path, wide: Metadata) -> None:
    first, second, outside = inside(), inside(20), inside(30)
    first[2, 0] = np.nan
    second[13, 1] = np.inf
    outside[29] = 1.0
    save(tmp_path / "valid.h5", first, inside(), second, outside)
    split = open_split(tmp_path, "valid")
    problems = list(find_problems(split, wide))
    assert [problem.fatal for problem in problems] == [True, True, False]
    assert "valid.h5: trajectory 00000: frame 2: particle 0" in problems[0].message
    assert "valid.h5: trajectory 00002: frame 13: particle 1" in problems[1].message
    assert "first trajectory 00003: frame 29" in problems[2].message
    with pytest.raises(DataError, match="trajectory 00000: frame 2"):
        check_split(split, wide)


def drift(frames: int = 20, particles: int = 4) -> np.ndarray:
    """Particles that wander, a tenth of a radius a frame."""
    rng = np.random.default_rng(particles)
    steps = rng.normal(0, 1.5e-3, (frames, particles, 2))
    return 0.5 + rng.uniform(-0.2, 0.2, (particles, 2)) + steps.cumsum(0)


def problems_of(folder: Path, metadata: Metadata, split: str = "valid") -> list[str]:
    return [problem.message for problem in find_problems(open_split(folder, split), metadata)]


@pytest.mark.usefixtures("block")
def test_a_particle_that_jumps_is_told(tmp_path: Path, metadata: Metadata) -> None:
    jumping = drift()
    jumping[13:, 2, 0] += 0.06
    save(tmp_path / "valid.h5", drift(), jumping)
    (problem,) = problems_of(tmp_path, metadata)
    assert "valid.h5: trajectory 00001: frame 13: particle 2 is 0.0" in problem
    wrapped = drift()
    wrapped[13:, 2, 0] -= 0.8
    save(tmp_path / "valid.h5", wrapped)
    assert "is 0.8" in problems_of(tmp_path, replace(metadata, bounds=((-0.9, 0.9),) * 2))[0]
    assert not problems_of(tmp_path, replace(metadata, periodic=(True, False)))


def test_obstacles_that_are_not_called_so_are_told(tmp_path: Path, metadata: Metadata) -> None:
    obstacle = drift()
    obstacle[:, 1] = obstacle[0, 1]
    save(tmp_path / "valid.h5", obstacle, types=[5, 3, 5, 5])
    assert not problems_of(tmp_path, metadata)
    (problem,) = problems_of(tmp_path, replace(metadata, kinematic_types=(1, 2)))
    assert "particles of type 3 never move, but kinematic are those of type 1, 2" in problem


def test_rounding_that_drowns_the_motion_is_told(tmp_path: Path, metadata: Metadata) -> None:
    save(tmp_path / "valid.h5", drift() + 5e5)
    far = replace(metadata, bounds=((5e5, 5e5 + 1),) * 2, radius=1.0)
    (problem,) = problems_of(tmp_path, far)
    assert "positions reach 500001 along axis 0, where 32-bit numbers are 0.031 apart" in problem
    save(tmp_path / "valid.h5", drift() * [1e3, 1] + [5e5, 0])  # as far, and as much farther a step
    channel = {"bounds": ((5e5, 6e5), (0.0, 1.0)), "velocity_std": (2.0, 2e-3)}
    assert not problems_of(tmp_path, replace(far, **channel, radius=1e3))


@pytest.mark.usefixtures("block")
def test_statistics_of_other_data_are_told(tmp_path: Path, metadata: Metadata) -> None:
    save(tmp_path / "train.h5", drift(), drift(15, 6))
    found = compute_statistics(open_split(tmp_path, "train"), box=None, kinematic_types=())
    own = replace(metadata, **vars(found))
    assert not problems_of(tmp_path, own, "train")
    stale = replace(own, velocity_std=tuple(3 * std for std in own.velocity_std))
    (problem,) = problems_of(tmp_path, stale, "train")
    assert "vel_std is 0.00" in problem
    assert "in metadata.json, but 0.00" in problem
    flat = drift()
    flat[..., 1] = 0.5
    save(tmp_path / "train.h5", flat)
    found = compute_statistics(open_split(tmp_path, "train"), box=None, kinematic_types=())
    ones = {name: (getattr(found, name)[0], 1.0) for name in ("velocity_std", "acceleration_std")}
    assert not problems_of(tmp_path, replace(metadata, **(vars(found) | ones)), "train")


def test_forces_in_a_file_of_their_own_are_told_once(tmp_path: Path, wide: Metadata) -> None:
    (tmp_path / "force.py").write_text("raise SystemExit")  # which nobody runs
    for split, count in (("train", 1), ("test", 0)):
        save(tmp_path / f"{split}.h5", inside())
        problems = list(find_problems(open_split(tmp_path, split), wide))
        assert not any(problem.fatal for problem in problems)
        told = [each for each in problems if "force.py: LagrangeBench takes" in each.message]
        assert len(told) == count


def test_a_trajectory_without_anything_to_predict_is_refused(
    tmp_path: Path, metadata: Metadata
) -> None:
    save(tmp_path / "valid.h5", drift(), types=[3, 3, 3, 3])
    with pytest.raises(
        DataError, match=r"trajectory 00000: all particles are kinematic \(type 3\)"
    ):
        check_split(open_split(tmp_path, "valid"), metadata)


def test_other_material_properties_than_in_training_are_refused(
    tmp_path: Path, metadata: Metadata
) -> None:
    save(tmp_path / "valid.h5", drift())
    with pytest.raises(DataError, match="have 0 material properties, where those of the training"):
        check_split(open_split(tmp_path, "valid"), replace(metadata, material_properties=2))
