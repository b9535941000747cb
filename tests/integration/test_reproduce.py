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

from adaptgns.checkpoint import BEST, LAST, PRETRAINED, read_checkpoint, write_checkpoint
from adaptgns.config import PolicyName
from adaptgns.data.trajectories import open_split
from adaptgns.fit import Diverged
from adaptgns.reproduce import ReproduceConfig, main, reproduce, study_of
from adaptgns.reproduce.estimates import seconds
from adaptgns.reproduce.figures import colour, pareto_front
from adaptgns.reproduce.profiles import PROFILES, Model, ProfileName
from adaptgns.reproduce.report import MARKERS, write_into
from adaptgns.reproduce.results import Estimate, Results, estimate
from adaptgns.reproduce.runs import DataSet, Run, Study, StudyError, matched_radius
from adaptgns.reproduce.tables import COMPARISONS

QUIET = Console(quiet=True)
FIGURES = ("statistics", "graphs", "sigma", "steps", "long", "pareto", "reliability", "clouds")
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
        aim = "the chosen rule or fixed MSE: the aim, 4 times the training"
        assert (aim in questions) == (data == "waterdrop"), "trained on water alone"
    for name in ("long", "sweep-400", "sweep-divergence-400"):
        assert f"{name}-waterdrop" in found
        assert f"{name}-sand" not in found
    report = (folder(made) / "report.md").read_text()
    for name in FIGURES:
        assert f"(figures/{name}.png)" in report
        assert (folder(made) / "figures" / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
        assert (folder(made) / "figures" / f"{name}.pdf").read_bytes()[:5] == b"%PDF-"
    page = (folder(made) / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(FIGURES) + 4, "and a heat map a sweep"
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
        centre = table["rows"].pop()
        assert centre["files"] == [f"metrics/{name.split('-')[1]}/data.json"]
        for row in table["rows"]:
            rows = [
                json.loads((folder(made) / file).read_text())["rollouts"][0]
                for file in row["files"]
                if not file.endswith("times.json")
            ]
            seeds = 1 if "400 %" in row["cells"][0] else 2
            assert len(rows) == seeds, "a file a seed"
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


def test_long_rollouts_go_on_where_the_others_end(made: ReproduceConfig) -> None:
    """Their table is of the files that it names, and they are of the same trajectories."""
    table = tables(made)["long-waterdrop"]
    *rows, centre = table["rows"]
    assert [row["cells"][1] for row in rows] == ["fixed", "adaptive", "random", "two-sided"]
    for row in rows:
        long = json.loads((folder(made) / row["files"][0]).read_text())
        scalars, curves = (long["rollouts"][0][kind] for kind in ("scalars", "curves"))
        assert len(curves["mse"]) == 34, "all that 40 frames leave"
        ratio = np.mean(curves["edges_within_radius"]) / np.mean(curves["edges_within_radius_true"])
        cells = dict(zip(table["columns"], row["cells"], strict=True))
        for column, value in (
            ("MSE@20", curves["mse"][19]),
            ("MSE@34", curves["mse"][-1]),
            ("edges a step", np.mean(curves["edges"])),
            ("ratio", ratio),
            ("ratio@34", scalars["clumping@34"]["mean"]),
            ("kinetic energy error", scalars["kinetic_energy_error"]["mean"]),
        ):
            shown = float(cells[column].split(" [")[0].replace(",", ""))
            assert shown == pytest.approx(value, rel=0.01, abs=0.51 if value > 10 else 0.006)
        short = Path(row["files"][0].replace("-long", ""))
        short = json.loads((folder(made) / short).read_text())["rollouts"][0]["scalars"]
        assert scalars["mse@10"] == short["mse@10"]
    described = json.loads((folder(made) / centre["files"][0]).read_text())
    shown = [float(cell.split(" [")[0]) for cell in centre["cells"][2:5]]
    assert shown == pytest.approx([np.mean(v) for v in described["centroid_mse"].values()], 0.01)
    one, other = (
        open_split(folder(made) / "data" / name, "test") for name in ("waterdrop", "waterdrop-long")
    )
    for begun, long in zip(one, other, strict=True):
        np.testing.assert_array_equal(begun.positions, long.positions[: len(begun.positions)])


@pytest.mark.parametrize(
    ("tuned", "policy", "sweep", "budget", "seeds", "sets"),
    [
        ("tuned", "adaptive", "sweep", "mse", (0, 1), ("waterdrop", "sand")),
        ("tuned-400", "adaptive", "sweep-400", "mse-400", (0,), ("waterdrop",)),
        (
            *("tuned-divergence-400", "divergence", "sweep-divergence-400", "mse-400"),
            *((0,), ("waterdrop",)),
        ),
    ],
)
def test_the_chosen_rule_is_within_the_budget_and_what_is_reported(
    made: ReproduceConfig,
    tuned: str,
    policy: str,
    sweep: str,
    budget: str,
    seeds: tuple[int, ...],
    sets: tuple[str, ...],
) -> None:
    for data in sets:
        metrics = folder(made) / "metrics" / data
        result = json.loads((metrics / sweep / "sweep.json").read_text())
        chosen, edges = result["chosen"], result["settings"]["edges"]
        within = [row["mse"] for row in result["trials"] if row["edges"] <= edges]
        assert chosen["mse"] == min(within)
        valid = json.loads((metrics / f"{budget}-0-fixed-valid.json").read_text())["rollouts"][0]
        assert edges == pytest.approx(valid["scalars"]["edges_per_step"]["mean"], rel=1e-5)
        for seed in seeds:
            path = metrics / f"{tuned}-{seed}-{policy}.json"
            row = json.loads(path.read_text())["rollouts"][0]
            assert row["settings"]["training"]["steps"] == (12 if tuned == "tuned" else 48)
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


def test_what_the_package_ships_is_not_trained(
    made: ReproduceConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither for its own rollouts nor for what builds on them, unless anything differs. (The
    chosen rules need edges of a model that is not shipped besides.)"""
    trained = folder(made) / "training" / "waterdrop" / "nll-400-0"
    shipped = tmp_path / "shipped" / "waterdrop.safetensors"
    shipped.parent.mkdir()
    shutil.copyfile(trained / BEST, shipped)
    monkeypatch.setattr("adaptgns.reproduce.runs.PRETRAINED", shipped.parent)

    def failing(*_: object) -> None:
        raise Diverged("it was trained")

    monkeypatch.setattr("adaptgns.reproduce.runs.train", failing)
    config = replace(made, out=tmp_path / "study", only="waterdrop/*-400-0", data=("waterdrop",))
    shutil.copytree(folder(made) / "data", folder(config) / "data")
    budget = Path("metrics", "waterdrop", "mse-400-0-fixed-valid.json")
    (folder(config) / budget).parent.mkdir(parents=True)
    shutil.copyfile(folder(made) / budget, folder(config) / budget)
    with pytest.raises(RuntimeError, match="1 runs failed: waterdrop/mse-400-0"):
        reproduce(config, QUIET)
    for name in ("nll-400-0-random.json", "nll-400-0-fixed-long.json", "tuned-400-0-adaptive.json"):
        one, other = (
            json.loads((folder(each) / "metrics" / "waterdrop" / name).read_text())["rollouts"][0]
            for each in (made, config)
        )
        assert one["scalars"]["mse"] == other["scalars"]["mse"]
        assert one["settings"] == other["settings"]
    # A step is timed with it, too.
    times = folder(config) / "metrics" / "waterdrop" / "times.json"
    [data] = study_of(config).sets.values()
    data.time_steps([Run(data, study_of(config).profile.model("tuned-400"), 0)])
    rule = data.rule(study_of(config).profile.model("tuned-400").chosen)
    told = f"tau {rule['tau']:g}, factor {rule['factor']:g}, radius {rule['radius']:g}"
    assert list(json.loads(times.read_text())["times"]) == [
        f"tuned-400, adaptive, {told}",
        f"tuned-400, random, {told}",
    ]

    right = read_checkpoint(shipped)
    metadata = replace(right.metadata, velocity_mean=(0.0, 0.0))
    for wrong, only, message in (
        (replace(right, config=replace(right.config, lr=0.1)), "nll-400-0", "it was trained"),
        (replace(right, metadata=metadata), "nll-400-0", "it was trained"),
        (replace(right, metadata=metadata), "tuned-400-0", "needs waterdrop/nll-400-0, which is"),
    ):
        write_checkpoint(shipped, wrong)
        for path in (folder(config) / "metrics" / "waterdrop").glob(f"{only}-*"):
            path.unlink()
        with pytest.raises((ValueError, Diverged), match=message):
            reproduce(replace(config, only=f"waterdrop/{only}"), QUIET)


def test_laptop_goes_on_training_on_water_alone_and_every_comparison_is_of_models_that_exist(
    tmp_path: Path,
) -> None:
    study = study_of(ReproduceConfig(preset="laptop", out=tmp_path / "study"))
    longest = {run.name for run in study.runs() if run.model.share == 8}
    assert longest == {f"waterdrop/{name}-800-0" for name in ("mse", "nll", "tuned")}
    long = {run.name for run in study.runs() if run.model.name == "nll-400"}
    assert long == {f"{data}/nll-400-{seed}" for data in ("waterdrop", "sand") for seed in (0, 1)}
    models = [model for profile in PROFILES.values() for model in profile.models]
    known = {(model.name, policy) for model in models for policy in model.policies}
    for question, one, other in COMPARISONS:
        assert {one, other} <= known, question
    prominent = {model.name for model in study.profile.models if model.prominent}
    assert {"mse", "nll-adaptive", "nll-400", "nll-800"} <= prominent
    assert not {"nll-30", "beta-nll", "mse-matched"} & prominent


def test_the_package_ships_two_runs_of_laptop(tmp_path: Path) -> None:
    def shipped(study: Study) -> dict[str, Path]:
        found = {run.name: run.shipped for run in study.runs() if run.model.chosen is None}
        return {name: path for name, path in found.items() if path is not None}

    config = ReproduceConfig(preset="laptop", out=tmp_path / "study")
    assert shipped(study_of(config)) == {
        f"{data}/nll-400-0": PRETRAINED / f"{data}.safetensors" for data in ("waterdrop", "sand")
    }
    assert not shipped(study_of(replace(config, preset="smoke")))


def test_what_came_later_is_timed_alone(study: ReproduceConfig, made: ReproduceConfig) -> None:
    for name in ("training", "data"):
        shutil.copytree(folder(made) / name, folder(study) / name)
    shutil.rmtree(folder(study) / "training" / "waterdrop" / "mse-400-0")  # not needed: no sigma
    path = folder(study) / "metrics" / "waterdrop" / "times.json"
    before = json.loads(path.read_text())
    [random] = [name for name in before["times"] if name.startswith("tuned-400, random, tau 70")]
    del before["times"]["mse, divergence"], before["times"][random]
    path.write_text(json.dumps(before))
    again = replace(study, report_only=False, data=("waterdrop",))
    with pytest.raises(ValueError, match=r"timed with 1 threads, not 2; give --threads 1"):
        reproduce(replace(again, threads=2), QUIET)
    reproduce(again, QUIET)
    after = json.loads(path.read_text())["times"]
    assert {name: after.pop(name) for name in ("mse, divergence", random)}
    assert after == before["times"]


def test_a_step_that_was_not_timed_is_told(study: ReproduceConfig) -> None:
    path = folder(study) / "metrics" / "waterdrop" / "times.json"
    content = json.loads(path.read_text())
    del content["times"]["nll, random"]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"times\.json: has no step of nll, random; the command"):
        reproduce(study, QUIET)


def test_what_another_processor_took_is_marked(study: ReproduceConfig) -> None:
    path = folder(study) / "metrics" / "waterdrop" / "times.json"
    content = json.loads(path.read_text())
    content["times"]["nll, random"]["processor"] = "another"
    path.write_text(json.dumps(content))
    reproduce(study, QUIET)
    report = (folder(study) / "report.md").read_text()
    marked = [line for line in report.splitlines() if line.startswith("|") and "†" in line]
    assert marked
    assert all("| random |" in line for line in marked)
    assert report.count("† on another processor") == 1


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


def spoil(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("sand/nll-0-fixed.json", {"data_fingerprint": "another"}, "was measured on other data"),
        ("sand/nll-0-fixed.json", {"marks": [5, 20]}, r"was measured at other steps, \[5, 20\]"),
        ("sand/sweep/sweep.json", {"settings": {"tau": [80.0]}}, "was made with tau"),
        ("sand/sweep/sweep.json", {"settings": {"edges": 1.0}}, "was made with edges 1.0; the"),
        ("waterdrop/sweep-400/sweep.json", {"settings": {"steps": 9}}, "was made with steps"),
        ("waterdrop/nll-400-0-fixed-long.json", {"data_fingerprint": "x"}, "on other data"),
        ("waterdrop/nll-400-0-fixed-long.json", {"marks": [5, 20]}, "measured at other steps"),
    ],
)
def test_what_is_not_of_this_study_is_refused(
    study: ReproduceConfig, name: str, changes: dict, message: str
) -> None:
    spoil(folder(study) / "metrics" / name, **changes)
    with pytest.raises(ValueError, match=message):
        reproduce(study, QUIET)


def test_other_data_of_one_name_are_refused(made: ReproduceConfig, tmp_path: Path) -> None:
    other = tmp_path / "waterdrop"
    shutil.copytree(folder(made) / "data" / "sand", other)
    with pytest.raises(ValueError, match="describes other data than those in"):
        reproduce(replace(made, data=(str(other), "sand")), QUIET)


def test_nothing_builds_on_half_a_training(made: ReproduceConfig, tmp_path: Path) -> None:
    out = tmp_path / "study"
    shutil.copytree(folder(made), out)
    for path in (out / "metrics" / "sand").glob("tuned-*"):
        path.unlink()
    last = out / "training" / "sand" / "nll-1" / LAST
    checkpoint = read_checkpoint(last)
    for half in (replace(checkpoint, step=4), replace(checkpoint, validated=False)):
        write_checkpoint(last, half)
        with pytest.raises(ValueError, match=r"sand/tuned-1: needs sand/nll-1, which is at step"):
            reproduce(replace(made, out=out, only="sand/tuned-1"), QUIET)


def test_a_run_that_fails_keeps_none_of_the_others(
    made: ReproduceConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "study"
    shutil.copytree(folder(made) / "data", out / "data")
    train = Run.train

    def failing(run: Run, console: Console) -> None:
        if run.name == "waterdrop/mlp-0":
            raise Diverged("the loss became nan")
        train(run, console)

    monkeypatch.setattr(Run, "train", failing)
    with pytest.raises(RuntimeError, match="1 runs failed: waterdrop/mlp-0"):
        reproduce(replace(made, out=out, only="*/mlp-*"), QUIET)
    done = sorted(path.stem for path in (out / "metrics" / "waterdrop").glob("mlp-*"))
    assert done == ["mlp-1-fixed"]


def test_a_diverged_rollout_is_reported(study: ReproduceConfig) -> None:
    """Its figures are null in the metrics, and a dash in the tables."""
    path = folder(study) / "metrics" / "sand" / "nll-1-two-pass.json"
    content = json.loads(path.read_text())
    scalars = content["rollouts"][0]["scalars"]
    for name in ("mse@10", "clumping@10", "kinetic_energy_error", "transport@10"):
        scalars[name] = {"mean": None, "per_trajectory": [None, 1.0]}
    path.write_text(json.dumps(content))
    reproduce(study, QUIET)
    row = next(
        row["cells"]
        for row in tables(study)["rollouts-sand"]["rows"]
        if row["cells"][:2] == ["GNS, NLL", "two-pass"]
    )
    assert row[4] == "–"
    assert "nan" not in (folder(study) / "report.md").read_text()


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
    assert "400 % of the steps" in text
    # Those are for the report alone.
    for left_out in ("30 % of the steps", "two-pass", "base-sigma", "divergence"):
        assert left_out not in text
    assert re.search(r"Made with .* on \d{4}-\d\d-\d\d on .* cores, torch", text)
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


def test_a_dry_run_counts_what_is_missing(made: ReproduceConfig, tmp_path: Path) -> None:
    def estimate(out: Path) -> float:
        study = study_of(replace(made, out=out))
        return seconds(next(run for run in study.runs() if run.name == "waterdrop/nll-0"))

    out = tmp_path / "study"
    shutil.copytree(folder(made), out)
    (out / "metrics" / "waterdrop" / "nll-0-adaptive.json").unlink()
    rollout = estimate(out)
    (out / "training" / "waterdrop" / "nll-0" / "last.safetensors").unlink()
    assert 0 < rollout < estimate(out) < estimate(tmp_path / "new")


def test_a_dry_run_tells_what_the_gate_may_cost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    smoke = PROFILES["smoke"]
    monkeypatch.setitem(PROFILES, "smoke", replace(smoke, gate=1.2, gate_steps=48))
    config = ReproduceConfig(preset="smoke", out=tmp_path / "study", threads=1, dry_run=True)
    reproduce(config, QUIET)
    assert not capsys.readouterr().out
    reproduce(config, Console(width=200))
    assert "12 steps, or twice as many, and so on up to 48, until" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("edges", "share"), [(70.0, -0.3), (100.0, 0.0), (130.0, 0.3), (200.0, 1.0), (210.0, 1.1)]
)
def test_the_matched_radius_is_on_a_line_in_its_square(
    edges: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {
        ("mse", "fixed"): 100.0,
        ("mse-denser", "fixed"): 200.0,
        ("decoupled-weight", "adaptive"): edges,
    }

    def valid_edges(_data: DataSet, model: Model, seed: int, policy: PolicyName) -> float:
        assert seed == 0
        return found[model.name, policy]

    monkeypatch.setattr("adaptgns.reproduce.runs.valid_edges", valid_edges)
    sand = study_of(ReproduceConfig(preset="laptop")).sets["sand"]
    radius = matched_radius(sand, "decoupled-weight", 0.02)
    assert (radius / 0.02) ** 2 == pytest.approx(1 + share * ((0.019 / 0.015) ** 2 - 1), rel=1e-4)
    for far in (5.0, 400.0):
        found["decoupled-weight", "adaptive"] = far
        with pytest.raises(StudyError, match=f"sand: no radius matches the {far:.0f} edges of"):
            matched_radius(sand, "decoupled-weight", 0.02)
    found["mse-denser", "fixed"] = 90.0
    with pytest.raises(StudyError, match="fixed graphs have 100 at "):
        matched_radius(sand, "decoupled-weight", 0.02)
    smoke = study_of(ReproduceConfig(preset="smoke")).sets["sand"]
    with pytest.raises(StudyError, match="no model with the denser graph"):
        matched_radius(smoke, "nll", 0.02)


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


@pytest.mark.parametrize(
    ("seeds", "trajectories", "rest"),
    [(1.0, 0.0, 0.3), (1.0, 1.0, 1.0), (0.0, 1.0, 0.5), (0.0, 0.0, 1.0), (1.0, 1.0, 0.1)],
)
def test_intervals_cover(seeds: float, trajectories: float, rest: float) -> None:
    """Of 1,000 studies of three seeds and ten trajectories, about 950 hold the truth, whatever
    varies: seeds, trajectories or neither."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(1_000):
        values = seeds * rng.normal(size=(3, 1)) + trajectories * rng.normal(size=(1, 10))
        found = estimate(5 + values + rest * rng.normal(size=(3, 10)))
        held += found.low <= 5 <= found.high
    assert 900 <= held <= 990


def test_intervals_of_little() -> None:
    assert estimate(np.full((3, 4), 2.0)) == Estimate(2.0, 2.0, 2.0)
    one = estimate(np.array([[1.0]]))
    assert (one.mean, one.low, one.high) == (1.0, -np.inf, np.inf)
    for values in (np.array([[np.nan, 1.0]]), np.empty((3, 0))):
        assert np.isnan(estimate(values).mean)
    # Trajectories alone: Student's t of their mean.
    alone = estimate(np.array([[1.0, 2.0, 4.0]]))
    assert alone.high - alone.mean == pytest.approx(
        4.3027 * np.std([1, 2, 4], ddof=1) / 3**0.5, 1e-4
    )


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


@pytest.mark.parametrize("preset", ["smoke", "laptop", "full", "paper"])
def test_models_of_the_same_length_differ_in_colour(preset: ProfileName) -> None:
    colours: dict[str, set[str]] = {}
    models = PROFILES[preset].models
    for model in models:
        colours.setdefault(model.length, set()).add(colour(model))
    counts = {length: sum(model.length == length for model in models) for length in colours}
    assert {length: len(found) for length, found in colours.items()} == counts


def test_titles_tell_length_and_seeds() -> None:
    laptop = PROFILES["laptop"]
    titles = {
        name: laptop.model(name).title
        for name in ("nll", "nll-30", "nll-400", "nll-narrow-400", "beta-nll")
    }
    assert titles == {
        "nll": "GNS, NLL",
        "nll-30": "GNS, NLL, 30 % of the steps",
        "nll-400": "GNS, NLL, 400 % of the steps",
        "nll-narrow-400": "AdaptGNS, trained on adaptive graphs, r 0.01425, "
        "400 % of the steps, one seed",
        "beta-nll": "GNS, beta-NLL, one seed",
    }


@pytest.mark.parametrize(
    ("points", "front"),
    [
        ([(3.0, 1.0), (1.0, 2.0), (2.0, 2.0), (2.0, 3.0)], [(1.0, 2.0), (3.0, 1.0)]),
        ([(1.0, 2.0), (1.0, 1.0), (1.0, 1.0)], [(1.0, 1.0)]),
        ([(1.0, float("nan")), (2.0, 1.0)], [(2.0, 1.0)]),
        ([], []),
    ],
)
def test_the_front_is_what_nothing_undercuts(
    points: list[tuple[float, float]], front: list[tuple[float, float]]
) -> None:
    assert [tuple(point) for point in pareto_front(points)] == front


def test_only_seeds_of_both_are_compared(made: ReproduceConfig) -> None:
    results = Results(study_of(made))
    pair = results.pair("waterdrop", ("nll-400", "fixed"), ("nll", "fixed"))
    assert pair is not None
    assert [[run.name for run in each.runs] for each in pair] == [
        ["waterdrop/nll-400-0"],
        ["waterdrop/nll-0"],
    ]
    assert results.difference(*pair, "mse@10").mean == pytest.approx(
        pair[0].scalar("mse@10").mean()
        - results.series["waterdrop", "nll", "fixed"].scalar("mse@10")[0].mean()
    )
    pair = results.pair("waterdrop", ("nll", "adaptive"), ("nll", "fixed"))
    assert pair is not None
    assert [len(each.runs) for each in pair] == [2, 2]
    assert results.pair("waterdrop", ("beta-nll", "fixed"), ("nll", "fixed")) is None


def test_only_trajectories_of_both_are_compared(made: ReproduceConfig) -> None:
    results = Results(study_of(made))
    key = ("waterdrop", "nll", "fixed")
    few = results.series[key] = replace(results.series[key], first=1)
    pair = results.pair("waterdrop", ("nll-400", "fixed"), ("nll", "fixed"))
    assert pair is not None
    assert (few.sample, [each.sample for each in pair]) == ("2 × 1", ["1 × 1", "1 × 1"])
    longer = results.series["waterdrop", "nll-400", "fixed"]
    assert longer.trajectories == 2
    assert results.difference(*pair, "mse@10").mean == pytest.approx(
        longer.scalar("mse@10")[0, 0] - few.scalar("mse@10")[0, 0]
    )


def test_models_trained_for_longer_are_rolled_out_over_the_whole_test_split() -> None:
    laptop = PROFILES["laptop"]
    for model in laptop.models:
        count = None if model.share > 1 else 10
        assert laptop.trajectories_of(model, "test") == count
        assert laptop.trajectories_of(model, "valid") == 10
        assert laptop.trajectories_of(model, "long") is None


def test_every_machine_that_a_study_was_made_on_is_named(study: ReproduceConfig) -> None:
    path = folder(study) / "machine.json"
    (here,) = json.loads(path.read_text())
    other = {**here, "processor": "another one", "date": "2026-01-01"}
    for content, names in (([other, here], [other, here]), (other, [other])):  # older: one alone
        path.write_text(json.dumps(content))
        reproduce(study, QUIET)
        line = (folder(study) / "report.md").read_text().splitlines()[2]
        assert [f"on {m['date']} on {m['processor']}" in line for m in names] == [True] * len(names)
        assert line.count("torch") == len(names)
