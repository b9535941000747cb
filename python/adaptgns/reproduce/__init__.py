"""`python -m adaptgns.reproduce`: every table and figure of the paper, with seeds.

Trains and rolls out what a profile asks for, run by run: what is done is skipped, what was
interrupted goes on. Then it writes one report whose every number comes from the saved metrics.
"""

from __future__ import annotations

import fnmatch
import glob
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import torch
import tyro
from rich.console import Console

from adaptgns.atomic import write_json
from adaptgns.command import plain_errors
from adaptgns.config import Device, torch_device
from adaptgns.fit import Diverged, TrainingStopped
from adaptgns.interruption import interruption
from adaptgns.reproduce import report
from adaptgns.reproduce.estimates import seconds
from adaptgns.reproduce.profiles import PROFILES, ProfileName
from adaptgns.reproduce.runs import MACHINES, Run, Study, processor, read_machines
from adaptgns.threads import divide_threads


@dataclass(frozen=True)
class ReproduceConfig:
    """Every table and figure of the paper: runs, their metrics, and a report."""

    preset: ProfileName = "laptop"
    """smoke: everything, tiny; laptop: trained as by default, in some twelve hours on two cores;
    full: trained until the baseline does not clump; paper: the paper's sizes."""
    data: tuple[str, ...] = ("waterdrop", "sand")
    """Data sets: embedded ones, or folders."""
    out: Path | None = None
    """Folder of the study; None: results/<preset>."""
    only: str = "*"
    """Make only the runs whose name, DATA/MODEL-SEED, matches this pattern, and no report: to share
    a study between machines that see one folder."""
    jobs: int = 1
    """Runs at a time; with GPUs each takes the next one."""
    dry_run: bool = False
    """List every run, with the time it would take here, and make none."""
    report_only: bool = False
    """Make no run; write the report of those that are there."""
    readme: Path | None = None
    """File whose part between <!-- results --> and <!-- end of results --> gets the tables."""
    device: Device = "auto"
    """auto: a GPU where there is one."""
    threads: int | None = None
    """CPU threads of each run; None: the cores, divided by the jobs."""

    def __post_init__(self) -> None:
        for name in ("jobs", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}: got {value}; accepted are whole numbers >= 1")


