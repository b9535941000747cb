"""Data sets of other solvers, in their own files."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest

from adaptgns.data import DataWarning, open_split, read_metadata
from adaptgns.data.check import check_split
from adaptgns.data.statistics import compute_statistics
from adaptgns.data.trajectories import SPLITS
from adaptgns.graph_statistics import graph_statistics
from adaptgns.inspect import main

TRAJECTORIES = {
    "taichi_water": (8, 2, 2),
    "taichi_sand": (6, 2, 2),
    "lagrangebench_lj3d": (1, 1, 1),
}
FRAMES = {
    "taichi_water": (400,) * 3,
    "taichi_sand": (320,) * 3,
    "lagrangebench_lj3d": (1214, 405, 405),
}
PARTICLES = {"taichi_water": (306, 951), "taichi_sand": (547, 1859), "lagrangebench_lj3d": (3, 3)}


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_every_file_reads(shared: Path, name: str) -> None:
    folder = shared / "data" / name
    metadata = read_metadata(folder)
    counts = []
    for split, expected, frames in zip(SPLITS, TRAJECTORIES[name], FRAMES[name], strict=True):
        trajectories = open_split(folder, split)
        assert len(trajectories) == expected
        assert set(trajectories.lengths.tolist()) == {frames}
        counts += trajectories.particle_counts.tolist()
        with warnings.catch_warnings():
            # Taichi's particles sink a little into the walls.
            warnings.simplefilter("ignore", DataWarning)
            check_split(trajectories, metadata)
        last = trajectories[-1]
        assert last.positions.shape == (frames, counts[-1], metadata.dim)
        np.testing.assert_array_equal(
            trajectories.window(-1, frames - 7, frames).positions, last.positions[-7:]
        )
    assert (min(counts), max(counts)) == PARTICLES[name]


@pytest.mark.parametrize("name", ["taichi_water", "taichi_sand"])
def test_statistics_equal_those_of_their_makers(shared: Path, name: str) -> None:
    folder = shared / "data" / name
    metadata = read_metadata(folder)
    computed = compute_statistics(open_split(folder, "train"), box=None, kinematic_types=(3,))
    for field in ("velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std"):
        assert getattr(computed, field) == pytest.approx(getattr(metadata, field), rel=1e-6)


def test_lagrangebench_metadata(shared: Path) -> None:
    metadata = read_metadata(shared / "data" / "lagrangebench_lj3d")
    assert metadata.periodic == (True,) * 3
    assert metadata.box is not None
    assert metadata.box.tolist() == [5.0] * 3
    assert metadata.kinematic_types == (1, 2)
    assert metadata.acceleration_std[0] == 0.0011505373986437917


@pytest.mark.parametrize(
    ("name", "nodes", "edges", "degree", "clustering"),
    [("taichi_water", 526, 1395, 5.29, 0.589), ("taichi_sand", 1139, 3699, 6.34, 0.578)],
)
def test_graph_statistics_at_step_100(
    shared: Path, *, name: str, nodes: int, edges: int, degree: float, clustering: float
) -> None:
    """The figures that came with the data."""
    folder = shared / "data" / name
    statistics = [
        graph_statistics(trajectories.window(index, 100, 101).positions[0], 0.015)
        for trajectories in (open_split(folder, split) for split in SPLITS)
        for index in range(len(trajectories))
    ]
    assert np.mean([s.nodes for s in statistics]) == pytest.approx(nodes, abs=0.5)
    assert np.mean([s.edges for s in statistics]) == pytest.approx(edges, abs=0.5)
    assert np.mean([s.degree for s in statistics]) == pytest.approx(degree, abs=0.005)
    assert np.mean([s.clustering for s in statistics]) == pytest.approx(clustering, abs=0.0005)


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_inspect(shared: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(shared / "data" / name)])
    told = capsys.readouterr().out
    assert "mean clustering" in told
    assert "error:" not in told


def test_statistics_are_added_to_a_copy(shared: Path, tmp_path: Path) -> None:
    """LagrangeBench data without its statistics gets them from the train split."""
    source = shared / "data" / "lagrangebench_lj3d"
    shutil.copyfile(source / "train.h5", tmp_path / "train.h5")
    text = (source / "metadata.json").read_text()
    (tmp_path / "metadata.json").write_text(
        text.replace('"vel_', '"former_vel_').replace('"acc_', '"former_acc_')
    )
    metadata = read_metadata(tmp_path)
    assert '"acc_std"' in (tmp_path / "metadata.json").read_text()
    with h5py.File(tmp_path / "train.h5") as file:
        step = np.diff(file["00000/position"][()].astype(np.float64), axis=0)
    step = (step + 2.5) % 5.0 - 2.5
    np.testing.assert_allclose(metadata.velocity_std, step.std((0, 1)), rtol=1e-9)
