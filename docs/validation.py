"""The picture of `docs/pictures.md` that training shows in TensorBoard, of a rollout at hand.

    python docs/validation.py ROLLOUT.h5

Writes `images/validation.png` next to this file, of the first trajectory.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

from adaptgns.rollout_file import RolloutFile
from adaptgns.snapshot import snapshot


def main() -> None:
    path = Path(__file__).parent / "images" / "validation.png"
    with RolloutFile(Path(sys.argv[1])) as file:
        rollout = file[0]
        mobile = file.metadata.mobile(rollout.particle_type)
        picture = snapshot(file.metadata, rollout.true, rollout.predicted, rollout.sigma, mobile)
    Image.fromarray(picture).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main()
