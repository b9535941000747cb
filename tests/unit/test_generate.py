"""Generated data sets: fixed by a seed, resumable, never half there, never over others' data."""

from __future__ import annotations

import errno
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adaptgns import _core
from adaptgns.data import DataError, open_split, read_metadata
from adaptgns.data import generation as generation_module
from adaptgns.data.generation import SplitPlan, simulate_split, trajectory_seed
from adaptgns.data.scenes import SCENES
from adaptgns.data.statistics import compute_statistics
from adaptgns.generate import GenerateConfig, generate, main

SMALL = GenerateConfig(
    scene="waterdrop",
    out=Path(),
    train=3,
    valid=1,
    test=1,
    frames=8,
    particles=(20, 30),
)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("scene", SCENES)
def test_a_whole_data_set(tmp_path: Path, scene: str, dim: int) -> None:
    periodic = scene == "vortices"  # which fills its box
    particles = None if periodic else SMALL.particles
    generate(replace(SMALL, out=tmp_path, scene=scene, dim=dim, particles=particles))  # type: ignore[arg-type]
    assert set(contents(tmp_path)) == {"train.h5", "valid.h5", "test.h5", "metadata.json"}
    metadata = read_metadata(tmp_path)
    assert metadata.bounds == ((0.1, 0.9),) * dim
    assert (metadata.dim, metadata.dt, metadata.radius) == (
        dim,
        0.0025,
        SCENES[scene].radii[dim - 2],
    )
    assert metadata.kinematic_types == (3,)
    assert metadata.periodic == (periodic,) * dim
    train = open_split(tmp_path, "train")
    assert train.lengths.tolist() == [8] * 3
    statistics = compute_statistics(train, box=metadata.box, kinematic_types=(3,))
    assert metadata.velocity_std == pytest.approx(statistics.velocity_std)
    assert metadata.acceleration_mean == pytest.approx(statistics.acceleration_mean)


def test_same_seed_same_files(tmp_path: Path) -> None:
    for name in ("a", "b"):
        generate(replace(SMALL, out=tmp_path / name))
    generate(replace(SMALL, out=tmp_path / "c", seed=1))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert contents(tmp_path / "a")["train.h5"] != contents(tmp_path / "c")["train.h5"]


def test_a_longer_split_begins_with_the_shorter() -> None:
    short, long = (
        list(simulate_split("train", SplitPlan("sand", count, 7, particles=(20, 30))))
        for count in (3, 12)
    )
    assert len({one.positions.tobytes() for one in long}) == 12
    for one, other in zip(short, long, strict=False):
        np.testing.assert_array_equal(one.positions, other.positions)


def test_seeds_differ() -> None:
    seeds = {
        trajectory_seed(seed, split, index)
        for seed in range(3)
        for split in ("train", "valid", "test")
        for index in range(100)
    }
    assert len(seeds) == 900
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_few_trajectories_are_held_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    started = threading.Semaphore(0)
    count = 0

    def simulate(scene: str, *, seed: int, **_: object) -> tuple[np.ndarray, np.ndarray]:
        nonlocal count
        count += 1
        started.release()
        return np.zeros((7, 1, 2), np.float32), np.zeros(1, np.int64)

    monkeypatch.setattr(_core, "simulate", simulate)
    monkeypatch.setattr(generation_module, "_cores", lambda: 3)
    trajectories = simulate_split("train", SplitPlan("sand", 1000, 7))
    for taken in range(1, 50):
        next(trajectories)
        assert count <= taken + 2 * 3
    trajectories.close()


def test_finished_splits_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generate(replace(SMALL, out=tmp_path))
    before = contents(tmp_path)
    (tmp_path / "test.h5").unlink()
    (tmp_path / "test.h5.partial").write_bytes(b"half a file")
    stamp = (tmp_path / "train.h5").stat().st_mtime_ns
    capsys.readouterr()
    generate(replace(SMALL, out=tmp_path))
    told = " ".join(capsys.readouterr().err.split())
    assert "train.h5 was finished before; kept" in told
    assert "test.h5.partial was left by an interrupted run; test starts anew" in told
    assert (tmp_path / "train.h5").stat().st_mtime_ns == stamp
    after = contents(tmp_path)
    metadata, expected = (json.loads(c.pop("metadata.json")) for c in (after, before))
    assert after == before
    assert metadata.keys() == expected.keys()
    assert metadata["acc_std"] == pytest.approx(expected["acc_std"], rel=1e-12)


def test_other_plans_are_told_apart(tmp_path: Path) -> None:
    generate(replace(SMALL, out=tmp_path))
    before = contents(tmp_path)
    with pytest.raises(DataError, match=r"train\.h5: .*differently \(seed 0 instead of 1\)"):
        generate(replace(SMALL, out=tmp_path, seed=1))
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["train.h5", "test.npz", "metadata.json"])
def test_foreign_files_are_left_alone(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("{}")
    with pytest.raises(DataError, match=rf"{name}: exists and wasn't generated by adaptgns"):
        generate(replace(SMALL, out=tmp_path))
    assert contents(tmp_path) == {name: b"{}"}


def test_splits_may_be_left_out(tmp_path: Path) -> None:
    generate(replace(SMALL, out=tmp_path, valid=0, test=0))
    assert set(contents(tmp_path)) == {"train.h5", "metadata.json"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--train", "0"], "train is needed"),
        (["--valid", "-1"], "trajectories is -1"),
        (["--frames", "6"], "frames is 6; 7 or more"),
        (["--particles", "30", "20"], "particles"),
    ],
)
def test_wrong_options_end_with_a_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    out = tmp_path / "sand"
    with pytest.raises(SystemExit) as ended:
        main(["--scene", "sand", "--out", str(out), "--train", "1", "--frames", "7", *arguments])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_unknown_options_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--scene", "sand", "--out", "x", "--gravity", "3"])
    assert "--gravity" in capsys.readouterr().err


def test_help_tells_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    told = capsys.readouterr().out
    assert "python -m adaptgns.generate" in told
    assert "(default: 1000)" in told


def test_a_full_disk_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(split: str, plan: SplitPlan) -> Iterator[object]:
        yield from simulate_split(split, plan)
        if split == "valid":
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(generation_module, "simulate_split", full)
    with pytest.raises(SystemExit):
        main(["--scene", "sand", "--out", str(tmp_path), "--train", "1", "--frames", "7"])
    assert "error: the disk is full" in capsys.readouterr().err
    assert set(contents(tmp_path)) == {"train.h5"}


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to another process")
def test_interrupting_ends_with_one_line_and_nothing_half_done(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "adaptgns.generate", "--scene", "waterdrop"]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path), "--train", "1000000"],
        stderr=subprocess.PIPE,
        text=True,
        # A shell's background jobs, and with them this test in one, are born deaf to SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    partial = tmp_path / "train.h5.partial"
    while not partial.exists() or partial.stat().st_size < 1 << 20:  # trajectories are written
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    try:
        _, told = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130
    assert told.strip().splitlines()[-1].startswith("interrupted; the same command goes on")
    assert "Traceback" not in told
    assert contents(tmp_path) == {}
