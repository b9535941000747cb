"""The inspect command's report."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from adaptgns.data import DataError, open_split, read_metadata
from adaptgns.data.metadata import write_metadata
from adaptgns.data.radius import advise_radius
from adaptgns.graph_statistics import graph_statistics
from adaptgns.inspect import main


def report(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    main(list(arguments))
    return capsys.readouterr().out


def row(report: str, name: str) -> list[str]:
    """The cells of the first table row that begins with `name`."""
    found = re.search(rf"^ {re.escape(name)} +\|(.*)$", report, re.MULTILINE)
    assert found is not None, f"no row {name} in\n{report}"
    return [cell.strip() for cell in found[1].split("|")]


def test_report_of_a_good_data_set(drops: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = report(capsys, str(drops), "--frame", "20")
    assert row(told, "train")[:2] == ["3", "40"]
    assert row(told, "connectivity radius") == ["0.015"]
    stored, computed = row(told, "acc_std")
    assert stored == computed
    graphs = [graph_statistics(t.positions[20], 0.015) for t in open_split(drops, "test")]
    for name in ("nodes", "density", "mean degree", "mean clustering", "undirected edges"):
        values = [getattr(graph, name.split()[-1]) for graph in graphs]
        mean, std = map(float, row(told, name))
        assert mean == pytest.approx(np.mean(values), rel=1e-3)
        assert std == pytest.approx(np.std(values), rel=1e-2, abs=1e-9)
    assert re.search(r"radius: r = 0\.01\d* gives 6 neighbours on average", told)
    assert "no problems found" in told
    assert "\x1b" not in told
    assert told.isascii()


def test_another_split_and_radius(drops: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = report(capsys, str(drops), "--split", "train", "--radius", "0.03")
    assert "graph at r = 0.03, frame 100 (the last frame in 3 shorter ones), 3 traj" in told


@pytest.mark.parametrize(("radius", "far_off"), [("0.002", True), ("0.015", False), ("0.2", True)])
def test_a_radius_far_off_is_a_problem(
    drops: Path, capsys: pytest.CaptureFixture[str], radius: str, far_off: bool
) -> None:
    told = report(capsys, str(drops), "--radius", radius)
    assert ("problems: 1" in told) == far_off
    assert ("warning: radius: r = " in told) == far_off


@pytest.mark.parametrize("asked", [None, "0.03"])
def test_without_a_radius_one_is_proposed(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: str | None
) -> None:
    shutil.copytree(drops, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "metadata.json"
    content = json.loads(path.read_text())
    del content["default_connectivity_radius"]
    path.write_text(json.dumps(content))
    with pytest.raises(
        DataError, match=r"no default_connectivity_radius; .*inspect .* proposes one"
    ):
        read_metadata(tmp_path)
    with pytest.raises(SystemExit) as left:
        main([str(tmp_path), "--frame", "20", *([] if asked is None else ["--radius", asked])])
    assert left.value.code == 1
    told = capsys.readouterr().out
    used = re.search(r"no default_connectivity_radius; here it is (0\.\d+)", told)
    advised = re.search(r"radius: r = (0\.\d+) gives 6 neighbours on average", told)
    assert used is not None
    assert advised is not None
    assert used[1] == (asked or advised[1])


def test_strays_and_flat_frames_do_not_spoil_the_advice() -> None:
    even = np.random.default_rng(0).random((2000, 2)).astype(np.float32)
    whole = advise_radius([even], None)
    assert whole is not None
    stray = np.concatenate([even, [[1e6, 0.0]]]).astype(np.float32)
    assert advise_radius([stray], None) == pytest.approx(whole, rel=0.01)
    flat = np.concatenate([even, np.full((2000, 1), 0.5, np.float32)], axis=1)
    assert advise_radius([flat], None) == pytest.approx(3**0.5 * whole, rel=0.1)
    assert advise_radius([even[:3]], None) is None
    assert advise_radius([even[:1]], None) is None
    assert advise_radius([np.zeros((50, 2), np.float32)], None) is None


def test_a_missing_valid_split_is_a_problem(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in drops.iterdir():
        if path.stem != "valid":
            shutil.copy(path, tmp_path)
    assert "train, but no valid split" in report(capsys, str(tmp_path))


def test_narrow_terminals(
    drops: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    tables = [line for line in report(capsys, str(drops)).splitlines() if "|" in line]
    assert max(map(len, tables)) <= 40


@pytest.fixture
def spoiled(tmp_path: Path) -> Path:
    """One of every problem."""
    rng = np.random.default_rng(0)
    for split in ("train", "test"):
        with h5py.File(tmp_path / f"{split}.h5", "w") as file:
            for index in range(3):
                steps = rng.normal(0, 1e-3, (12, 30, 2)).cumsum(0)
                positions = rng.uniform(0.2, 0.8, (30, 2)) + steps
                file[f"{index:05d}/position"] = positions.astype(np.float32)
                file[f"{index:05d}/particle_type"] = np.full(30, 5)
    with h5py.File(tmp_path / "test.h5", "r+") as file:
        file["00000/position"][11, 4] = np.nan
        file["00001/position"][3, 7] = 1.5, 0.5
    (tmp_path / "valid.npz").write_bytes(b"PK")
    metadata = {
        "dim": 2,
        "dt": 0.1,
        "bounds": [[0.0, 1.0], [0.0, 1.0]],
        "default_connectivity_radius": 0.2,
        "vel_mean": [0.0, 0.0],
        "vel_std": [1e-2, 1e-3],
        "acc_mean": [0.0, 0.0],
        "acc_std": [1.4e-3, 1.4e-3],
    }
    (tmp_path / "metadata.json").write_text(json.dumps(metadata))
    return tmp_path


def test_problems_are_all_told(spoiled: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([str(spoiled)])
    assert ended.value.code == 1
    told = capsys.readouterr().out
    problems = told[told.index("problems: ") :].splitlines()
    assert problems[0] == "problems: 5"
    expected = (
        r"error: .*valid\.npz: not a readable npz",
        r"warning: .*train\.h5: vel_std is 0\.01 0\.001 in metadata\.json, but 0\.00\d+ 0\.00\d+",
        r"error: .*test\.h5: trajectory 00000: frame 11: particle 4 is at \[nan, nan\]",
        r"warning: .*test\.h5: 1 of .* first trajectory 00001: frame 3: particle 7",
        r"warning: .*test\.h5: trajectory 00001: frame [34]: particle 7 is .* 5\.\d radii",
    )
    for pattern in expected:
        assert sum(re.search(pattern, line) is not None for line in problems) == 1, pattern
    assert "2 trajectories" in told[: told.index("problems: ")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frame", "-1"], "frame is -1"),
        (["--radius", "0"], "radius is 0.0"),
        (["--radius", "nan"], "radius is nan"),
    ],
)
def test_wrong_options(
    drops: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([str(drops), *arguments])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_missing_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for data, message in ((tmp_path, "metadata.json: there is no such file"), ("x", "'x'")):
        with pytest.raises(SystemExit) as ended:
            main([str(data)])
        assert ended.value.code == 2
        assert message in capsys.readouterr().err


def test_missing_split(drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("train.h5", "metadata.json"):
        (tmp_path / name).write_bytes((drops / name).read_bytes())
    with pytest.raises(SystemExit):
        main([str(tmp_path)])
    assert "no test.h5 or test.npz; the folder holds metadata.json, train" in (
        capsys.readouterr().err
    )


def test_the_test_split_may_have_bounds_of_its_own(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads((drops / "metadata.json").read_text())
    other = tmp_path / "other"
    shutil.copytree(drops, other)
    with h5py.File(other / "test.h5", "r+") as file:
        for trajectory in file.values():
            trajectory["position"][..., 0] += 1.0
    wider = content | {"bounds": [[0.1, 1.9], [0.1, 0.9]]}
    for metadata, told in ((content, True), ({"train": content, "rollout": wider}, False)):
        write_metadata(other, metadata)
        assert ("test.h5: " in report(capsys, str(other))) == told
