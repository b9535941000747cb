"""Training by several processes, as torchrun starts them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from adaptgns import train
from adaptgns.checkpoint import LAST, read_checkpoint

OPTIONS = [
    *("--preset", "smoke", "--steps", "200", "--batch", "5", "--unroll", "2", "--clip", "1"),
    *("--threads", "1", "--validate-every", "1000", "--checkpoint-every", "1000"),
]


def torchrun(*arguments: str) -> subprocess.Popen[str]:
    """Two processes on this machine."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    return subprocess.Popen(
        [*launcher, "--nproc-per-node", "2", "-m", "adaptgns.train", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def losses(folder: Path) -> list[float]:
    lines = map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
    return [line["loss"] for line in lines if "loss" in line]


def workers(launcher: int) -> list[int]:
    """Processes that ``launcher`` has started."""
    children = Path(f"/proc/{launcher}/task/{launcher}/children").read_text()
    return [int(child) for child in children.split()]


def wait_for(path: Path, run: subprocess.Popen[str]) -> None:
    while not (path.exists() and path.read_text()):
        assert run.poll() is None, run.communicate()
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the workers in /proc")
def test_two_processes_train_as_one_and_lose_nothing(drops: Path, tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    data = ("--data", str(drops))
    train.main([*data, *OPTIONS, "--out", str(one)])

    run = torchrun(*data, *OPTIONS, "--out", str(two))
    wait_for(two / "metrics.jsonl", run)  # 100 steps are done
    run.send_signal(signal.SIGTERM)
    out, errors = run.communicate(timeout=120)
    assert run.returncode != 0
    assert "nothing is lost" in out, errors
    assert "Traceback" not in out
    stopped = read_checkpoint(two / LAST).step
    assert 100 <= stopped < 200
    assert losses(two) == pytest.approx(losses(one)[:1], rel=1e-3)

    # A worker that is killed ends the job, and the checkpoint stays as it was.
    run = torchrun("--resume", str(two))
    while len(workers(run.pid)) < 2:  # a single child may be another program
        assert run.poll() is None, run.communicate()
        time.sleep(0.05)
    os.kill(workers(run.pid)[-1], signal.SIGKILL)
    _, errors = run.communicate(timeout=120)
    assert run.returncode != 0
    assert "SIGKILL" in errors
    assert read_checkpoint(two / LAST).step >= stopped

    train.main(["--resume", str(two)])
    whole, parts = (read_checkpoint(folder / LAST).group("model") for folder in (one, two))
    for name, weights in whole.items():
        assert (parts[name] - weights).norm() <= 0.01 * weights.norm(), name


def test_a_mistake_is_told_once(drops: Path, tmp_path: Path) -> None:
    run = torchrun("--data", str(drops), *OPTIONS, "--batch", "1", "--out", str(tmp_path / "run"))
    _, errors = run.communicate(timeout=120)
    assert run.returncode != 0
    assert errors.count("error: batch: got 1 samples a step for 2 processes") == 1
    assert errors.count("error: another process ended") == 1
    assert errors.count("Traceback") == 1, "the launcher's own"
