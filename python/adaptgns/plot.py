"""`python -m adaptgns.plot`: pictures of rollouts.

animate: a GIF or MP4 with the truth on the left and the prediction on the right.
viewer: an HTML file that plays in any browser.
figures: curves of one run or several, for a page.
vtk: frames and graphs that ParaView opens.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from adaptgns.animation import Animation
from adaptgns.command import plain_errors
from adaptgns.figures import write_figures
from adaptgns.next_graph import unrecorded
from adaptgns.rollout_file import RolloutFile
from adaptgns.viewer import write_viewer
from adaptgns.vtk_series import write_series


@dataclass(frozen=True)
class AnimateConfig:
    """Animate one trajectory of a rollout file: truth on the left, prediction on the right."""

    rollout: tyro.conf.Positional[Path]
    """Rollout file (HDF5)."""
    out: Path
    """GIF or MP4 file to write."""
    trajectory: int = 0
    """Which trajectory of the file, counted from 0."""
    every: int = 4
    """Steps from one picture to the next."""
    fps: int = 25
    """Pictures per second."""


@dataclass(frozen=True)
class ViewerConfig:
    """Write one trajectory of a rollout file as a page that plays in any browser."""

    rollout: tyro.conf.Positional[Path]
    """Rollout file (HDF5)."""
    out: Path
    """HTML file to write."""
    trajectory: int = 0
    """Which trajectory of the file, counted from 0."""


@dataclass(frozen=True)
class FiguresConfig:
    """Figures of runs as PNG and PDF: training, errors and edges per step, calibration, Pareto."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that train or evaluate wrote."""
    out: Path
    """Folder for the figures."""


@dataclass(frozen=True)
class VtkConfig:
    """Write one trajectory of a rollout file as VTK series that ParaView opens."""

    rollout: tyro.conf.Positional[Path]
    """Rollout file (HDF5)."""
    out: Path
    """Folder for truth.pvd, prediction.pvd and graph.pvd, and for the frames they name."""
    trajectory: int = 0
    """Which trajectory of the file, counted from 0."""
    every: int = 1
    """Steps from one frame to the next."""


def animate(
    rollout: Path, out: Path, *, trajectory: int = 0, every: int = 4, fps: int = 25
) -> None:
    """Write an animation of one trajectory of a rollout file to ``out``, .gif or .mp4.

    Particles of the truth are coloured by their speed, those of the prediction by their sigma (by
    speed too, for a model without a variance head), both scales fixed over the animation. For the
    policy ``adaptive`` the extra edges are drawn that the next step sees beyond the base radius.
    Below run the number of edges and the position error. ``every`` counts the steps from one
    picture to the next, of ``fps`` per second. 3D is seen from an elevated corner.
    """
    if every < 1 or not 1 <= fps <= 50:
        raise ValueError(
            f"every, fps: got {every} and {fps}; accepted are every >= 1 and fps from 1 to 50"
        )
    with RolloutFile(rollout) as file:
        _tell_unrecorded(file)
        Animation(file, file[trajectory], every).write(out, fps)


def viewer(rollout: Path, out: Path, *, trajectory: int = 0) -> None:
    """Write one trajectory of a rollout file to the HTML file ``out``, for any browser.

    The page holds everything it needs; see :mod:`adaptgns.viewer`.
    """
    with RolloutFile(rollout) as file:
        write_viewer(file, file[trajectory], out)


def vtk(rollout: Path, out: Path, *, trajectory: int = 0, every: int = 1) -> None:
    """Write one trajectory of a rollout file as VTK series into the folder ``out``, every
    ``every``-th step and the last; see :mod:`adaptgns.vtk_series`."""
    with RolloutFile(rollout) as file:
        _tell_unrecorded(file)
        write_series(file, file[trajectory], out, every)


def _tell_unrecorded(file: RolloutFile) -> None:
    if (missing := unrecorded(file)) is not None:
        Console(stderr=True).print(f"note: {missing}", highlight=False, soft_wrap=True)


Config = AnimateConfig | ViewerConfig | FiguresConfig | VtkConfig
SUBCOMMANDS: dict[str, Callable[..., Config]] = {
    "animate": AnimateConfig,
    "viewer": ViewerConfig,
    "figures": FiguresConfig,
    "vtk": VtkConfig,
}


def run(config: Config) -> None:
    """Make what ``config`` asks for."""
    match config:
        case AnimateConfig(rollout, out, trajectory, every, fps):
            animate(rollout, out, trajectory=trajectory, every=every, fps=fps)
        case ViewerConfig(rollout, out, trajectory):
            viewer(rollout, out, trajectory=trajectory)
        case FiguresConfig(runs, out):
            write_figures(runs, out)
        case VtkConfig(rollout, out, trajectory, every):
            vtk(rollout, out, trajectory=trajectory, every=every)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command with ``argv``, or with the process's own arguments."""
    config: Config = tyro.extras.subcommand_cli_from_dict(
        SUBCOMMANDS, args=argv, prog="python -m adaptgns.plot"
    )
    with plain_errors(IndexError, ImportError):
        run(config)
    Console().print(str(config.out), highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
