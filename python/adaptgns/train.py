"""`python -m adaptgns.train`: data, training, rollouts, and the table of what came out."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import IO

import numpy as np
import torch
import tyro
from rich.console import Console

from adaptgns.atomic import read_json, replace_text
from adaptgns.checkpoint import LAST, Checkpoint, checkpoint_file, read_checkpoint, take_weights
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
from adaptgns.data.metadata import Metadata, read_metadata
from adaptgns.data.trajectories import open_split
from adaptgns.evaluate import evaluate
from adaptgns.fit import Trainer, TrainingStopped
from adaptgns.plot import animate
from adaptgns.presets import PRESETS
from adaptgns.processes import OtherEndedError, Processes, processes
from adaptgns.rollout import write_rollouts
from adaptgns.threads import divide_threads

try:
    import fcntl
except ImportError:
    fcntl = None  # type: ignore[assignment]

CONFIG = "config.json"
LOCK = ".lock"
NOISE = (0.02, 2.0)
"""Standard deviations between which training noise is not worth a word"""


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command with ``argv``, or with the process's own arguments."""
    console = Console()
    with plain_errors(torch.OutOfMemoryError, OtherEndedError), ExitStack() as held:
        config = parse(sys.argv[1:] if argv is None else list(argv))
        with processes(config.device) as group:
            own = console if group.first else Console(quiet=True)
            try:
                folder = group.same(lambda: held.enter_context(run_folder(config)))
                data = train(config, folder, own, group)
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
    if len(given := [each for each in (preset, source, resume) if each is not None]) > 1:
        raise ValueError(
            f"--preset, --config and --resume: got {', '.join(given)}; accepted is one of them, "
            "since each is a whole configuration"
        )
    default = PRESETS[preset or "laptop"]
    folder = None if resume is None else Path(resume)
    if folder is not None:
        default = replace(_last_checkpoint(folder).config, resume=folder, out=folder)
    elif source is not None:
        content = read_json(Path(source))
        if not isinstance(content, dict):
            raise ValueError(f"{source}: holds a {type(content).__name__}; an object is accepted")
        saved = from_json(TrainConfig, content, source=source)
        # A new run, wherever the saved one lay and whether or not it had been resumed.
        default = replace(saved, resume=None, out=None)
    config = tyro.cli(
        TrainConfig,
        default=default,
        args=arguments,
        prog="python -m adaptgns.train",
        description="A training run, from the data to the table of results. --config FILE.json "
        "starts from the configuration that a run saved, --resume DIR from that of the run it "
        "goes on with; other options change it.",
    )
    if folder is not None and config.out != folder:
        raise ValueError(
            f"--out: got {config.out} beside --resume {folder}; a run goes on in its own folder "
            "(copy that to keep it as it is)"
        )
    if folder is not None and config.init != default.init:
        raise ValueError(f"--init: got {config.init} beside --resume {folder}; a run begins once")
    return config


def _last_checkpoint(folder: Path) -> Checkpoint:
    """What the run in ``folder`` goes on from; ValueError where there is none."""
    if not (folder / LAST).is_file():
        raise ValueError(
            f"--resume: {folder} holds no {LAST}; accepted is the folder of a run that got as far "
            "as its first checkpoint"
        )
    return read_checkpoint(folder / LAST)


def _take(arguments: list[str], option: str) -> tuple[str | None, list[str]]:
    """The value of ``option`` (as ``--option value`` or ``--option=value``) and the other
    arguments."""
    given = [i for i, a in enumerate(arguments) if a == option or a.startswith(option + "=")]
    if len(given) > 1:
        raise ValueError(f"{option}: got it {len(given)} times; accepted is once")
    if not given:
        return None, arguments
    before, (argument, *after) = arguments[: given[0]], arguments[given[0] :]
    if argument != option:
        return argument.split("=", 1)[1], before + after
    return (after[0], before + after[1:]) if after else (None, arguments)


