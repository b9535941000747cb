"""The pictures of `docs/scenes.md`: four frames of one trajectory of each scene.

    python docs/scenes.py [SCENE ...]

Generates each trajectory as `python -m adaptgns.generate` does and writes `images/scenes/NAME.png`
next to this file; three-dimensional ones are called `NAME-3d`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from adaptgns.data import open_split, read_metadata
from adaptgns.data.generation import SplitPlan, generate_dataset
from adaptgns.data.scenes import SceneName
from adaptgns.view import View

# Okabe and Ito's palette, apart from each other for all eyes and in grey.
COLOURS = {3: "#303030", 5: "#0072b2", 6: "#e69f00", 7: "#cc79a7"}
FRAME = "#b0b0b0"
SIDE, DPI = 2.5, 100  # of one frame, in inches, and pixels per inch


@dataclass(frozen=True)
class Picture:
    scene: SceneName
    frames: tuple[int, int, int, int]
    seed: int = 0
    dim: int = 2
    stripe: bool = False  # what begins in the middle of the box is orange


PICTURES = {
    "waterdrop": Picture("waterdrop", (0, 110, 170, 900)),
    "sand": Picture("sand", (0, 50, 100, 310)),
    "goop": Picture("goop", (0, 60, 100, 390)),
    "jelly": Picture("jelly", (0, 71, 110, 200), seed=4),
    "multimaterial": Picture("multimaterial", (0, 90, 140, 900), seed=3),
    "waterramps": Picture("waterramps", (0, 100, 150, 350)),
    "stirrer": Picture("stirrer", (0, 100, 200, 500)),
    "vortices": Picture("vortices", (0, 60, 150, 390), stripe=True),
    "waterdrop-3d": Picture("waterdrop", (0, 100, 150, 600), dim=3),
    "sand-3d": Picture("sand", (0, 60, 120, 310), dim=3),
    "multimaterial-3d": Picture("multimaterial", (0, 80, 150, 900), dim=3),
    "waterramps-3d": Picture("waterramps", (0, 100, 150, 350), dim=3),
}


def draw(picture: Picture, path: Path) -> None:
    plan = SplitPlan(
        picture.scene,
        trajectories=1,
        frames=picture.frames[-1] + 1,
        seed=picture.seed,
        dim=picture.dim,
    )
    with TemporaryDirectory() as folder:
        generate_dataset(Path(folder), {"train": plan})
        view = View(read_metadata(Path(folder)))
        trajectory = open_split(Path(folder), "train")[0]
    colours = np.array([COLOURS[kind] for kind in trajectory.particle_type.tolist()])
    if picture.stripe:
        height = trajectory.positions[0, :, 1]
        colours[np.abs(height - height.mean()) < 0.15] = COLOURS[6]
    figure = Figure(figsize=(4 * SIDE, SIDE), dpi=DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for axes, frame in zip(figure.subplots(1, 4), picture.frames, strict=True):
        points, order = view.points(trajectory.positions[frame])
        axes.add_collection(LineCollection(view.frame, colors=FRAME, linewidths=0.8))
        axes.scatter(*points[order].T, s=4, c=colours[order], linewidths=0)
        axes.add_collection(LineCollection(view.front, colors=FRAME, linewidths=0.8))
        axes.set_xlim(view.lower[0], view.upper[0])
        axes.set_ylim(view.lower[1], view.upper[1])
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(f"{frame * 0.0025:.2f} s", fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.print_png(path, pil_kwargs={"optimize": True}, metadata={"Software": None})


def main() -> None:
    for name in sys.argv[1:] or PICTURES:
        path = Path(__file__).parent / "images" / "scenes" / f"{name}.png"
        draw(PICTURES[name], path)
        print(f"{path}: {path.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main()
