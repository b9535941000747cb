"""The evaluation of rollout files, and what it prints."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from rich.console import Console

from adaptgns.data.metadata import Metadata
from adaptgns.evaluate import evaluate, main, measure
from adaptgns.report import Report
from tests.unit.rollouts import write_rollout


def printed(report: Report, width: int, encoding: str = "utf-8") -> str:
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding=encoding)
    report.print(Console(file=stream, width=width))
    stream.flush()
    return raw.getvalue().decode(encoding)


def test_figures_of_a_known_error(tmp_path: Path, metadata: Metadata) -> None:
    path = write_rollout(tmp_path / "r.h5", metadata, error=1e-3)
    report = measure([path], marks=[5, 12])
    (rollout,) = report.rollouts
    # Off by 1e-3 · k along every axis at step k.
    assert rollout.mean("mse@5") == pytest.approx(25e-6, rel=1e-3)
    assert rollout.mean("mse@12") == pytest.approx(144e-6, rel=1e-3)
    assert rollout.scalars["mse@5"].shape == (2,)
    np.testing.assert_allclose(rollout.curves["mse"], 1e-6 * np.arange(1, 13) ** 2, rtol=2e-2)
    # Moving everything but the kinematic particles' counterparts aside keeps all pairs as they are.
    assert rollout.mean("clumping@5") == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(
        rollout.curves["edges_within_radius"][4] / rollout.curves["edges_within_radius_true"][4],
        rollout.mean("clumping@5"),
        rtol=0.05,
    )
    assert rollout.mean("edges_per_step") == 10
    assert (rollout.mean("graph_ms"), rollout.mean("model_ms")) == (0.5, 2.0)
    assert report.trajectories == ["block 0", "block 1"]
    assert rollout.spearman is not None
    assert 0.2 < rollout.spearman < 0.9
    assert rollout.calibration is not None
    with h5py.File(path) as file:
        error = np.stack([file[f"0000{i}/one_step/squared_error"][:, 3:] for i in (0, 1)])
        variance = np.stack([file[f"0000{i}/one_step/variance"][:, 3:] for i in (0, 1)])
    assert rollout.mean("one_step_mse") == pytest.approx(error.mean() / 2)
    assert rollout.calibration.squared_error.mean() == pytest.approx(error.mean(), rel=0.01)
    assert rollout.calibration.predicted.mean() == pytest.approx(2 * variance.mean(), rel=0.01)
    assert (np.diff(rollout.calibration.predicted) > 0).all()


def test_a_perfect_rollout(tmp_path: Path, metadata: Metadata) -> None:
    (rollout,) = measure([write_rollout(tmp_path / "r.h5", metadata, error=0.0)], [12]).rollouts
    assert rollout.mean("mse@12") == 0
    assert rollout.mean("clumping@12") == 1
    assert rollout.mean("kinetic_energy_error") == 0


def test_baselines_fly_on_the_same_trajectories(tmp_path: Path, metadata: Metadata) -> None:
    report = measure([write_rollout(tmp_path / "r.h5", metadata)], [12])
    velocity, gravity = report.baselines
    assert (velocity.label, gravity.label) == ("constant velocity", "constant gravity")
    # The blocks fall with 6e-5 per frame², which is g dt² to 2 %.
    assert velocity.mean("mse@12") == pytest.approx((6e-5 * 12 * 13 / 2) ** 2 / 2, rel=0.01)
    assert gravity.mean("mse@12") < 1e-3 * velocity.mean("mse@12")


def test_marks_past_the_end_are_told(tmp_path: Path, metadata: Metadata) -> None:
    short = write_rollout(tmp_path / "short.h5", metadata, steps=6, label="short")
    long = write_rollout(tmp_path / "long.h5", metadata, steps=12, label="long")
    report = measure([short, long], [5, 10, 20])
    assert [row.horizon for row in report.rollouts] == [6, 12]
    assert report.rollouts[0].mean("mse@10") is None
    assert report.rollouts[1].mean("mse@10") is not None
    assert report.baselines[0].horizon == 12
    assert report.notes == [
        "no figure at step 10, 20 for short, fixed: its shortest rollout has 6 steps",
        "no figure at step 20 for long, fixed: its shortest rollout has 12 steps",
    ]
    row = next(line for line in printed(report, 200).splitlines() if "short" in line)
    assert row.split()[2:5] == ["2.50e-05", "–", "–"]


def test_short_rollouts_are_measured_at_their_last_step(tmp_path: Path, metadata: Metadata) -> None:
    file = write_rollout(tmp_path / "short.h5", metadata, steps=12)
    report = measure([file])
    assert (report.marks, report.notes) == ([12], [])
    assert report.rollouts[0].mean("mse@12") is not None
    assert measure([file], [50]).marks == [50]
    longer = write_rollout(tmp_path / "long.h5", metadata, steps=60, label="long")
    both = measure([file, longer])
    assert both.marks == [50, 100, 200]
    assert both.rollouts[1].mean("mse@50") is not None
    assert "no figure at step 50, 100, 200 for" in both.notes[0]


def test_why_a_mean_is_missing_is_told(
    tmp_path: Path, metadata: Metadata, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("adaptgns.evaluate.MATCHED", 10)
    lonely = replace(metadata, radius=1e-6)
    report = measure([write_rollout(tmp_path / "short.h5", lonely)], [5])
    names = ", ".join(report.trajectories)
    assert report.notes == [
        f"no mean clumping@5, for want of one of trajectory {names}: no true edges there",
        f"no mean transport@5, for want of one of trajectory {names}: more than 10 particles to "
        "match",
    ]


def test_json_is_strict_and_whole(tmp_path: Path, metadata: Metadata) -> None:
    path = write_rollout(tmp_path / "r.h5", metadata)
    with h5py.File(path, "r+") as file:
        file["00000/predicted"][8:] = np.nan
    evaluate([path], [5, 12], out=tmp_path / "metrics")
    assert [each.name for each in (tmp_path / "metrics").iterdir()] == ["metrics.json"]
    content = json.loads((tmp_path / "metrics" / "metrics.json").read_text())
    (rollout,) = content["rollouts"]
    assert rollout["settings"]["policy"] == "fixed"
    # A rollout that diverged has no figure past that step, and its mean none either.
    assert rollout["scalars"]["mse@12"]["per_trajectory"][0] is None
    assert rollout["scalars"]["mse@12"]["per_trajectory"][1] == pytest.approx(144e-6, rel=1e-3)
    assert rollout["scalars"]["mse@12"]["mean"] is None
    assert rollout["scalars"]["mse@5"]["mean"] == pytest.approx(25e-6, rel=1e-3)
    assert len(rollout["calibration"]["gap"]) == 10
    assert content["notes"] == ["GNS nll, fixed diverged in trajectory block 0"]
    assert content["graph_statistics"]["step"] == 12
    assert content["graph_statistics"]["true"][0]["nodes"] == 40


@pytest.mark.parametrize("width", [200, 80, 40])
def test_a_narrow_table_keeps_every_number(tmp_path: Path, metadata: Metadata, width: int) -> None:
    files = [
        write_rollout(tmp_path / f"{policy}.h5", metadata, policy=policy, error=error)
        for policy, error in (("fixed", 1e-3), ("adaptive", 2e-3))
    ]
    report = measure(files, [5, 12])
    text = printed(report, width)
    lines = text.splitlines()
    assert max(map(len, lines)) <= width
    assert "…" not in text
    for row in report.rollouts:
        assert row.calibration is not None
        wanted = [f"{row.mean(name):.2e}" for name in ("mse@5", "mse@12")]
        wanted += [f"{row.spearman:.3f}", f"{row.calibration.ece:.4g}"]
        assert all(number in text for number in wanted)


def test_a_stream_that_knows_only_ascii(tmp_path: Path, metadata: Metadata) -> None:
    report = measure([write_rollout(tmp_path / "r.h5", metadata, label="Δ model")], [5, 50])
    assert "d*sigma^2" in printed(report, 80, encoding="ascii")


def test_model_without_variance(tmp_path: Path, metadata: Metadata) -> None:
    report = measure([write_rollout(tmp_path / "r.h5", metadata, sigma=False)], [5])
    (rollout,) = report.rollouts
    assert (rollout.spearman, rollout.calibration) == (None, None)
    assert rollout.mean("one_step_mse") is not None
    assert "Calibration" not in printed(report, 80)


def test_only_the_same_trajectories_are_compared(tmp_path: Path, metadata: Metadata) -> None:
    first = write_rollout(tmp_path / "a.h5", metadata)
    fewer = write_rollout(tmp_path / "fewer.h5", metadata, trajectories=1)
    with pytest.raises(ValueError, match=r"a\.h5 and .*fewer\.h5 .*hold 2 and 1 trajectories"):
        measure([first, fewer])
    with pytest.raises(ValueError, match="steps: got none"):
        measure([first], [])
    other = write_rollout(tmp_path / "other.h5", metadata)
    with h5py.File(other, "r+") as file:
        file["00001/initial"][0, 0, 0] += 0.01
    with pytest.raises(ValueError, match=r"trajectory 1 .* differs in its initial positions"):
        measure([first, other])


def test_rollouts_of_one_kind_are_told_apart(tmp_path: Path, metadata: Metadata) -> None:
    files = [write_rollout(tmp_path / name, metadata) for name in ("a.h5", "b.h5")]
    labels = [rollout.label for rollout in measure(files, [12]).rollouts]
    assert labels == [f"GNS nll ({file})" for file in files]
    assert measure(files[:1], [12]).rollouts[0].label == "GNS nll"


def test_kinematic_particles_alone_can_not_be_measured(tmp_path: Path, metadata: Metadata) -> None:
    walls = replace(metadata, kinematic_types=(3, 5))
    with pytest.raises(ValueError, match=r"block 0 .* has kinematic particles only"):
        measure([write_rollout(tmp_path / "r.h5", walls)])


def test_radius_of_the_graph_is_named_where_it_is_not_the_trained_one(
    tmp_path: Path, metadata: Metadata
) -> None:
    report = measure([write_rollout(tmp_path / "r.h5", metadata, radius=0.019)], [5])
    assert report.rollouts[0].policy == "fixed, r = 0.019"


def test_units_that_differ_are_told(tmp_path: Path, metadata: Metadata) -> None:
    files = [
        write_rollout(tmp_path / f"{noise}.h5", metadata, training={"noise": noise})
        for noise in (3e-4, 6.7e-4)
    ]
    assert any("normalized units" in note for note in measure(files, [5]).notes)
    assert not measure(files[:1], [5]).notes


def test_command(tmp_path: Path, metadata: Metadata, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_rollout(tmp_path / "r.h5", metadata)
    main(["--rollouts", str(path), "--steps", "5", "12"])
    assert "MSE@12" in capsys.readouterr().out
    assert json.loads((tmp_path / "metrics.json").read_text())["marks"] == [5, 12]
    with pytest.raises(SystemExit) as stopped:
        main(["--rollouts", str(tmp_path / "none.h5")])
    assert stopped.value.code == 2
    assert "there is no such file" in capsys.readouterr().err
