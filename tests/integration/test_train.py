"""The main job from the command line: trained, killed, resumed, reported."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from adaptgns import rollout
from adaptgns.checkpoint import LAST, read_checkpoint
from adaptgns.config import to_json
from adaptgns.presets import PRESETS
from adaptgns.train import main, parse, run_folder


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "adaptgns.train", *map(str, arguments)]


def test_smoke_run_reports_everything(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    main(["--preset", "smoke", "--data", str(drops), "--out", str(out)])
    printed = capsys.readouterr().out
    for name in ("best.safetensors", "metrics.json", "fixed.h5", "adaptive.h5", "rollout.gif"):
        assert name in printed
    assert "constant velocity" in printed
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics
    assert json.loads((out / "config.json").read_text())["data"] == str(drops)

    main(["--preset", "smoke", "--data", str(drops), "--out", str(tmp_path / "mlp"),
          "--model.no-edges", "--steps", "3"])  # fmt: skip
    assert "MLP" in capsys.readouterr().out


def test_an_existing_run_is_not_overwritten(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / LAST).write_bytes(b"precious")
    with pytest.raises(SystemExit) as exit_:
        main(["--preset", "smoke", "--data", str(drops), "--out", str(tmp_path)])
    assert exit_.value.code == 2
    assert "holds a run already" in capsys.readouterr().err
    assert (tmp_path / LAST).read_bytes() == b"precious"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--preset", "huge"], "--preset: got 'huge'; accepted are smoke, laptop, paper"),
        (["--data", "no/such/folder"], "no/such/folder"),
        (["--resume", "no/such/run"], "no/such/run holds no last.safetensors"),
        (["--resume", "sand", "--preset", "smoke"], "got smoke, sand; accepted is one of them"),
        (["--config", __file__], "test_train.py: not readable as JSON"),
    ],
)
def test_wrong_arguments_are_named(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    assert message in capsys.readouterr().err


def test_a_run_is_resumed_with_what_its_weights_are_made_for(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["--preset", "smoke", "--data", str(drops), "--out", str(tmp_path), "--steps", "2",
          "--mirror"])  # fmt: skip
    assert "assuming physics that is symmetric" in capsys.readouterr().out
    saved = (tmp_path / "config.json").read_bytes()
    for option, value, told in (
        ("--loss", "mse", "loss: the run was started with nll; got mse"),
        ("--noise", "0.1", "noise: the run was started with 0.00067; got 0.1"),
        ("--model.latent", "8", "latent: the run was started with 16; got 8"),
        ("--steps", "1", "steps: the run has trained 2 steps; got 1"),
        ("--data", "sand", "is not what the run"),
    ):
        with pytest.raises(SystemExit) as exit_:
            main(["--resume", str(tmp_path), option, value])
        assert exit_.value.code == 2
        assert told in capsys.readouterr().err
    assert (tmp_path / "config.json").read_bytes() == saved


def test_a_folder_belongs_to_one_training_at_a_time(
    drops: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = replace(PRESETS["smoke"], data=str(drops))
    with run_folder(config) as first, run_folder(config) as second:
        assert second.name == f"{first.name}-2"
        with (
            pytest.raises(ValueError, match="another training is at work there"),
            run_folder(replace(config, out=first)),
        ):
            pass
        with (
            pytest.raises(ValueError, match="another training is at work there"),
            run_folder(replace(config, resume=second)),
        ):
            pass
        (second / LAST).touch()
    assert not first.exists(), "nothing was written there"
    with run_folder(config) as again:
        assert again == first
        (again / LAST).touch()
    with run_folder(config) as third:
        assert third.name == f"{first.name}-3"
    with run_folder(replace(config, resume=second)) as resumed:
        assert resumed == second


@pytest.mark.parametrize("during", ["run", "report"])
def test_a_folder_belongs_to_a_training_until_it_has_reported(
    drops: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, during: str
) -> None:
    run = tmp_path / "run"
    told = []

    def meanwhile(*_: object) -> None:
        other = command("--preset", "smoke", "--data", drops, "--out", run)
        told.append(subprocess.run(other, capture_output=True, text=True, check=False).stderr)

    where = "adaptgns.fit.Trainer.run" if during == "run" else "adaptgns.train.report"
    monkeypatch.setattr(where, meanwhile)
    monkeypatch.setattr("adaptgns.train.report", meanwhile)
    main(["--preset", "smoke", "--data", str(drops), "--out", str(run), "--steps", "1"])
    assert len(told) == (2 if during == "run" else 1)
    for each in told:
        assert "another training is at work there" in each


def test_only_what_was_made_in_vain_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own").mkdir()
    (tmp_path / "link").symlink_to("own")
    monkeypatch.chdir(tmp_path)
    for out in ("own", "link", "new/one", None):
        options = [] if out is None else ["--out", out]
        with pytest.raises(SystemExit):
            main(["--data", "no/such", *options])
        assert "no/such" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "own"]


def test_a_file_system_without_locks_is_no_obstacle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", without)
    with run_folder(replace(PRESETS["smoke"], out=tmp_path / "run")) as folder:
        assert folder.is_dir()


def test_a_run_goes_on_in_its_own_folder(drops: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    main(["--preset", "smoke", "--data", str(drops), "--out", str(run), "--steps", "2"])
    with pytest.raises(ValueError, match=r"--out: got elsewhere beside --resume"):
        parse(["--resume", str(run), "--out", "elsewhere"])


def test_what_is_unusual_about_the_data_is_said(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Noise of another unit, and short trajectories, which are measured at their last step."""
    arguments = ["--preset", "smoke", "--data", str(drops), "--steps", "2", "--test-horizon", "9"]
    main([*arguments, "--out", str(tmp_path / "one"), "--noise", "1", "--drift", "0"])
    told = " ".join(capsys.readouterr().out.split())
    assert "warning: noise is 1, " in told
    assert "drift is" not in told
    assert "MSE@9" in told


