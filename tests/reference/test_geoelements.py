"""A geoelements/gns checkpoint reproduces the rollout that geoelements/gns itself recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from adaptgns.checkpoint import CheckpointError
from adaptgns.data.metadata import Metadata, read_metadata
from adaptgns.data.trajectories import Trajectory
from adaptgns.geoelements import read_geoelements
from adaptgns.policies import Fixed
from adaptgns.rollout import steps


@pytest.fixture
def peer(shared: Path) -> Path:
    return shared / "peer" / "geoelements_gns"


def test_recorded_rollout(peer: Path) -> None:
    simulator = read_geoelements(peer / "model-400.pt", read_metadata(peer))
    record = np.load(peer / "rollout.npz")
    trajectory = Trajectory(
        name="recorded",
        positions=np.concatenate([record["initial_positions"], record["ground_truth"]]),
        particle_type=record["particle_types"].astype(np.int64),
        material_property=None,
    )
    particles = len(trajectory.particle_type)
    for index, step in enumerate(steps(simulator, trajectory, Fixed(), 60)):
        deviation = np.abs(step.positions - record["predicted_rollout"][index]).max()
        if index < 5:
            assert deviation < 1e-6
            assert step.edges + particles == record["edges_including_self"][index]
        assert deviation < 2e-3


def test_other_files_are_refused_by_name(metadata: Metadata, tmp_path: Path) -> None:
    path = tmp_path / "model-1.pt"
    torch.save({"weight": torch.zeros(3)}, path)
    with pytest.raises(CheckpointError, match=r"model-1\.pt.*not a geoelements/gns state_dict"):
        read_geoelements(path, metadata)


def test_a_pickle_that_would_run_code_is_refused(metadata: Metadata, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path.touch, (tmp_path / "ran",))

    path = tmp_path / "model-2.pt"
    torch.save({"weight": Evil()}, path)
    with pytest.raises(
        CheckpointError, match=r"^checkpoint .*model-2\.pt: refused, .* tensors alone is accepted$"
    ):
        read_geoelements(path, metadata)
    assert not (tmp_path / "ran").exists()


def test_metadata_of_another_dimension_is_refused(peer: Path) -> None:
    other = replace(
        read_metadata(peer),
        dim=3,
        bounds=((0.0, 1.0),) * 3,
        periodic=(False,) * 3,
        velocity_mean=(0.0,) * 3,
        velocity_std=(1.0,) * 3,
        acceleration_mean=(0.0,) * 3,
        acceleration_std=(1.0,) * 3,
    )
    with pytest.raises(CheckpointError, match="fits the metadata"):
        read_geoelements(peer / "model-400.pt", other)
