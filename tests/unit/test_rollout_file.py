"""The rollout file: what goes in comes out, and nothing that is not whole is read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectory import INPUT_FRAMES
from adaptgns.rollout_file import CATALOGUE, RolloutFile, RolloutFileError, RolloutWriter
from tests.unit.rollouts import Step, falling_block, settings, steps_of, write_rollout


def test_round_trip(tmp_path: Path, metadata: Metadata) -> None:
    trajectory = falling_block()
    small = falling_block(3, particles=7)
    steps = list(steps_of(trajectory, error=1e-3))
    path = tmp_path / "new" / "rollouts.h5"
    with RolloutWriter(path, metadata=metadata, settings=settings(policy="adaptive")) as writer:
        writer.add(trajectory, iter(steps), [(9, steps[3]), (11, steps[5])])
        writer.add(small, steps_of(small))
        assert not path.exists()
    with RolloutFile(path) as file:
        assert (len(file), [r.name for r in file]) == (2, ["block 0", "block 0"])
        assert file.metadata == metadata
        assert file.settings == settings(policy="adaptive")
        assert (file.label, file.policy, file.tau) == ("GNS nll", "adaptive", 70.0)
        rollout = file[0]
        np.testing.assert_array_equal(rollout.initial, trajectory.positions[:INPUT_FRAMES])
        np.testing.assert_array_equal(rollout.true, trajectory.positions[INPUT_FRAMES:])
        np.testing.assert_array_equal(rollout.predicted, [step.positions for step in steps])
        np.testing.assert_array_equal(rollout.sigma, [step.sigma for step in steps])
        np.testing.assert_array_equal(rollout.edges, [10] * 12)
        np.testing.assert_array_equal(rollout.particle_type, trajectory.particle_type)
        np.testing.assert_array_equal(rollout.graph_ms, np.float32([0.5] * 12))
        np.testing.assert_array_equal(rollout.model_ms, np.float32([2.0] * 12))
        one_step = rollout.one_step
        assert one_step is not None
        np.testing.assert_array_equal(one_step.frame, [9, 11])
        np.testing.assert_array_equal(one_step.squared_error[1], steps[5].squared_error)
        assert one_step.variance is not None
        np.testing.assert_allclose(one_step.variance[0], steps[3].sigma ** 2)
        assert file[1].one_step is None


def test_tensors_are_those_of_the_catalogue(tmp_path: Path, metadata: Metadata) -> None:
    found = {}
    with h5py.File(write_rollout(tmp_path / "r.h5", metadata)) as file:
        file["00000"].visititems(
            lambda name, item: (
                found.update({name: item}) if isinstance(item, h5py.Dataset) else None
            )
        )
        assert set(found) == set(CATALOGUE)
        for name, tensor in CATALOGUE.items():
            assert found[name].dtype == tensor.dtype
            assert found[name].ndim == len(tensor.shape.split())
            assert found[name].attrs["unit"] == tensor.unit


def test_model_without_variance_has_no_sigma(tmp_path: Path, metadata: Metadata) -> None:
    with RolloutFile(write_rollout(tmp_path / "r.h5", metadata, sigma=False)) as file:
        assert file[0].sigma is None
        one_step = file[0].one_step
        assert one_step is not None
        assert one_step.variance is None


def test_a_crash_leaves_the_file_of_before_and_no_other(tmp_path: Path, metadata: Metadata) -> None:
    path = write_rollout(tmp_path / "r.h5", metadata)
    before = path.read_bytes()

    def crash() -> Iterator[Step]:
        yield from steps_of(falling_block())
        raise RuntimeError("crash")

    with (
        pytest.raises(RuntimeError, match="crash"),
        RolloutWriter(path, metadata=metadata, settings={}) as writer,
    ):
        writer.add(falling_block(), crash())
    assert [each.name for each in tmp_path.iterdir()] == ["r.h5"]
    assert path.read_bytes() == before


def test_steps_that_do_not_fit_are_refused(tmp_path: Path, metadata: Metadata) -> None:
    trajectory = falling_block()
    steps = list(steps_of(trajectory))
    other = next(steps_of(falling_block(particles=5)))
    cases = {
        "steps: got none for trajectory block 0": [],
        "predicted: got a row of shape": [steps[0], other],
        "sigma: trajectory block 0 has shape": [steps[0], replace(steps[1], sigma=None)],
    }
    for message, wrong in cases.items():
        with (
            pytest.raises(ValueError, match=message),
            RolloutWriter(tmp_path / "r.h5", metadata=metadata, settings={}) as writer,
        ):
            writer.add(trajectory, wrong)
    assert not list(tmp_path.iterdir())


def test_only_whole_rollout_files_are_read(tmp_path: Path, metadata: Metadata) -> None:
    path = write_rollout(tmp_path / "r.h5", metadata)
    with pytest.raises(FileNotFoundError, match=r"none\.h5: there is no such file"):
        RolloutFile(tmp_path / "none.h5")
    with pytest.raises(RolloutFileError, match=r"is a folder; a file is accepted, such as .*r\.h5"):
        RolloutFile(tmp_path)
    (tmp_path / "cut.h5").write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(RolloutFileError, match=r"cut\.h5: not a whole HDF5 file"):
        RolloutFile(tmp_path / "cut.h5")
    with h5py.File(tmp_path / "other.h5", "w"):
        pass
    with pytest.raises(RolloutFileError, match="its format is None"):
        RolloutFile(tmp_path / "other.h5")
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 2
    with pytest.raises(RolloutFileError, match="accepted is 'adaptgns-rollout' version 1"):
        RolloutFile(path)


def test_trajectory_out_of_range(tmp_path: Path, metadata: Metadata) -> None:
    with (
        RolloutFile(write_rollout(tmp_path / "r.h5", metadata)) as file,
        pytest.raises(IndexError, match=r"got 2; .* has 2, counted from 0"),
    ):
        file[2]