def test_damaged_test_data_is_told_before_training(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    shutil.copytree(drops, data)
    with h5py.File(data / "test.h5", "r+") as file:
        name = min(file)
        file[name]["position"][20, 3] = np.nan
    with pytest.raises(SystemExit) as exit_:
        main(["--preset", "smoke", "--data", str(data), "--out", str(tmp_path / "run")])
    assert exit_.value.code == 2
    told = capsys.readouterr().err
    assert "test.h5" in told
    assert "frame 20" in told
    assert not (tmp_path / "run").exists()


def test_killed_ten_times_and_resumed_equals_uninterrupted(drops: Path, tmp_path: Path) -> None:
    """kill -9 at random moments, the writing of a checkpoint included."""
    options = ["--preset", "smoke", "--data", drops, "--steps", 300, "--checkpoint-every", 3,
               "--validate-every", 50, "--threads", 1]  # fmt: skip
    whole = subprocess.run(
        command(*options, "--out", tmp_path / "whole"), capture_output=True, text=True, check=False
    )
    assert whole.returncode == 0, whole.stdout + whole.stderr

    folder = tmp_path / "killed"
    rng = random.Random(0)
    last = folder / LAST
    for kill in range(10):
        resume = ["--resume", folder] if last.exists() else [*options, "--out", folder]
        before = last.stat().st_mtime_ns if last.exists() else 0
        process = subprocess.Popen(
            command(*resume), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        # Some checkpoints later, at no particular moment.
        while process.poll() is None and (not last.exists() or last.stat().st_mtime_ns == before):
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.1))
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert read_checkpoint(last).step < 300, f"finished before kill {kill}"
    final = subprocess.run(command("--resume", folder), capture_output=True, text=True, check=False)
    assert final.returncode == 0, final.stdout + final.stderr
    assert "adaptive" in final.stdout

    a, b = (read_checkpoint(tmp_path / f / LAST) for f in ("whole", "killed"))
    assert a.step == b.step == 300
    assert a.tensors.keys() == b.tensors.keys()
    assert all(torch.equal(a.tensors[name], b.tensors[name]) for name in a.tensors)


