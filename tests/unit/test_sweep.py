"""The search over the adaptive rule: every combination, once, resumed, within the budget."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
from rich.console import Console

from adaptgns.checkpoint import BEST
from adaptgns.config import AdaptiveConfig, RolloutConfig, RuledPolicy
from adaptgns.evaluate import measure as evaluate
from adaptgns.rollout import write_rollouts
from adaptgns.sweep import JOURNAL, RESULT, SweepConfig, main, measure, sweep
from adaptgns.train import main as train

QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def run(drops: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model with a variance, hardly trained."""
    out = tmp_path_factory.mktemp("run") / "nll"
    train(["--preset", "smoke", "--data", str(drops), "--out", str(out), "--steps", "5"])
    return out


@pytest.fixture
def config(run: Path, tmp_path: Path) -> SweepConfig:
    return SweepConfig(
        checkpoint=run,
        out=tmp_path / "sweep",
        tau=(60.0, 90.0),
        factor=(1.2,),
        radius=(0.012, 0.015),
        steps=6,
        device="cpu",
    )


def test_the_grid_is_taken_whole_and_once(config: SweepConfig) -> None:
    result = sweep(config, QUIET)
    found = {(row["tau"], row["factor"], row["radius"]) for row in result["trials"]}
    assert found == {(t, 1.2, r) for t in (60, 90) for r in (0.012, 0.015)}
    assert len(result["trials"]) == 4
    errors = [row["mse"] for row in result["trials"]]
    assert errors == sorted(errors)
    assert result["chosen"]["mse"] == errors[0]
    # More particles that see farther, and larger radii, have more edges.
    edges = {(row["tau"], row["radius"]): row["edges"] for row in result["trials"]}
    assert edges[60, 0.015] > edges[90, 0.015] > edges[90, 0.012]
    assert json.loads((config.out / RESULT).read_text())["chosen"]["tau"] in (60, 90)
    assert (config.out / "sweep.png").stat().st_size > 1000
    assert (config.out / "sweep.pdf").exists()


