"""The VTK series hold what the rollout holds, as another reader sees them."""

from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from adaptgns._core import adaptive_graph, radius_graph
from adaptgns.data.metadata import Metadata
from adaptgns.next_graph import next_graph
from adaptgns.plot import main, vtk
from adaptgns.rollout_file import RolloutFile
from tests.unit.rollouts import write_rollout

meshio = pytest.importorskip("meshio", reason="meshio is not installed")

RULE = {"tau": 70.0, "factor": 3.0}
FIELDS = {"velocity", "speed", "particle_type", "error", "sigma"}


@pytest.fixture
def adaptive(tmp_path: Path, metadata: Metadata) -> Path:
    return write_rollout(tmp_path / "a.h5", metadata, policy="adaptive", adaptive=RULE)


def read(folder: Path, series: str, frame: int) -> Any:
    return meshio.read(folder / series / f"{frame:05d}.vtu")


def pairs(mesh: Any, extra: int) -> set[tuple[int, int]]:
    lines = mesh.cells_dict["line"][mesh.cell_data_dict["extra"]["line"] == extra]
    return {tuple(sorted(line)) for line in lines.tolist()}


def undirected(edges: np.ndarray) -> set[tuple[int, int]]:
    return {(i, j) for i, j in edges.T.tolist() if i < j}


def test_index_names_every_nth_frame_and_the_last(tmp_path: Path, adaptive: Path) -> None:
    main(["vtk", str(adaptive), "--out", str(tmp_path / "out"), "--every", "5"])
    for series in ("truth", "prediction", "graph"):
        listed = ET.parse(tmp_path / "out" / f"{series}.pvd").getroot()[0]
        assert [float(entry.attrib["timestep"]) for entry in listed] == pytest.approx(
            [0.0, 0.0125, 0.025, 0.03]
        )
        names = {tmp_path / "out" / entry.attrib["file"] for entry in listed}
        assert names == set((tmp_path / "out" / series).iterdir())


def test_points_and_fields_are_those_of_the_rollout(tmp_path: Path, adaptive: Path) -> None:
    vtk(adaptive, tmp_path)
    with RolloutFile(adaptive) as file:
        rollout = file[0]
        initial, true, predicted = rollout.initial, rollout.true, rollout.predicted
        sigma, types = rollout.sigma, rollout.particle_type
    assert sigma is not None
    mesh = read(tmp_path, "prediction", 7)
    assert set(mesh.point_data) == FIELDS
    np.testing.assert_array_equal(mesh.points[:, :2], predicted[6])
    np.testing.assert_array_equal(mesh.points[:, 2], 0.0)
    assert len(mesh.cells_dict["vertex"]) == len(types)
    np.testing.assert_array_equal(mesh.point_data["particle_type"], types)
    np.testing.assert_array_equal(mesh.point_data["sigma"], sigma[6])
    distance = np.linalg.norm(predicted[6] - true[6], axis=1)
    np.testing.assert_allclose(mesh.point_data["error"], distance, rtol=1e-5)
    velocity = (predicted[6].astype(float) - predicted[5]) / 0.0025
    np.testing.assert_allclose(mesh.point_data["velocity"][:, :2], velocity, rtol=1e-12)
    speed = np.linalg.norm(velocity, axis=1)
    np.testing.assert_allclose(mesh.point_data["speed"], speed, rtol=1e-12)

    truth = read(tmp_path, "truth", 7)
    np.testing.assert_array_equal(truth.points[:, :2], true[6])
    assert set(truth.point_data) == {"velocity", "speed", "particle_type"}
    # Frame 0 is the last one that was given; nothing predicted its sigma.
    first = read(tmp_path, "prediction", 0)
    np.testing.assert_array_equal(first.points[:, :2], initial[-1])
    before = (initial[-1].astype(float) - initial[-2]) / 0.0025
    np.testing.assert_allclose(first.point_data["velocity"][:, :2], before, rtol=1e-12)
    assert np.isnan(first.point_data["sigma"]).all()


