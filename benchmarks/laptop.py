"""Train the laptop preset and the per-particle MLP as long, and put both in one table.

    python benchmarks/laptop.py DATA [--out benchmarks/results/laptop_NAME.json] [-- OPTIONS]

DATA is what ``python -m adaptgns.train --data`` takes, and OPTIONS are passed on to it. Runs lie in
``runs/benchmark``; one that was interrupted goes on, and one that has ended is not repeated. One
that was made with other options is refused: its folder is to be removed first.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from adaptgns import train
from adaptgns.checkpoint import LAST, read_checkpoint
from adaptgns.evaluate import METRICS, evaluate


def six_digits(number: str) -> float:
    return float(f"{float(number):.6g}")


def rollouts(folder: Path, arguments: list[str]) -> list[Path]:
    """The rollouts of the run in ``folder``, which is made where it is not there."""
    begun = (folder / LAST).exists()
    asked = [*arguments, "--out", str(folder)]
    if begun:
        made = replace(read_checkpoint(folder / LAST).config, resume=None)
        if made != train.parse(asked):
            raise SystemExit(f"{folder}: a run with other options is there; remove it first")
    if not (folder / METRICS).exists():
        train.main(["--resume", str(folder)] if begun else asked)
    return sorted((folder / "rollouts").glob("*.h5"), reverse=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data")
    parser.add_argument("--out", type=Path, help="where to write the figures as JSON")
    options, rest = parser.parse_known_args(sys.argv[1:])
    rest = [option for option in rest if option != "--"]
    name = Path(options.data).name
    folder = Path("runs/benchmark")
    files = [
        *rollouts(folder / name, ["--data", options.data, *rest]),
        *rollouts(folder / f"{name}-mlp", ["--data", options.data, "--model.no-edges", *rest]),
    ]
    together = folder / f"{name}-together"
    together.mkdir(parents=True, exist_ok=True)
    evaluate(files, out=together, console=Console())
    if options.out:
        report = json.loads((together / METRICS).read_text(), parse_float=six_digits)
        for rollout in report["rollouts"]:  # where the data lay is nobody's business
            for settings in (rollout["settings"], rollout["settings"].get("training", {})):
                if "data" in settings:
                    settings["data"] = Path(settings["data"]).name
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(report) + "\n")


if __name__ == "__main__":
    main()
