"""The console script ``adaptgns``: each command is the module of its name."""

from __future__ import annotations

import importlib
import sys

COMMANDS = {
    "train": "make or read data, train, roll out, and print the table",
    "rollout": "step a trained model forward over a split",
    "evaluate": "metrics and tables of rollouts",
    "generate": "make a data set with the embedded solver",
    "convert": "data sets and checkpoints from and to other formats",
    "inspect": "graph statistics, advice on the radius, problems of a data set",
    "plot": "GIF, MP4, browser page or VTK series of a rollout; figures of runs",
    "sweep": "tau, factor and radius of the adaptive graph, on validation rollouts",
    "reproduce": "every table and figure of the paper, with seeds",
}


def main() -> None:
    """Run ``adaptgns COMMAND ...`` as ``python -m adaptgns.COMMAND ...``."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print("usage: adaptgns COMMAND [options]; adaptgns COMMAND --help tells them\n")
        print("\n".join(f"  {name:10}{what}" for name, what in COMMANDS.items()))
        return
    command, *rest = arguments
    if command not in COMMANDS:
        print(f"adaptgns: got {command!r}; accepted are {', '.join(COMMANDS)}", file=sys.stderr)
        raise SystemExit(2)
    importlib.import_module(f"adaptgns.{command}").main(rest)


if __name__ == "__main__":
    main()
