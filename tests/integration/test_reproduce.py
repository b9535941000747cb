"""The paper's tables and figures, tiny: all there, traceable, resumed, and refused where wrong."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from adaptgns.reproduce import ReproduceConfig, main, reproduce, study_of
from adaptgns.reproduce.report import MARKERS, write_into
from adaptgns.reproduce.results import Results, estimate

QUIET = Console(quiet=True)
FIGURES = ("statistics", "graphs", "sigma", "steps", "pareto", "reliability", "clouds")
TABLES = ("rollouts", "comparisons", "clouds", "sweep", "along", "calibration")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> ReproduceConfig:
    """The smoke profile, run once."""
    out = tmp_path_factory.mktemp("study")
    config = ReproduceConfig(preset="smoke", out=out, device="cpu", threads=1)
    reproduce(config, QUIET)
    return config


@pytest.fixture
def study(made: ReproduceConfig, tmp_path: Path) -> ReproduceConfig:
    """A copy of its metrics and report, to be spoilt."""
    assert made.out is not None
    out = tmp_path / "study"
    shutil.copytree(made.out, out, ignore=shutil.ignore_patterns("training", "data"))
    return replace(made, out=out, report_only=True)


def folder(config: ReproduceConfig) -> Path:
    assert config.out is not None
    return config.out


def tables(config: ReproduceConfig) -> dict[str, dict]:
    content = json.loads((folder(config) / "tables.json").read_text())
    return {table["name"]: table for table in content["tables"]}


def test_every_table_and_figure_is_there(made: ReproduceConfig) -> None:
    found = tables(made)
    assert {"statistics", "paper"} <= set(found)
    for data in ("waterdrop", "sand"):
        for name in TABLES:
            assert any(key.startswith(f"{name}-{data}") for key in found), (name, data)
        questions = [row["cells"][0] for row in found[f"comparisons-{data}"]["rows"]]
        assert "adaptive NLL or fixed MSE: the aim" in questions
    report = (folder(made) / "report.md").read_text()
    for name in FIGURES:
        assert f"(figures/{name}.png)" in report
        assert (folder(made) / "figures" / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
        assert (folder(made) / "figures" / f"{name}.pdf").read_bytes()[:5] == b"%PDF-"
    page = (folder(made) / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(FIGURES) + 2, "and a heat map a set"
    assert page.count("<table>") == len(found)
    assert str(folder(made)) not in report + (folder(made) / "tables.json").read_text()


def test_every_number_comes_from_the_files_that_its_row_names(made: ReproduceConfig) -> None:
    """Means of the scalars in the named files, computed here in another way."""
    checked = 0
    for name, table in tables(made).items():
        if name == "paper":
            continue
        for row in table["rows"]:
            assert row["files"] or row["cells"][0].endswith("paper's set"), (name, row)
        if not name.startswith("rollouts"):
            continue
        for row in table["rows"]:
            rows = [
                json.loads((folder(made) / file).read_text())["rollouts"][0]
                for file in row["files"]
                if not file.endswith("times.json")
            ]
            assert len(rows) == 2, "a file a seed"
            cells = dict(zip(table["columns"], row["cells"], strict=True))
            for column, scalar in (
                ("MSE@10", "mse@10"),
                ("edges a step", "edges_per_step"),
                ("ratio@10", "clumping@10"),
            ):
                mean = np.mean([each["scalars"][scalar]["mean"] for each in rows])
                shown = float(cells[column].split(" [")[0].replace(",", ""))
                assert shown == pytest.approx(mean, rel=0.01, abs=0.51 if mean > 10 else 0.006)
                checked += 1
    assert checked >= 60


def test_the_chosen_rule_is_within_the_budget_and_what_is_reported(made: ReproduceConfig) -> None:
    for data in ("waterdrop", "sand"):
        metrics = folder(made) / "metrics" / data
        result = json.loads((metrics / "sweep" / "sweep.json").read_text())
        chosen, budget = result["chosen"], result["settings"]["edges"]
        within = [row["mse"] for row in result["trials"] if row["edges"] <= budget]
        assert chosen["mse"] == min(within)
        valid = json.loads((metrics / "mse-0-fixed-valid.json").read_text())["rollouts"][0]
        assert budget == pytest.approx(valid["scalars"]["edges_per_step"]["mean"], rel=1e-5)
        for seed in (0, 1):
            row = json.loads((metrics / f"tuned-{seed}-adaptive.json").read_text())["rollouts"][0]
            assert row["settings"]["radius"] == chosen["radius"]
            assert row["settings"]["adaptive"]["factor"] == chosen["factor"]
            assert row["settings"]["training"]["seed"] == seed


def test_no_metrics_tell_where_they_were_made(made: ReproduceConfig) -> None:
    for path in (folder(made) / "metrics").rglob("*.json"):
        assert str(folder(made)) not in path.read_text(), path


def test_what_is_done_is_skipped_and_what_is_missing_is_made(made: ReproduceConfig) -> None:
    metrics = folder(made) / "metrics" / "waterdrop"
    before = {path: path.stat().st_mtime_ns for path in metrics.iterdir()}
    trained = folder(made) / "training" / "waterdrop" / "nll-1" / "last.safetensors"
    weights, gone = trained.read_bytes(), metrics / "nll-1-random.json"
    content = json.loads(gone.read_text())["rollouts"][0]
    gone.unlink()
    reproduce(made, QUIET)
    after = {path: path.stat().st_mtime_ns for path in metrics.iterdir()}
    assert {path for path in before if before[path] != after[path]} == {gone}
    assert trained.read_bytes() == weights, "not trained again"
    again = json.loads(gone.read_text())["rollouts"][0]
    assert again["scalars"]["mse@10"] == content["scalars"]["mse@10"]


def test_a_missing_run_is_told_and_the_report_stays(study: ReproduceConfig) -> None:
    before = (folder(study) / "report.md").read_bytes()
    (folder(study) / "metrics" / "sand" / "nll-1-adaptive.json").unlink()
    with pytest.raises(ValueError, match=r"nll-1-adaptive.json: missing.*--only 'sand/nll-1'"):
        reproduce(study, QUIET)
    assert (folder(study) / "report.md").read_bytes() == before


@pytest.mark.parametrize(
    ("of", "name", "value"),
    [("training", "lr", 0.5), ("training", "seed", 7), ("rollout", "adaptive", {"tau": 60.0})],
)
def test_a_run_of_another_configuration_is_refused(
    study: ReproduceConfig, of: str, name: str, value: object
) -> None:
    path = folder(study) / "metrics" / "waterdrop" / "nll-0-adaptive.json"
    content = json.loads(path.read_text())
    settings = content["rollouts"][0]["settings"]
    (settings["training"] if of == "training" else settings)[name] = value
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"nll-0-adaptive.json: was made with {name}"):
        reproduce(study, QUIET)


def test_a_training_of_another_configuration_is_refused(made: ReproduceConfig) -> None:
    study = study_of(made)
    run = next(iter(study.runs()))
    base = replace(study.profile.base, lr=0.1)
    other = replace(study, profile=replace(study.profile, base=base))
    run = next(each for each in other.runs() if each.name == run.name)
    with pytest.raises(ValueError, match=r"was made with lr 0.001; the study has 0.1"):
        run.train(QUIET)


def test_the_readme_gets_the_tables_between_its_marks(
    study: ReproduceConfig, tmp_path: Path
) -> None:
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{MARKERS[0]}\nold\n{MARKERS[1]}\nafter\n")
    reproduce(replace(study, readme=readme), QUIET)
    text = readme.read_text()
    assert text.startswith(f"before\n{MARKERS[0]}\n")
    assert text.endswith(f"{MARKERS[1]}\nafter\n")
    assert "old" not in text
    assert "| GNS, NLL | adaptive |" in text
    assert re.search(r"Made on \d{4}-\d\d-\d\d .* cores", text)
    readme.write_text("no marks")
    with pytest.raises(ValueError, match="holds no <!-- results -->"):
        write_into(study_of(study), readme)


def test_a_dry_run_lists_every_run_and_makes_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = ReproduceConfig(preset="smoke", out=tmp_path / "study", threads=1, dry_run=True)
    reproduce(config, Console(width=200))
    printed = capsys.readouterr().out
    for run in study_of(config).runs():
        assert re.search(rf"{re.escape(run.name)} +\d+\.\d\d h", printed)
    assert "together" in printed
    assert not (tmp_path / "study").exists()


def test_several_at_a_time(made: ReproduceConfig, tmp_path: Path) -> None:
    out = tmp_path / "study"
    config = replace(made, out=out, only="waterdrop/mlp-*", jobs=2)
    reproduce(config, QUIET)
    for seed in (0, 1):
        path = Path("metrics") / "waterdrop" / f"mlp-{seed}-fixed.json"
        one, other = (
            json.loads((root / path).read_text())["rollouts"][0]["scalars"]["mse"]
            for root in (out, folder(made))
        )
        assert one == other
    # One that fails is named, and the log says why.
    (out / "metrics" / "waterdrop" / "mlp-1-fixed.json").unlink()
    (out / "training" / "waterdrop" / "mlp-1" / "last.safetensors").write_bytes(b"damaged")
    with pytest.raises(RuntimeError, match="1 runs failed: waterdrop/mlp-1"):
        reproduce(config, QUIET)
    assert "cannot be read" in (out / "training" / "waterdrop" / "mlp-1.log").read_text()


def test_wrong_input_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (["--preset", "smoke", "--only", "nothing"], "'nothing' matches none of waterdrop/mse-0"),
        (["--jobs", "0"], "jobs: got 0; accepted are whole numbers >= 1"),
        (["--data", "nowhere", "--out", "/nonexistent/x"], "'nowhere'"),
    ):
        with pytest.raises(SystemExit) as left:
            main(arguments)
        assert left.value.code == 2
        assert message in capsys.readouterr().err.replace("\n", " ")


def test_intervals_hold_seeds_and_trajectories() -> None:
    rng = np.random.default_rng(0)
    seeds, trajectories = rng.normal(0, 1, (3, 1)), rng.normal(0, 2, (1, 10))
    found = estimate(5 + seeds + trajectories)
    assert found.mean == pytest.approx(5 + seeds.mean() + trajectories.mean())
    assert found.low < found.mean < found.high
    assert found.shown
    # All of a seed's trajectories move together: more of them do not narrow the interval to zero.
    spread = estimate(np.repeat(seeds, 1000, axis=1))
    assert spread.high - spread.low > 0.5 * np.ptp(seeds)
    assert not estimate(np.array([[-1.0, 1.0], [1.0, -1.0]])).shown
    assert np.isnan(estimate(np.array([[np.nan, 1.0]])).mean)


def test_differences_are_paired(made: ReproduceConfig) -> None:
    results = Results(study_of(made))
    one = results.find("sand", "nll", "adaptive")
    other = results.find("sand", "nll", "fixed")
    assert one is not None
    assert other is not None
    same = results.difference(one, one, "mse@10")
    assert (same.mean, same.low, same.high) == (0.0, 0.0, 0.0)
    found = results.difference(one, other, "mse@10")
    assert found.mean == pytest.approx(
        one.estimate("mse@10").mean - other.estimate("mse@10").mean, rel=1e-6, abs=1e-12
    )