def test_lines_are_the_graph_of_the_next_step(
    tmp_path: Path, metadata: Metadata, adaptive: Path
) -> None:
    vtk(adaptive, tmp_path)
    with RolloutFile(adaptive) as file:
        positions, sigma = file[0].predicted[6], file[0].sigma
        mobile = metadata.mobile(file[0].particle_type)
    assert sigma is not None
    both = undirected(adaptive_graph(positions, sigma[6], 0.015, 70, 3.0, eligible=mobile))
    base = undirected(radius_graph(positions, 0.015))
    mesh = read(tmp_path, "graph", 7)
    assert pairs(mesh, 0) == base
    assert pairs(mesh, 1) == both - base != set()
    length = mesh.cell_data_dict["length"]["line"]
    ends = positions[mesh.cells_dict["line"]].astype(float)
    np.testing.assert_allclose(length, np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), rtol=1e-6)
    # Of frame 0, and of a policy that expands nothing, there is the base graph alone.
    assert not pairs(read(tmp_path, "graph", 0), 1)
    fixed = write_rollout(tmp_path / "f.h5", metadata, sigma=False)
    vtk(fixed, tmp_path / "fixed", every=7)
    assert pairs(read(tmp_path / "fixed", "graph", 7), 0) == base
    assert "sigma" not in read(tmp_path / "fixed", "prediction", 7).point_data


def test_what_the_file_does_not_tell_is_said(
    tmp_path: Path, metadata: Metadata, adaptive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vtk(adaptive, tmp_path / "adaptive", every=7)
    assert not capsys.readouterr().err
    nearest = write_rollout(tmp_path / "knn.h5", metadata, policy="knn")
    vtk(nearest, tmp_path / "knn", every=7)
    assert "what the policy knn chose is not recorded" in capsys.readouterr().err
    assert pairs(read(tmp_path / "knn", "graph", 7), 0)
    alone = write_rollout(tmp_path / "mlp.h5", metadata, sigma=False)
    with h5py.File(alone, "r+") as file:
        settings = json.loads(file.attrs["settings"])
        settings["training"] = {"model": {"edges": False}}
        file.attrs["settings"] = json.dumps(settings)
    with RolloutFile(alone) as file:
        mobile = metadata.mobile(file[0].particle_type)
        base, extra = next_graph(file, file[0].predicted[6], None, mobile)
    assert base.shape == extra.shape == (2, 0)


def test_lines_through_a_periodic_boundary_are_left_out(tmp_path: Path, metadata: Metadata) -> None:
    periodic = replace(metadata, periodic=(True, False), radius=0.02)
    path = write_rollout(tmp_path / "a.h5", periodic, trained_radius=0.02)
    with h5py.File(path, "r+") as file:
        file["00000/predicted"][:] = np.linspace(0.2, 0.8, 40)[:, None]
        file["00000/predicted"][:, :3] = [[0.105, 0.5], [0.895, 0.5], [0.885, 0.5]]
    vtk(path, tmp_path, every=12)
    with RolloutFile(path) as opened:
        assert (0, 1) in undirected(radius_graph(opened[0].predicted[-1], 0.02, box=periodic.box))
    drawn = pairs(read(tmp_path, "graph", 12), 0)
    assert (0, 1) not in drawn
    assert (1, 2) in drawn


def test_a_cloud_without_edges_is_written(tmp_path: Path, metadata: Metadata) -> None:
    path = write_rollout(tmp_path / "a.h5", metadata, trained_radius=1e-6)
    vtk(path, tmp_path, every=12)
    # meshio writes a mesh without cells, but reads none.
    piece = ET.parse(tmp_path / "graph" / "00012.vtu").getroot()[0][0]
    assert (piece.attrib["NumberOfPoints"], piece.attrib["NumberOfCells"]) == ("40", "0")


def test_what_is_refused(
    tmp_path: Path,
    adaptive: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"

    def told(*arguments: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            main(["vtk", str(adaptive), "--out", str(out), *arguments])
        assert stopped.value.code == 2
        assert not out.exists()
        return capsys.readouterr().err

    assert "error: every: got 0; accepted is 1 or more" in told("--every", "0")
    assert "error: trajectory: got 5; " in told("--trajectory", "5")
    old = tmp_path / "old"
    main(["vtk", str(adaptive), "--out", str(old), "--every", "10"])
    with pytest.raises(SystemExit):
        main(["vtk", str(adaptive), "--out", str(old)])
    assert "old: holds series already; remove it or name another" in capsys.readouterr().err
    with h5py.File(adaptive, "r+") as file:
        file["00000/predicted"][6:, 0] = np.nan
    assert "positions that are not finite from step 7 on" in told()
    monkeypatch.setitem(sys.modules, "meshio", None)
    assert "meshio, which is not installed: pip install 'adaptgns[formats]'" in told()
