"""Figures show what the runs hold, and refuse what is no run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from adaptgns.data.metadata import Metadata
from adaptgns.evaluate import evaluate
from adaptgns.figures import Figures, write_figures
from adaptgns.plot import main
from adaptgns.run_folder import RunFolder
from tests.unit.rollouts import write_rollout

LOG = [{"step": 1, "loss": 0.5}, {"step": 2, "loss": -0.5, "valid_rollout_mse": None}]


def make_run(folder: Path, metadata: Metadata, **changes: object) -> Path:
    """A run folder with a log of two lines and a report of two policies."""
    files = [
        write_rollout(folder / f"{policy}.h5", metadata, policy=policy, **changes)
        for policy in ("fixed", "adaptive")
    ]
    evaluate(files, out=folder)
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in LOG))
    return folder


@pytest.fixture
def run(tmp_path: Path, metadata: Metadata) -> Path:
    return make_run(tmp_path / "one", metadata)


def drawn(*runs: Path) -> dict[str, Figure]:
    return dict(Figures([RunFolder.read(run) for run in runs])._drawn())


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_every_figure_is_written_twice(tmp_path: Path, run: Path) -> None:
    main(["figures", str(run), "--out", str(tmp_path / "out")])
    names = {path.name for path in (tmp_path / "out").iterdir()}
    kinds = ("training", "steps", "calibration", "pareto")
    assert names == {f"{kind}.{form}" for kind in kinds for form in ("png", "pdf")}
    for kind in kinds:
        with Image.open(tmp_path / "out" / f"{kind}.png") as image:
            assert len(np.unique(np.asarray(image.convert("L")))) > 20
        assert (tmp_path / "out" / f"{kind}.pdf").read_bytes().startswith(b"%PDF")


def test_same_run_same_bytes(tmp_path: Path, run: Path) -> None:
    first, second = write_figures([run], tmp_path / "a"), write_figures([run], tmp_path / "b")
    assert [a.read_bytes() == b.read_bytes() for a, b in zip(first, second, strict=True)] == [
        True
    ] * 8


def test_curves_are_those_of_the_report(run: Path) -> None:
    report = json.loads((run / "metrics.json").read_text())["rollouts"][1]
    figures = drawn(run)
    errors, edges = figures["steps"].axes
    np.testing.assert_allclose(errors.get_lines()[1].get_ydata(), report["curves"]["mse"])
    np.testing.assert_allclose(edges.get_lines()[1].get_ydata(), report["curves"]["edges"])
    assert edges.get_lines()[1].get_xdata()[0] == 1
    calibration = figures["calibration"].axes[0].get_lines()[1]
    np.testing.assert_allclose(calibration.get_xdata(), report["calibration"]["predicted"])
    np.testing.assert_allclose(calibration.get_ydata(), report["calibration"]["squared_error"])
    point = figures["pareto"].axes[0].containers[1][0]
    assert point.get_xdata()[0] == pytest.approx(report["scalars"]["edges_per_step"]["mean"])
    assert point.get_ydata()[0] == pytest.approx(report["scalars"]["mse"]["mean"])
    point = figures["pareto"].axes[1].containers[1][0]
    times = [report["scalars"][name]["mean"] for name in ("graph_ms", "model_ms")]
    assert point.get_xdata()[0] == pytest.approx(sum(times)) == pytest.approx(2.5)
    loss, _, rollout = figures["training"].axes
    np.testing.assert_array_equal(loss.get_lines()[0].get_ydata(), [0.5, -0.5])
    np.testing.assert_array_equal(rollout.get_lines()[0].get_ydata(), [np.nan])


def test_runs_differ_in_colour_and_policies_in_dash(
    tmp_path: Path, metadata: Metadata, run: Path
) -> None:
    other = make_run(tmp_path / "two", metadata, error=2e-3)
    lines = drawn(run, other)["steps"].axes[0].get_lines()[:4]
    colours, dashes = ([getattr(x, f"get_{k}")() for x in lines] for k in ("color", "linestyle"))
    assert colours[0] == colours[1] != colours[2] == colours[3]
    assert dashes == ["-", "--"] * 2
    assert legend(drawn(run, other)["pareto"]) == [
        "one, fixed",
        "one, adaptive",
        "two, fixed",
        "two, adaptive",
    ]
    assert legend(drawn(run)["pareto"]) == ["GNS nll, fixed", "GNS nll, adaptive"]


def test_a_policy_of_ones_own_is_drawn(tmp_path: Path, metadata: Metadata) -> None:
    file = write_rollout(tmp_path / "own" / "mine.h5", metadata, policy="mine")
    evaluate([file], out=tmp_path / "own")
    assert len(write_figures([tmp_path / "own"], tmp_path / "out")) > 2


def test_radii_differ_in_colour(tmp_path: Path, metadata: Metadata) -> None:
    files = [
        write_rollout(tmp_path / f"{radius}.h5", metadata, radius=radius)
        for radius in (None, 0.019)
    ]
    evaluate(files, out=tmp_path)
    figure = drawn(tmp_path)["pareto"]
    assert legend(figure) == ["GNS nll, fixed", "GNS nll, fixed, r = 0.019"]
    colours = [container[0].get_color() for container in figure.axes[0].containers]
    assert colours[0] != colours[1]


def test_what_is_not_there_is_left_out(tmp_path: Path, metadata: Metadata, run: Path) -> None:
    (run / "metrics.json").unlink()
    assert set(drawn(run)) == {"training"}
    # A killed run may leave half a line.
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"step": 3, "lo')
    assert set(drawn(run)) == {"training"}
    no_variance = replace(metadata, dt=0.01)
    report = make_run(tmp_path / "two", no_variance, sigma=False)
    (report / "metrics.jsonl").unlink()
    assert set(drawn(report)) == {"steps", "pareto"}


@pytest.mark.parametrize(
    ("files", "told"),
    [
        ({}, "holds neither metrics.jsonl nor metrics.json; a folder that train or evaluate"),
        ({"metrics.json": "{"}, "metrics.json: not readable as JSON"),
        ({"metrics.json": '{"format": "x"}'}, r"its format and version are \('x', None\)"),
        ({"metrics.json": "[]"}, "its format and version are None"),
        ({"metrics.jsonl": '{"step": 1}\n{"st\n'}, "metrics.jsonl: line 2 is no JSON object"),
        ({"metrics.jsonl": '{"loss": 1}\n'}, "metrics.jsonl: line 1 is no JSON object with a step"),
        ({"metrics.jsonl": ""}, "hold an empty log and no report"),
    ],
)
def test_what_is_no_run_is_refused(tmp_path: Path, files: dict[str, str], told: str) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_text(content)
    with pytest.raises((ValueError, FileNotFoundError), match=told):
        write_figures([folder], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_runs_of_one_name_are_refused(tmp_path: Path, run: Path) -> None:
    with pytest.raises(ValueError, match=r"runs: got \['one', 'one'\]; one or more folders"):
        write_figures([run, run], tmp_path / "out")
    with pytest.raises(ValueError, match=r"runs: got \[\]"):
        write_figures([], tmp_path / "out")
