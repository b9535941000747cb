"""`python -m adaptgns.train`: data, training, rollouts, and the table of what came out."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
import tyro
from rich.console import Console

from adaptgns.atomic import replace_text
from adaptgns.checkpoint import LAST, checkpoint_file, read_checkpoint
from adaptgns.command import plain_errors
from adaptgns.config import (
    PolicyName,
    RolloutConfig,
    TrainConfig,
    from_json,
    to_json,
    torch_device,
)
from adaptgns.data.check import check_split
from adaptgns.data.default import dataset_folder
from adaptgns.data.metadata import read_metadata
from adaptgns.data.trajectories import open_split
from adaptgns.evaluate import evaluate
from adaptgns.fit import Trainer, TrainingStopped
from adaptgns.plot import animate
from adaptgns.presets import PRESETS
from adaptgns.processes import OtherEndedError, Processes, processes
from adaptgns.rollout import write_rollouts
from adaptgns.threads import divide_threads

CONFIG = "config.json"


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command with ``argv``, or with the process's own arguments."""
    console = Console()
    with plain_errors(torch.OutOfMemoryError, OtherEndedError):
        config = parse(sys.argv[1:] if argv is None else list(argv))
        with processes(config.device) as group:
            own = console if group.first else Console(quiet=True)
            try:
                folder, data = train(config, own, group)
            except TrainingStopped as stopped:
                if group.first:
                    console.print(str(stopped), markup=False)
                elif stopped.alone:
                    print(f"process {group.rank}: {stopped}", file=sys.stderr)
                raise SystemExit(1) from None
        if not group.first:
            return
        try:
            report(folder, data, config, console)
        except KeyboardInterrupt:
            console.print(
                "stopped in the rollouts; the training is saved. Repeat them with\n"
                f"  python -m adaptgns.train --resume {folder}",
                markup=False,
            )
            raise SystemExit(130) from None


def parse(arguments: list[str]) -> TrainConfig:
    """The configuration of a run: that of a preset, of a file (``--config FILE.json``) or of the
    run that is resumed, changed by the other arguments."""
    preset, arguments = _take(arguments, "--preset")
    source, arguments = _take(arguments, "--config")
    resume, arguments = _take(arguments, "--resume")
    if preset is not None and preset not in PRESETS:
        raise ValueError(f"--preset: got {preset!r}; accepted are {', '.join(PRESETS)}")
    default = PRESETS[preset or "laptop"]
    if resume is not None:
        folder = Path(resume)
        default = replace(read_checkpoint(folder / LAST).config, resume=folder, out=folder)
    elif source is not None:
        saved = from_json(TrainConfig, json.loads(Path(source).read_text()), source=source)
        # A new run, wherever the saved one lay and whether or not it had been resumed.
        default = replace(saved, resume=None, out=None)
    return tyro.cli(
        TrainConfig,
        default=default,
        args=arguments,
        prog="python -m adaptgns.train",
        description="A training run, from the data to the table of results. --config FILE.json "
        "starts from the configuration that a run saved, --resume DIR from that of the run it "
        "goes on with; other options change it.",
    )


def _take(arguments: list[str], option: str) -> tuple[str | None, list[str]]:
    """The value of ``option`` (as ``--option value`` or ``--option=value``) and the other
    arguments."""
    for index, argument in enumerate(arguments):
        if argument == option and index + 1 < len(arguments):
            return arguments[index + 1], arguments[:index] + arguments[index + 2 :]
        if argument.startswith(option + "="):
            return argument.split("=", 1)[1], arguments[:index] + arguments[index + 1 :]
    return None, arguments


def train(config: TrainConfig, console: Console, group: Processes) -> tuple[Path, Path]:
    """Train by ``config``, as one of the processes of ``group``; the run folder and that of the
    data."""
    folder = group.same(lambda: run_folder(config))
    checkpoint = None if config.resume is None else read_checkpoint(config.resume / LAST)
    threads = config.threads or torch.get_num_threads()
    if torch_device(config.device).type == "cpu":
        divide_threads(threads)
    else:
        torch.set_num_threads(threads)
    with group.first_ahead():  # to make or complete what all read, and to tell what is wrong
        data = dataset_folder(config.data)
        metadata = read_metadata(data)
        if checkpoint is not None and metadata != checkpoint.metadata:
            raise ValueError(
                f"data: {data} is not what the run in {config.resume} was started with, by its "
                "metadata.json; accepted is the same data, wherever it lies"
            )
        train_split, valid_split, test_split = (
            open_split(data, split) for split in ("train", "valid", "test")
        )
        # Before anything depends on them.
        types, *_ = (check_split(s, metadata) for s in (train_split, valid_split, test_split))
        trainer = Trainer(
            config,
            metadata,
            folder,
            train=train_split,
            valid=valid_split,
            types=types,
            checkpoint=checkpoint,
            processes=group,
        )
    if group.first:
        replace_text(folder / CONFIG, json.dumps(to_json(config), indent=1))
    console.print(
        f"training on {data}: {len(trainer.windows):,} windows, "
        f"{sum(p.numel() for p in trainer.simulator.parameters()):,} parameters, "
        f"{trainer.device.type}; run folder {folder}",
        highlight=False,
    )
    if data == Path(config.data) and checkpoint is None:
        _tell_assumptions(config, console)
    trainer.run(console)
    return folder, data


def _tell_assumptions(config: TrainConfig, console: Console) -> None:
    """What a preset takes for granted that not all data have."""
    for assumed, what, option in (
        (config.model.walls, "solid walls at the bounds", "--model.no-walls"),
        (config.mirror, "physics that is symmetric along the first axis", "--no-mirror"),
        (config.compression > 0, "matter that resists compression", "--compression 0"),
    ):
        if assumed:
            console.print(f"assuming {what}; {option} if that is wrong", highlight=False)


def run_folder(config: TrainConfig) -> Path:
    """Where the run's files go. A new run never goes where another one is."""
    if config.resume is not None:
        return config.resume
    if config.out is not None:
        if (config.out / LAST).exists():
            raise ValueError(
                f"--out: {config.out} holds a run already; go on with it (--resume {config.out}) "
                "or name another folder"
            )
        return config.out
    network = "gns" if config.model.edges else "mlp"
    name = f"{Path(config.data).name}-{config.preset}-{network}-{config.loss}-{config.seed}"
    folder = Path("runs") / name
    taken = 1
    while (folder / LAST).exists():
        taken += 1
        folder = Path("runs") / f"{name}-{taken}"
    return folder


def report(folder: Path, data: Path, config: TrainConfig, console: Console) -> None:
    """Roll the test split out, fixed and adaptive; print the table and where everything is."""
    policies: list[PolicyName] = ["fixed"]
    if config.model.edges and config.loss != "mse":
        policies.append("adaptive")
    files = []
    for policy in policies:
        out = folder / "rollouts" / f"{policy}.h5"
        write_rollouts(
            RolloutConfig(
                checkpoint=folder,
                data=str(data),
                policy=policy,
                device=config.device,
                adaptive=config.adaptive,
                steps=config.test_horizon,
                trajectories=config.test_trajectories,
                out=out,
                precision=config.precision,
            ),
            console,
        )
        files.append(out)
    evaluate(files, out=folder, console=console)
    animation = folder / "rollout.gif"
    animate(files[-1], animation)
    console.print(
        f"checkpoint  {checkpoint_file(folder)}\n"
        f"metrics     {folder / 'metrics.json'}\n"
        f"rollouts    {', '.join(map(str, files))}\n"
        f"animation   {animation}",
        highlight=False,
        soft_wrap=True,
    )


if __name__ == "__main__":
    main()
