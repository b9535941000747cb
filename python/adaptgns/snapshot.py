"""One picture of a rollout: the truth above, the prediction below, at a few moments."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, to_rgba
from matplotlib.figure import Figure
from numpy.typing import NDArray

from adaptgns.data.metadata import Metadata
from adaptgns.metrics import Floats
from adaptgns.palette import (
    BACKGROUND,
    KINEMATIC,
    LINE,
    PANEL,
    PREDICTED,
    SIGMA_MAP,
    TEXT,
    TRUE,
)
from adaptgns.view import View

MOMENTS = 4
SIDE, DPI = 2.2, 100
"""Inches of a panel, and pixels per inch"""
AREA = 3.0
"""Points² of a particle"""
SMALL, LARGE = 8, 9
"""Points of the type"""


def snapshot(
    metadata: Metadata,
    true: Floats,
    predicted: Floats,
    sigma: Floats | None,
    mobile: NDArray[np.bool_],
) -> NDArray[np.uint8]:
    """``[height, width, 3]`` of ``true`` and ``predicted`` ``[K, N, d]``, after up to four steps
    evenly apart, the last among them.

    The prediction is coloured by ``sigma`` ``[K, N]``, on one logarithmic scale, where there is
    one; particles that are not ``mobile`` ``[N]`` are grey. A position that is not finite is left
    out, and counted together with those out of sight.
    """
    view, steps = View(metadata), len(predicted)
    rows = sorted({round(steps * (k + 1) / MOMENTS) - 1 for k in range(MOMENTS)} - {-1})
    figure = Figure(
        figsize=(SIDE * len(rows), 2 * SIDE + 0.4),
        dpi=DPI,
        facecolor=BACKGROUND,
        layout="constrained",
    )
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(rows), squeeze=False)
    seen = np.empty(0) if sigma is None else sigma[rows][:, mobile]
    seen = seen[np.isfinite(seen) & (seen > 0)]
    scale = LogNorm(seen.min(), 1.01 * seen.max()) if seen.size else None
    for column, row in enumerate(rows):
        for axes, course in zip(panels[:, column], (true, predicted), strict=True):
            (x0, y0), (x1, y1) = view.lower, view.upper
            axes.set(xlim=(x0, x1), ylim=(y0, y1), xticks=[], yticks=[], aspect="equal")
            axes.set_facecolor(PANEL)
            axes.spines[:].set_color(LINE)
            if view.solid:
                axes.add_collection(
                    LineCollection(list(view.frame), colors=LINE, linewidths=0.8, zorder=0)
                )
                axes.add_collection(LineCollection(list(view.front), colors=LINE, linewidths=0.8))
            finite = np.flatnonzero(np.isfinite(course[row]).all(axis=1))
            if course is predicted and sigma is not None and scale is not None:
                colours = SIGMA_MAP(scale(sigma[row, finite]))
            else:
                colour = to_rgba(PREDICTED if course is predicted else TRUE)
                colours = np.tile(colour, (len(finite), 1))
            view.paint(
                axes.scatter([], [], s=AREA, linewidths=0),
                course[row, finite],
                colours,
                mobile[finite],
                kinematic=KINEMATIC,
                background=PANEL,
            )
            lost = len(mobile) - len(finite) + view.outside(course[row, finite])
            if lost:
                axes.set_xlabel(f"{lost:,} out of sight", color=TEXT, fontsize=SMALL)
        panels[0, column].set_title(f"step {row + 1}", color=TEXT, fontsize=LARGE)
    panels[0, 0].set_ylabel("truth", color=TRUE)
    by_sigma = "" if scale is None else f", σ {scale.vmin:.2g} (dark) – {scale.vmax:.2g}"
    panels[1, 0].set_ylabel(f"prediction{by_sigma}", color=PREDICTED)
    canvas.draw()  # type: ignore[no-untyped-call]
    drawn = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    picture: NDArray[np.uint8] = drawn[..., :3].copy()
    return picture
