"""`python -m adaptgns.generate`: a data set from the embedded MLS-MPM solver."""

from __future__ import annotations

import errno
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro
from rich.console import Console

from adaptgns.data.default import EMBEDDED, dataset_folder, default_dataset
from adaptgns.data.generation import SplitPlan, generate_dataset
from adaptgns.data.scenes import SCENES, SceneName

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["EMBEDDED", "GenerateConfig", "dataset_folder", "default_dataset", "generate", "main"]

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


@dataclass(frozen=True)
class GenerateConfig:
    """Make a data set with the embedded MLS-MPM solver.

    An interrupted run goes on with the splits that aren't finished; run the same command again.
    """

    scene: SceneName
    """What falls into the box, and on what; docs/scenes.md shows each."""
    out: Path
    """Folder for train.h5, valid.h5, test.h5 and metadata.json; made if missing."""
    train: int = 1000
    """Training trajectories."""
    valid: int = 30
    """Validation trajectories; 0 for no such file."""
    test: int = 30
    """Test trajectories; 0 for no such file."""
    frames: int | None = None
    """Frames per trajectory, 0.0025 s apart; None: the scene's own, 320 to 1000."""
    seed: int = 0
    """Seed; more trajectories under the same seed begin with the same ones."""
    dim: Literal[2, 3] = 2
    """Spatial dimensions."""
    particles: tuple[int, int] | None = None
    """Fewest and most particles of a trajectory, obstacles not counted; None: the published
    set's sizes."""


def generate(config: GenerateConfig, *, console: Console | None = None) -> None:
    """Makes the data set that `config` describes; see `generate_dataset` for errors."""
    counts = {"train": config.train, "valid": config.valid, "test": config.test}
    plans = {
        split: SplitPlan(
            scene=config.scene,
            trajectories=count,
            frames=SCENES[config.scene].frames if config.frames is None else config.frames,
            seed=config.seed,
            dim=config.dim,
            particles=config.particles,
        )
        for split, count in counts.items()
        if count != 0
    }
    generate_dataset(config.out, plans, console=console)


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command with `argv`, or with the process's own arguments."""
    config = tyro.cli(GenerateConfig, args=argv, prog="python -m adaptgns.generate")
    console = Console(stderr=True)
    try:
        generate(config, console=console)
    except KeyboardInterrupt:
        console.print(
            f"interrupted; the same command goes on with what is missing in {config.out}",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
        # Leaving the interpreter would wait for the solver's threads to end their trajectories.
        sys.stderr.flush()
        os._exit(128 + 2)
    except (ValueError, OSError, MemoryError) as error:
        console.print(f"error: {_explain(error)}", markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(2) from None
    print(f"{config.out}: data set of {config.scene}; look at it with")
    print(f"  python -m adaptgns.inspect {config.out}")


def _explain(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno in _FULL:
        return (
            "the disk is full; the unfinished file was removed, finished splits are kept, and the "
            "same command goes on with what is missing"
        )
    return str(error) or type(error).__name__


if __name__ == "__main__":
    main()