def study_of(config: ReproduceConfig) -> Study:
    """The study that ``config`` asks for."""
    return Study(
        preset=config.preset,
        profile=PROFILES[config.preset],
        data=config.data,
        out=config.out or Path("results") / config.preset,
        device=config.device,
        threads=config.threads or max(1, (os.cpu_count() or 1) // config.jobs),
    )


def reproduce(config: ReproduceConfig, console: Console) -> None:
    """Make the runs, then the report.

    Raises StudyError where the study's folder holds runs of another configuration, or, with
    ``report_only``, where one is missing; :class:`TrainingStopped` on SIGINT and SIGTERM.
    """
    study = study_of(config)
    runs = [run for run in study.runs() if fnmatch.fnmatch(run.name, config.only)]
    if not runs:
        names = ", ".join(run.name for run in study.runs())
        raise ValueError(f"only: {config.only!r} matches none of {names}")
    if config.dry_run:
        list_runs(runs, console)
        return
    if not config.report_only:
        make(config, study, runs, console)
    if config.only == "*":
        for path in report.write(study):
            console.print(str(path), highlight=False, soft_wrap=True)
        if config.readme is not None:
            report.write_into(study, config.readme)


def make(config: ReproduceConfig, study: Study, runs: Sequence[Run], console: Console) -> None:
    """Make those of ``runs`` that are missing, and what is measured beside them.

    A run that fails does not keep the others from being made; RuntimeError names it at the end.
    """
    if study.threads is not None and torch_device(study.device).type == "cpu":
        divide_threads(study.threads)
    whole = config.only == "*"
    for data in study.sets.values():
        data.describe()
        if whole:  # of several that share a study, the gate is one's to pass
            data.pass_gate(console)
    todo = [run for run in runs if not run.done]
    for data in study.sets.values():
        if any(split == "long" for run in todo if run.data is data for _, split in run.missing):
            data.describe_long()
    failed = (one_by_one if config.jobs == 1 else in_processes)(config, todo, console)
    if todo:
        _note_machine(study)
    if failed:
        raise RuntimeError(
            f"{len(failed)} runs failed: {', '.join(failed)}. Repeat the command to go on"
        )
    seed = study.profile.seeds[0]
    for data in study.sets.values() if whole else ():
        data.time_steps([run for run in study.runs() if (run.data, run.seed) == (data, seed)])


def one_by_one(config: ReproduceConfig, runs: Sequence[Run], console: Console) -> list[str]:
    """Make ``runs`` here; the names of those that failed, for reasons that are printed."""
    failed = []
    for run in runs:
        try:
            run.do(console)
        except (ValueError, RuntimeError, Diverged) as error:
            if len(runs) == 1:
                raise
            console.print(f"{run.name}: {error}", markup=False, highlight=False)
            failed.append(run.name)
    return failed


def list_runs(runs: Sequence[Run], console: Console) -> None:
    """Print every run and the hours it would take on this machine, one at a time."""
    total = 0.0
    for run in runs:
        if run.done:
            console.print(f"{run.name:40} done", highlight=False)
            continue
        hours = seconds(run) / 3600
        total += hours
        console.print(
            f"{run.name:40} {hours:8.2f} h  {round(run.model.share * run.data.steps):>11,} steps, "
            f"{', '.join(run.model.policies)}",
            highlight=False,
            soft_wrap=True,
        )
    console.print(f"{'together':40} {total:8.2f} h, one after the other", highlight=False)
    study = runs[0].study
    profile, sets = study.profile, study.sets.values()
    if profile.gate is not None and not all((data.metrics / "gate.json").exists() for data in sets):
        console.print(
            f"The gate comes first: the baseline trains for {profile.base.steps:,} steps, or twice "
            f"as many, and so on up to {profile.gate_steps:,}, until its rollouts have at most "
            f"{profile.gate:g} times the true edges. The others then train as long.",
            highlight=False,
            soft_wrap=True,
        )


def in_processes(config: ReproduceConfig, runs: Sequence[Run], console: Console) -> list[str]:
    """Make ``runs`` in processes of their own, ``config.jobs`` at a time; the names of those that
    failed, whose logs say why."""
    waiting, failed = list(runs), []
    running: dict[subprocess.Popen[bytes], Run] = {}
    gpus = torch.cuda.device_count() if config.device != "cpu" else 0
    started, first = 0, runs[0].study.profile.seeds[0] if runs else 0
    with interruption() as interrupted:
        while waiting or running:
            while waiting and len(running) < config.jobs and not interrupted:
                # What depends on other runs comes last, and waits for them; the first of it makes
                # what the rest share.
                if waiting[0].model.depends and any(
                    not run.model.depends or run.seed == first for run in running.values()
                ):
                    break
                run = waiting.pop(0)
                environment = dict(os.environ)
                if gpus:
                    environment["CUDA_VISIBLE_DEVICES"] = str(started % gpus)
                started += 1
                log = run.study.out / "training" / f"{run.name}.log"
                log.parent.mkdir(parents=True, exist_ok=True)
                with log.open("ab") as output:
                    process = subprocess.Popen(
                        _command(config, run), env=environment, stdout=output, stderr=output
                    )
                running[process] = run
                console.print(f"{run.name}: begun; log {log}", highlight=False, soft_wrap=True)
            for process in [process for process in running if process.poll() is not None]:
                run = running.pop(process)
                good = process.returncode == 0
                console.print(f"{run.name}: {'done' if good else 'failed'}", highlight=False)
                if not good:
                    failed.append(run.name)
            if interrupted:
                for process in running:
                    process.terminate()
                for process in running:
                    process.wait()
                raise TrainingStopped(
                    f"stopped by {interrupted[0]}; nothing is lost. Repeat the command to go on"
                )
            time.sleep(0.2)
    return failed


def _command(config: ReproduceConfig, run: Run) -> list[str]:
    study = run.study
    return [
        *(sys.executable, "-m", "adaptgns.reproduce"),
        *("--preset", study.preset, "--data", *config.data, "--out", str(study.out)),
        *(
            "--only",
            glob.escape(run.name),
            "--device",
            config.device,
            "--threads",
            str(study.threads),
        ),
    ]


def _note_machine(study: Study) -> None:
    """Add this machine, as of today, to those that the study was made on."""
    here = _machine()
    known = read_machines(study.out) if (study.out / MACHINES).exists() else []
    others = [machine for machine in known if {**machine, "date": None} != {**here, "date": None}]
    write_json(study.out / MACHINES, [*others, here])


def _machine() -> dict[str, object]:
    name = processor()
    if torch.cuda.is_available():
        name += f" and {torch.cuda.get_device_name()}"
    return {
        "date": date.today().isoformat(),
        "processor": name,
        "cores": os.cpu_count(),
        "torch": torch.__version__.split("+")[0],
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command with ``argv``, or with the process's own arguments."""
    console = Console()
    with plain_errors(RuntimeError, torch.OutOfMemoryError):
        config = tyro.cli(
            ReproduceConfig,
            args=argv,
            prog="python -m adaptgns.reproduce",
            description="Every table and figure of the paper: runs, their metrics, and a report.",
        )
        try:
            reproduce(config, console)
        except TrainingStopped as stopped:
            console.print(str(stopped), markup=False)
            raise SystemExit(1) from None