def test_what_was_tried_is_not_tried_again(
    config: SweepConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = sweep(replace(config, trials=3), QUIET)
    assert len(first["trials"]) == 3
    second = sweep(config, QUIET)
    assert len(second["trials"]) == 4
    assert all(row in second["trials"] for row in first["trials"])
    monkeypatch.setattr("adaptgns.sweep.measure", None)  # nothing is left to measure
    assert sweep(config, QUIET)["trials"] == second["trials"]
    with pytest.raises(ValueError, match="holds trials with other steps"):
        sweep(replace(config, steps=4), QUIET)
    moved = config.out.with_name("moved")
    shutil.copytree(config.checkpoint, moved)
    assert sweep(replace(config, checkpoint=moved), QUIET)["trials"] == second["trials"]
    (moved / BEST).unlink()  # so that the last is taken, which holds more
    with pytest.raises(ValueError, match="holds trials with other weights"):
        sweep(replace(config, checkpoint=moved), QUIET)


def test_older_journals_are_of_the_adaptive_policy(
    config: SweepConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    every = sweep(config, QUIET)["trials"]
    journal = config.out / JOURNAL
    text = journal.read_text()
    older, count = re.subn(r'"policy":"adaptive",', '"checkpoint":"run",', text)
    older, also = re.subn(r',"weights":"\w+"', "", older)
    assert (count, also) == (1, 1)
    journal.write_text(older)
    monkeypatch.setattr("adaptgns.sweep.measure", None)  # nothing is left to measure
    assert sweep(config, QUIET)["trials"] == every
    with pytest.raises(ValueError, match="holds trials with other policy"):
        sweep(replace(config, policy="divergence"), QUIET)


@pytest.mark.parametrize("policy", get_args(RuledPolicy))
def test_any_rule_can_be_searched(config: SweepConfig, run: Path, policy: RuledPolicy) -> None:
    config = replace(config, policy=policy, tau=(70.0,), radius=(0.015,))
    [row] = sweep(config, QUIET)["trials"]
    rollout = RolloutConfig(
        checkpoint=run,
        out=config.out / "rollouts.h5",
        split="valid",
        policy=policy,
        adaptive=AdaptiveConfig(70.0, 1.2),
        steps=config.steps,
        device="cpu",
    )
    write_rollouts(rollout, QUIET)
    scalars = evaluate([rollout.out], (config.steps,)).to_json()["rollouts"][0]["scalars"]
    for name, scalar in (("mse", f"mse@{config.steps}"), ("edges", "edges_per_step")):
        assert row[name] == pytest.approx(scalars[scalar]["mean"], rel=1e-5)


def test_processes_that_begin_together_draw_different_rules(config: SweepConfig) -> None:
    """Two that take turns: each begins where the other has done one trial."""
    drawn = replace(config, sampler="random", factor=(1.1, 1.5))
    for trials in (1, 2, 3):
        rows = sweep(replace(drawn, trials=trials), QUIET)["trials"]
    assert len({row["factor"] for row in rows}) == 3
    whole = sweep(replace(drawn, out=config.out.with_name("whole"), trials=3), QUIET)["trials"]
    assert {row["factor"] for row in whole} == {row["factor"] for row in rows}


def test_equal_draws_count(config: SweepConfig) -> None:
    drawn = replace(config, sampler="random", tau=(70.0,), radius=(0.015,), trials=2)
    assert len(sweep(drawn, QUIET)["trials"]) == 1


@pytest.mark.parametrize("storage", ["foo", "nonsense://x", "sqlite:////nonexistent/x.db"])
def test_a_storage_that_cannot_be_is_told(config: SweepConfig, storage: str) -> None:
    with pytest.raises(ValueError, match=f"storage: {storage}: "):
        sweep(replace(config, storage=storage), QUIET)


def test_random_rules_are_of_a_seed(config: SweepConfig) -> None:
    config = replace(config, policy="random", trials=1)
    sweep(config, QUIET)
    with pytest.raises(ValueError, match="holds trials with other seed"):
        sweep(replace(config, seed=5), QUIET)


def test_only_priors_do_without_a_variance(
    drops: Path, tmp_path: Path, config: SweepConfig
) -> None:
    out = tmp_path / "mse"
    where = ["--data", str(drops), "--out", str(out)]
    train(["--preset", "smoke", "--steps", "5", "--loss", "mse", *where])
    config = replace(config, checkpoint=out, tau=(70.0,), radius=(0.015,))
    with pytest.raises(ValueError, match="policy: got adaptive, which needs the model's variance"):
        sweep(config, QUIET)
    config = replace(config, policy="divergence")  # in the same folder, where nothing was tried
    assert len(sweep(config, QUIET)["trials"]) == 1


def test_an_interrupted_trial_is_made_again(
    config: SweepConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = 0

    def interrupted(*arguments: object, **rule: float) -> dict[str, float]:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise KeyboardInterrupt
        return measure(*arguments, **rule)

    monkeypatch.setattr("adaptgns.sweep.measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sweep(config, QUIET)
    found = [(row["tau"], row["radius"]) for row in sweep(config, QUIET)["trials"]]
    assert sorted(found) == [(t, r) for t in (60, 90) for r in (0.012, 0.015)]


def test_what_diverged_is_never_chosen(
    config: SweepConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = iter((0.3, float("nan"), 0.1, float("inf")))

    def made_up(*_: object, **__: float) -> dict[str, float]:
        return {"mse": next(errors), "edges": 10.0, "clumping": 1.0, "milliseconds": 1.0}

    monkeypatch.setattr("adaptgns.sweep.measure", made_up)
    result = sweep(config, QUIET)
    assert result["chosen"]["mse"] == 0.1
    assert [row["mse"] for row in result["trials"][:2]] == [0.1, 0.3]
    errors = iter([float("nan")] * 4)
    with pytest.raises(ValueError, match="every trial diverged"):
        sweep(replace(config, out=config.out.with_name("other")), QUIET)


def test_the_budget_of_edges_holds(config: SweepConfig) -> None:
    every = sweep(config, QUIET)["trials"]
    budget = sorted(row["edges"] for row in every)[1]
    chosen = sweep(replace(config, edges=budget), QUIET)["chosen"]
    within = [row for row in every if row["edges"] <= budget]
    assert chosen["mse"] == min(row["mse"] for row in within)
    with pytest.raises(ValueError, match="no trial is within 1 edges a step, the thriftiest has"):
        sweep(replace(config, edges=1.0), QUIET)


@pytest.mark.parametrize("sampler", ["tpe", "random"])
def test_samplers_that_draw_stay_within_the_ranges(config: SweepConfig, sampler: str) -> None:
    drawn = replace(config, sampler=sampler, trials=3, factor=(1.1, 1.5), edges=1e6)
    trials = sweep(drawn, QUIET)["trials"]
    assert len(trials) == 3
    for row in trials:
        assert 60 <= row["tau"] <= 90
        assert 1.1 <= row["factor"] <= 1.5
        assert 0.012 <= row["radius"] <= 0.015
    assert len({row["factor"] for row in trials}) == 3
    again = replace(drawn, out=drawn.out.with_name("again"))
    assert [row["tau"] for row in sweep(again, QUIET)["trials"]] == [row["tau"] for row in trials]


def test_a_value_named_twice_is_refused(config: SweepConfig) -> None:
    with pytest.raises(ValueError, match=r"tau: got 50\.0, 50\.0; each value is accepted once"):
        replace(config, tau=(50.0, 50.0))


def test_the_command(config: SweepConfig, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--checkpoint", str(config.checkpoint), "--out", str(config.out)]
    main([*arguments, "--tau", "70", "--factor", "1.2", "--steps", "4"])
    assert "chosen: tau 70, factor 1.2, radius 0.015" in capsys.readouterr().out
    for wrong, message in (
        (["--tau", "120"], "tau: got 120.0; accepted are numbers from 0 to 100"),
        (["--policy", "two-sided", "--tau", "20"], "low_tau: got 30; accepted for two-sided"),
        (["--steps", "0"], "steps: got 0; accepted are numbers above 0"),
        (["--radius", "-1"], "radius: got (-1.0,)"),
    ):
        with pytest.raises(SystemExit) as left:
            main([*arguments, *wrong])
        assert left.value.code == 2
        assert message in capsys.readouterr().err.replace("\n", " ")