def test_a_signal_to_all_processes_leaves_the_workers_alive_until_all_is_saved(
    drops: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    options = ["--preset", "smoke", "--data", drops, "--steps", 100_000, "--workers", 1]
    process = subprocess.Popen(
        command(*options, "--checkpoint-every", 100_000, "--out", folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    log = folder / "metrics.jsonl"
    while not (log.exists() and log.read_text()):
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGTERM)
    out, errors = process.communicate(timeout=60)
    step = read_checkpoint(folder / LAST).step
    assert f"stopped by SIGTERM after step {step}; nothing is lost" in out, errors


def test_a_run_names_its_data_wherever_it_is_used_from(
    drops: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(drops, tmp_path / "here" / "my_data")
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    main(["--preset", "smoke", "--data", "my_data", "--out", "run", "--steps", "2"])
    monkeypatch.chdir(tmp_path / "there")
    options = ["--checkpoint", str(tmp_path / "here" / "run"), "--steps", "1"]
    rollout.main([*options, "--out", "one.h5"])
    (tmp_path / "here" / "my_data").rename(tmp_path / "moved")
    rollout.main([*options, "--out", "two.h5", "--data", str(tmp_path / "moved")])
    with pytest.raises(SystemExit):
        rollout.main([*options, "--out", "three.h5"])
    assert "--data names where data are now" in " ".join(capsys.readouterr().err.split())


def test_a_run_may_begin_with_the_weights_of_another(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    options = ["--preset", "smoke", "--data", str(drops)]
    main([*options, "--loss", "mse", "--steps", "3", "--out", str(first)])
    few = ["--steps", "1", "--lr", "1e-12", "--warmup", "0"]
    capsys.readouterr()
    main([*options, *few, "--init", str(first), "--out", str(second)])
    told = " ".join(capsys.readouterr().out.split())
    assert f"begins with the weights of {first}; anew: network.variance_head." in told
    before, after = (read_checkpoint(folder / LAST).group("model") for folder in (first, second))
    for name, weights in before.items():
        torch.testing.assert_close(after[name], weights, msg=name)
    assert set(after) > set(before)
    main(["--resume", str(second), "--steps", "2"])  # which does not begin again
    assert read_checkpoint(second / LAST).step == 2
    third = ["--loss", "mse", *few, "--init", str(second), "--out", str(tmp_path / "third")]
    main([*options, *third])
    assert "; left out: network.variance_head." in " ".join(capsys.readouterr().out.split())
    for wrong, message in (
        (
            [*options, "--init", "waterdrop", "--out", str(tmp_path / "x")],
            "model.latent is 64, here 16",
        ),
        (["--resume", str(second), "--init", "waterdrop"], "a run begins once"),
    ):
        with pytest.raises(SystemExit):
            main(wrong)
        assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("option", ["--preset", "--config", "--resume"])
def test_what_a_run_starts_from_is_named_once(option: str) -> None:
    with pytest.raises(ValueError, match=f"{option}: got it 2 times; accepted is once"):
        parse([option, "smoke", "--seed", "1", f"{option}=paper"])


def test_a_saved_configuration_starts_a_run_of_its_own(tmp_path: Path) -> None:
    saved = replace(PRESETS["smoke"], resume=tmp_path / "old", out=tmp_path / "old", lr=0.5)
    (tmp_path / "config.json").write_text(json.dumps(to_json(saved)))
    config = parse(["--config", str(tmp_path / "config.json"), "--seed", "7"])
    assert config == replace(saved, resume=None, out=None, seed=7)
