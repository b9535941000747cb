"""The animation of a rollout: truth and prediction side by side, drawn picture by picture."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, repeat
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray
from PIL import Image

from adaptgns.atomic import written_whole
from adaptgns.metrics import Floats, edge_counts, position_mse
from adaptgns.next_graph import next_graph
from adaptgns.palette import (
    BACKGROUND,
    BASE_EDGE,
    EXTRA_EDGE,
    KINEMATIC,
    LINE,
    PANEL,
    PREDICTED,
    SIGMA_MAP,
    SPEED_MAP,
    TEXT,
    TRUE,
)
from adaptgns.periodic import minimum_image
from adaptgns.rollout_file import Rollout, RolloutFile
from adaptgns.video import write_mp4
from adaptgns.view import View, faded

WIDTH, HEIGHT, DPI = 9.6, 6.6, 100
"""Inches, and pixels per inch"""
POINTS_PER_INCH = 72
SMALL, LARGE = 8, 11
"""Points of the type"""
MARKER = 0.52
"""Diameter of a particle, in radii of the graph"""
CLIPPED = (1.0, 99.5)
"""Percentiles that the scale of sigma ends at"""
COLOURS = 255
"""Of the palette that all pictures share; Pillow takes one more for what stays as it was."""
PALETTE_PICTURES, RAMP_ROWS = 6, 120


class Animation:
    """The pictures of one ``rollout`` of ``file``, every ``every`` steps and the last.

    What moves is drawn over a background that is drawn once.
    """

    def __init__(self, file: RolloutFile, rollout: Rollout, every: int) -> None:
        self._file, self._box = file, file.metadata.box
        self._true, self._predicted = rollout.true, rollout.predicted
        if not np.isfinite(self._predicted).all():
            raise ValueError(
                f"rollout: the prediction of trajectory {rollout.name} in {file.path} holds "
                "positions that are not finite and can't be drawn"
            )
        self._sigma = rollout.sigma
        self._extra_edges = file.policy == "adaptive" and self._sigma is not None
        self._mobile = file.metadata.mobile(rollout.particle_type)
        self._steps = rollout.steps
        self.shown: Sequence[int] = sorted({*range(every - 1, self._steps, every), self._steps - 1})
        """Rows of the rollout that are drawn"""
        self._view = View(file.metadata)
        self._figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DPI, facecolor=BACKGROUND)
        self._canvas = FigureCanvasAgg(self._figure)
        self._moving: list[Artist] = []
        self._build_panels(rollout)
        self._build_strips(rollout)
        self._canvas.draw()  # type: ignore[no-untyped-call]
        self._background = self._canvas.copy_from_bbox(  # type: ignore[no-untyped-call]
            self._figure.bbox
        )

    def write(self, path: Path, fps: int) -> None:
        """Write the GIF or MP4 ``path``, whole or not at all; the last picture stays a second.

        ValueError for another suffix, ImportError for an MP4 without imageio-ffmpeg.
        """
        match path.suffix.lower():
            case ".gif":
                self._write_gif(path, fps)
            case ".mp4":
                last = repeat(self.shown[-1], fps - 1)
                size = self._canvas.get_width_height()
                write_mp4(path, self.pictures(chain(self.shown, last)), size, fps)
            case _:
                raise ValueError(f"out: got {path}; accepted are names that end in .gif or .mp4")

    def _write_gif(self, path: Path, fps: int) -> None:
        palette = self._palette()
        frames = (
            Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
            for picture in self.pictures(self.shown)
        )
        duration = [1000 // fps] * (len(self.shown) - 1) + [1000]
        with written_whole(path) as partial:
            next(frames).save(
                partial,
                format="GIF",
                save_all=True,
                append_images=frames,
                duration=duration,
                loop=0,
            )

    def pictures(self, rows: Iterable[int]) -> Iterator[NDArray[np.uint8]]:
        """``[height, width, 3]`` pictures of the given rows of the rollout."""
        for row in rows:
            self._update(row)
            self._canvas.restore_region(self._background)  # type: ignore[no-untyped-call]
            for artist in self._moving:
                self._figure.draw_artist(artist)
            drawn = np.asarray(self._canvas.buffer_rgba())  # type: ignore[no-untyped-call]
            yield drawn[..., :3].copy()

    def _palette(self) -> Image.Image:
        """One palette for all pictures: of a few of them spread over the animation, and of the
        colour maps, whose particles are too small to weigh much in the pictures themselves."""
        chosen = np.linspace(0, len(self.shown) - 1, PALETTE_PICTURES).round().astype(int)
        pictures = list(self.pictures(self.shown[index] for index in sorted(set(chosen))))
        ramp = np.linspace(0.0, 1.0, pictures[0].shape[1])
        # From the nearest corner to the farthest; in 2D all is near.
        near = np.linspace(1.0, 0.0 if self._view.solid else 1.0, RAMP_ROWS)[:, None, None]
        ramps = [
            np.uint8(255 * faded(colour_map(ramp), near, PANEL))[..., :3]
            for colour_map in (SPEED_MAP, SIGMA_MAP)
        ]
        sample = np.concatenate([*pictures, *ramps])
        return Image.fromarray(sample).quantize(COLOURS, dither=Image.Dither.NONE)

    def _build_panels(self, rollout: Rollout) -> None:
        """The particles of truth and prediction, with their colour scales."""
        speeds = self._speeds(rollout.initial, self._true)
        fast = float(np.percentile(speeds[:, self._mobile], CLIPPED[1]))
        speed = Normalize(0.0, fast if fast > 0 else 1.0)
        truth = self._panel(0.02, "truth", TRUE)
        model = self._panel(0.515, f"{self._file.label}, {self._file.policy}", PREDICTED)
        self._base_lines = self._lines(model, BASE_EDGE, 0.6)
        self._extra_lines = self._lines(model, EXTRA_EDGE, 0.55)
        if self._extra_edges:
            model.set_title("— extra edges", color=EXTRA_EDGE, fontsize=SMALL, loc="right")
        area = self._marker_area(truth)

        def cloud(axes: Axes, colours: Floats, colour_map: Colormap, scale: Normalize) -> Cloud:
            return Cloud(
                axes,
                view=self._view,
                colours=colours,
                mobile=self._mobile,
                colour_map=colour_map,
                scale=scale,
                area=area,
            )

        self._true_cloud = cloud(truth, speeds, SPEED_MAP, speed)
        if self._sigma is None:
            colours = self._speeds(rollout.initial, self._predicted)
            self._cloud = cloud(model, colours, SPEED_MAP, speed)
            label = "speed"
        else:
            seen = self._sigma[self.shown][:, self._mobile]
            low, high = np.percentile(seen, CLIPPED) if seen.size else (1.0, 1.0)
            low = max(low, float(np.finfo(np.float32).tiny))  # a logarithmic scale has no zero
            scale = LogNorm(low, max(high, 1.01 * low))
            self._cloud = cloud(model, self._sigma, SIGMA_MAP, scale)
            label = "predicted σ"
        fronts = [self._front(panel) for panel in (truth, model)]
        self._moving += [self._true_cloud.points, self._cloud.points, *fronts]
        self._scale(truth, self._true_cloud.points, "speed")
        self._scale(model, self._cloud.points, label)
        self._step = self._text(truth, 1.0, 1.02)
        self._lost = self._text(model, 0.96, 0.93)

    def _build_strips(self, rollout: Rollout) -> None:
        """The curves below, and the cursors that run along them."""
        everyone = np.ones_like(self._mobile)
        radius = self._file.graph_radius
        true_edges = edge_counts(self._true, radius, everyone, self._box)
        error = position_mse(self._predicted, self._true, self._mobile, self._box)
        edges = self._strip(0.075, "edges per step")
        self._curve(edges, true_edges, TRUE)
        self._curve(edges, rollout.edges, PREDICTED)
        edges.set_ylim(bottom=0)
        edges.yaxis.set_major_locator(MaxNLocator(3, integer=True))
        edges.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        mse = self._strip(0.565, "position MSE")
        mse.set_yscale("log")
        # The first steps' errors are orders of magnitude below what can be seen.
        floor = max(1e-6 * float(error.max()), np.finfo(np.float32).tiny)
        self._curve(mse, np.maximum(error, floor), PREDICTED)
        mse.yaxis.set_major_locator(LogLocator(numticks=4))
        mse.yaxis.set_minor_locator(NullLocator())
        self._cursors = [
            axes.axvline(1, color=TEXT, linewidth=0.8, animated=True) for axes in (edges, mse)
        ]
        self._moving += self._cursors

    def _update(self, row: int) -> None:
        """Move everything to the given row of the rollout."""
        positions = self._predicted[row]
        self._true_cloud.update(row, self._true[row])
        self._cloud.update(row, positions)
        # The next step starts from this row's positions with this row's sigma.
        sigma = None if self._sigma is None else self._sigma[row]
        base, extra = next_graph(self._file, positions, sigma, self._mobile)
        self._base_lines.set_segments(list(self._view.segments(positions, base)))
        self._extra_lines.set_segments(list(self._view.segments(positions, extra)))
        self._step.set_text(f"step {row + 1} of {self._steps}")
        lost = self._view.outside(positions)
        self._lost.set_text(f"{lost:,} out of sight" if lost else "")
        for cursor in self._cursors:
            cursor.set_xdata([row + 1, row + 1])

    def _speeds(self, initial: Floats, positions: Floats) -> NDArray[np.float64]:
        """``[K, N]`` speeds, length per time."""
        course = np.concatenate([initial[-1:], positions]).astype(np.float64)
        velocity = minimum_image(np.diff(course, axis=0), self._box) / self._file.metadata.dt
        speeds: NDArray[np.float64] = np.linalg.norm(velocity, axis=2)
        return speeds

    def _panel(self, left: float, title: str, colour: str) -> Axes:
        axes = self._figure.add_axes((left, 0.27, 0.465, 0.68), facecolor=PANEL)
        (x0, y0), (x1, y1) = self._view.lower, self._view.upper
        axes.set(xlim=(x0, x1), ylim=(y0, y1), xticks=[], yticks=[], aspect="equal")
        axes.spines[:].set_visible(False)
        axes.set_title(title, color=colour, fontsize=LARGE, loc="left")
        axes.add_collection(LineCollection(list(self._view.frame), colors=LINE, linewidths=1.0))
        return axes

    def _marker_area(self, panel: Axes) -> float:
        """Points² of a marker that leaves the edges between neighbours in sight: its diameter is
        a share of the radius, as far as it is neither too small nor too large to be seen well."""
        width = panel.get_position().width * WIDTH * POINTS_PER_INCH
        scale = width / float((self._view.upper - self._view.lower).max())
        return float(np.clip(MARKER * self._file.metadata.radius * scale, 1.6, 8.0)) ** 2

    def _text(self, axes: Axes, right: float, bottom: float) -> Text:
        """A text that changes, with its lower right corner at a place in units of ``axes``."""
        text = axes.text(
            right,
            bottom,
            "",
            color=TEXT,
            fontsize=SMALL,
            ha="right",
            transform=axes.transAxes,
            animated=True,
        )
        self._moving.append(text)
        return text

    def _front(self, axes: Axes) -> LineCollection:
        """The edges of the bounds that are in front of the particles."""
        lines = LineCollection(list(self._view.front), colors=LINE, linewidths=1.0, animated=True)
        axes.add_collection(lines)
        return lines

    def _lines(self, axes: Axes, colour: str, width: float) -> LineCollection:
        lines = LineCollection([], colors=colour, linewidths=width, animated=True)
        axes.add_collection(lines)
        self._moving.append(lines)
        return lines

    def _scale(self, panel: Axes, points: PathCollection, label: str) -> None:
        """A colour bar below ``panel``."""
        left, width = panel.get_position().x0, panel.get_position().width
        axes = self._figure.add_axes((left + 0.42 * width, 0.252, 0.56 * width, 0.011))
        bar = self._figure.colorbar(points, cax=axes, orientation="horizontal")
        bar.outline.set_visible(False)
        axes.tick_params(colors=TEXT, labelsize=SMALL, length=2, pad=2)
        if isinstance(points.norm, LogNorm):
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_locator(NullLocator())
        self._figure.text(
            left + 0.4 * width, 0.2575, label, color=TEXT, fontsize=SMALL, ha="right", va="center"
        )

    def _strip(self, left: float, title: str) -> Axes:
        axes = self._figure.add_axes((left, 0.05, 0.405, 0.115), facecolor=BACKGROUND)
        axes.set_xlim(1, max(2, self._steps))
        axes.set_title(title, color=TEXT, fontsize=SMALL, loc="left", pad=3)
        axes.tick_params(colors=TEXT, labelsize=SMALL, length=2)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["bottom", "left"]].set_color(LINE)
        return axes

    def _curve(self, axes: Axes, values: NDArray[np.generic], colour: str) -> None:
        axes.plot(np.arange(1, self._steps + 1), values, color=colour, linewidth=1.2)


class Cloud:
    """The particles in one panel, coloured by ``colours`` ``[K, N]``; kinematic ones are grey."""

    def __init__(
        self,
        axes: Axes,
        *,
        view: View,
        colours: Floats,
        mobile: NDArray[np.bool_],
        colour_map: Colormap,
        scale: Normalize,
        area: float,
    ) -> None:
        self._view, self._colours, self._mobile = view, colours, mobile
        self.points = axes.scatter(
            [], [], s=area, c=[], cmap=colour_map, norm=scale, linewidths=0, animated=True
        )

    def update(self, row: int, positions: Floats) -> None:
        """Show ``positions`` ``[N, d]`` in the colours of ``row``."""
        colours = self.points.to_rgba(self._colours[row])
        self._view.paint(
            self.points,
            positions,
            colours,
            self._mobile,
            kinematic=KINEMATIC,
            background=PANEL,
        )