def train(config: TrainConfig, folder: Path, console: Console, group: Processes) -> Path:
    """Train by ``config`` in ``folder`` (:func:`run_folder`), as one of the processes of ``group``;
    the data's folder."""
    checkpoint = None if config.resume is None else _last_checkpoint(folder)
    threads = config.threads or torch.get_num_threads()
    if torch_device(config.device).type == "cpu":
        divide_threads(threads)
    else:
        torch.set_num_threads(threads)
    with group.first_ahead():  # to make or complete what all read, and to tell what is wrong
        data = dataset_folder(config.data)
        own = data == Path(config.data)
        if own:  # which the checkpoints name, wherever they are used from
            config = replace(config, data=str(data.resolve()))
        if config.init is not None and config.init.exists():  # else the name of a packaged one
            config = replace(config, init=config.init.resolve())
        metadata = read_metadata(data)
        if checkpoint is not None and metadata != checkpoint.metadata:
            raise ValueError(
                f"data: {data} is not what the run in {config.resume} was started with, by its "
                "metadata.json; accepted is the same data, wherever it lies"
            )
        train_split, valid_split, test_split = (
            open_split(data, split) for split in ("train", "valid", "test")
        )
        types = None
        if group.first:  # before anything depends on them; the others need not look again
            test_metadata, _ = metadata.suited(data, "test")  # whose bounds may be its own
            types = check_split(train_split, metadata)
            check_split(valid_split, metadata)
            check_split(test_split, test_metadata)
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
    if checkpoint is None and config.init is not None:
        told = f"begins with the weights of {config.init}"
        apart = zip(("anew", "left out"), take_weights(trainer.simulator, config.init), strict=True)
        for how, names in apart:
            told += f"; {how}: {', '.join(names)}" if names else ""
        console.print(told, highlight=False)
    if group.first:
        replace_text(folder / CONFIG, json.dumps(to_json(config), indent=1))
    console.print(
        f"training on {data}: {len(trainer.windows):,} windows, "
        f"{sum(p.numel() for p in trainer.simulator.parameters()):,} parameters, "
        f"{trainer.device.type}; run folder {folder}",
        highlight=False,
    )
    if own and checkpoint is None:
        _tell_assumptions(config, metadata, console)
    trainer.run(console)
    return data


def _tell_assumptions(config: TrainConfig, metadata: Metadata, console: Console) -> None:
    """What a preset takes for granted that not all data have."""
    bounded = not all(metadata.periodic)
    for assumed, what, option in (
        (config.model.walls and bounded, "solid walls at the bounds", "--model.no-walls"),
        (config.mirror, "physics that is symmetric along the first axis", "--no-mirror"),
        (config.compression > 0, "matter that resists compression", "--compression 0"),
    ):
        if assumed:
            console.print(f"assuming {what}; {option} if that is wrong", highlight=False)
    for name, value, what, stds in (
        ("noise", config.noise, "velocity's", metadata.velocity_std),
        ("drift", config.drift, "acceleration's", metadata.acceleration_std),
    ):
        std = float(np.mean(stds))
        if value and not NOISE[0] <= value / std <= NOISE[1]:
            console.print(
                f"warning: {name} is {value:g}, {value / std:.2g} times the {what} standard "
                "deviation in these data; usual is a tenth to a third, "
                f"--{name} {0.1 * std:.1g} to {std / 3:.1g}",
                highlight=False,
            )


@contextmanager
def run_folder(config: TrainConfig) -> Iterator[Path]:
    """Where the run's files go, which no other training writes to meanwhile. A new run never goes
    where another one is."""
    named = config.resume or config.out
    if named is not None:
        with _locked(named) as own:
            if not own:
                instead = "wait for it" if config.resume else "name another folder"
                raise ValueError(
                    f"{named}: another training is at work there; {instead}, or end it"
                )
            if config.resume is None and (named / LAST).exists():
                raise ValueError(
                    f"--out: {named} holds a run already; go on with it (--resume {named}) "
                    "or name another folder"
                )
            yield named
        return
    network = "gns" if config.model.edges else "mlp"
    name = f"{Path(config.data).name}-{config.preset}-{network}-{config.loss}-{config.seed}"
    for number in count(1):
        folder = Path("runs") / (name if number == 1 else f"{name}-{number}")
        if (folder / LAST).exists():
            continue
        with _locked(folder) as own:
            if own and not (folder / LAST).exists():
                yield folder
                return


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Whether ``folder`` is this process's own meanwhile: no longer than the process lives, however
    it ends. What is made for it and holds nothing in the end does not stay."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    lock = folder / LOCK
    try:
        with lock.open("a") as file:
            yield _lock(file)
    finally:
        with suppress(OSError):
            if folder in made and list(folder.iterdir()) == [lock]:
                lock.unlink()
                for each in made:
                    each.rmdir()


def _lock(file: IO[str]) -> bool:
    """Whether no other process has locked ``file``, as far as the file system can tell."""
    if fcntl is None:  # Windows
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:  # a file system without locks
        pass
    return True


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
