"""Make the checkpoints that come with the package from a study's runs.

    python benchmarks/pretrained.py results/laptop

Of each data set's NLL models that were trained four times as long, the one with the lowest
validation error, with nothing in it of where it was made. Their metrics are those of the study:
``metrics/DATA/nll-400-SEED-*.json``.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from adaptgns.checkpoint import PRETRAINED, Checkpoint, read_checkpoint, write_checkpoint
from adaptgns.data.default import EMBEDDED
from adaptgns.reproduce.profiles import LONG_NLL


def main() -> None:
    for name in EMBEDDED:
        folders = sorted((Path(sys.argv[1]) / "training" / name).glob(f"{LONG_NLL.name}-[0-9]"))
        made: dict[Path, Checkpoint] = {folder: read_checkpoint(folder) for folder in folders}
        best = min(made, key=lambda folder: made[folder].best_score)
        config = replace(made[best].config, data=name, out=None, resume=None, threads=None)
        path = PRETRAINED / f"{name}.safetensors"
        write_checkpoint(path, replace(made[best], config=config))
        print(f"{path}: {best.name}, step {made[best].step}, {path.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main()
