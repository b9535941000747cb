"""Make the checkpoints that come with the package from a study's runs.

    python benchmarks/pretrained.py results/laptop

Of each data set the first seed's NLL model that was trained four times as long, with nothing in it
of where it was made. Its metrics are those of the study: ``metrics/DATA/nll-400-0-*.json``.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from adaptgns.checkpoint import PRETRAINED, read_checkpoint, write_checkpoint
from adaptgns.data.default import EMBEDDED
from adaptgns.reproduce.profiles import LONG_NLL


def main() -> None:
    for name in EMBEDDED:
        made = read_checkpoint(Path(sys.argv[1]) / "training" / name / f"{LONG_NLL}-0")
        config = replace(made.config, data=name, out=None, resume=None, threads=None)
        path = PRETRAINED / f"{name}.safetensors"
        write_checkpoint(path, replace(made, config=config))
        print(f"{path}: step {made.step}, {path.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main()
