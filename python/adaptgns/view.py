"""Where particles appear in a picture, and how: 2D as it is, 3D from an elevated corner, where what
is nearer covers what is behind, and what is farther is paler."""

from __future__ import annotations

from itertools import product

import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgba
from numpy.typing import NDArray

from adaptgns.data.metadata import Metadata
from adaptgns.metrics import Floats
from adaptgns.periodic import minimum_image

AZIMUTH, ELEVATION = np.radians(-60.0), np.radians(22.0)
"""Of the camera, around the second axis, against which gravity acts, and above the other two"""
MARGIN = 0.02
"""Around the bounds, as a share of their longer side"""
FARTHEST = 0.6
"""What is left of a colour in the farthest corner"""
RIM, RIM_WIDTH = 0.5, 0.4
"""Share of a particle's light at its rim, by which neighbours are told apart in 3D, and the rim's
width in points"""


class View:
    """An orthographic projection of the domain of ``metadata``, with the second axis upwards."""

    def __init__(self, metadata: Metadata) -> None:
        self._box = metadata.box
        self._lower, self._upper = np.array(metadata.bounds, dtype=np.float64).T
        # Rows of _axes: what points right and up in the picture, and towards the viewer.
        if metadata.dim == 2:
            self._axes = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
        else:
            (sin_a, cos_a), (sin_e, cos_e) = ((np.sin(x), np.cos(x)) for x in (AZIMUTH, ELEVATION))
            self._axes = np.array(
                [
                    [-sin_a, 0.0, -cos_a],
                    [-sin_e * cos_a, cos_e, sin_e * sin_a],
                    [cos_e * cos_a, sin_e, -cos_e * sin_a],
                ]
            )
        self.solid = metadata.dim == 3
        """Whether there is depth"""
        corners = np.array(list(product(*zip(self._lower, self._upper, strict=True))))
        seen = corners @ self._axes.T
        flat, depth = seen[:, :2], seen[:, 2]
        self._far, self._near = depth.min(), depth.max()
        first, second = np.triu_indices(len(corners), 1)
        one_axis_apart = (corners[first] != corners[second]).sum(axis=1) == 1
        first, second = first[one_axis_apart], second[one_axis_apart]
        edges = np.stack([flat[first], flat[second]], axis=1)
        nearest = self.solid & (np.maximum(depth[first], depth[second]) == self._near)
        self.frame: NDArray[np.float64] = edges[~nearest]
        """``[lines, 2, 2]`` ends of those edges of the bounds that cover nothing"""
        self.front: NDArray[np.float64] = edges[nearest]
        """``[lines, 2, 2]`` ends of those in front of all particles: three in 3D, none in 2D"""
        margin = MARGIN * float(np.ptp(flat, axis=0).max())
        self.lower: NDArray[np.float64] = flat.min(axis=0) - margin
        """``[2]`` lower left corner of the picture"""
        self.upper: NDArray[np.float64] = flat.max(axis=0) + margin
        """``[2]`` upper right corner of the picture"""

    def points(self, positions: Floats) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Points ``[N, 2]`` in the picture, and the order ``[N]`` from the farthest to the
        nearest."""
        seen = self._wrapped(positions) @ self._axes.T
        return seen[:, :2], np.argsort(seen[:, 2], kind="stable")

    def paint(
        self,
        artist: PathCollection,
        positions: Floats,
        colours: NDArray[np.float64],
        mobile: NDArray[np.bool_],
        *,
        kinematic: str,
        background: str,
    ) -> None:
        """Let ``artist``, a scatter, show particles at ``positions`` ``[N, d]`` in ``colours``
        ``[N, 4]``, and those that are not ``mobile`` ``[N]`` in the colour ``kinematic``.

        In 2D these lie under the others. In 3D the nearest particle is on top, each has a rim, and
        colours fade towards the ``background`` with the distance.
        """
        beneath = np.argsort(mobile, kind="stable")
        points, order = self.points(positions[beneath])
        drawn = beneath[order]
        faces = np.where(mobile[drawn, None], colours[drawn], to_rgba(kinematic))
        if self.solid:
            depth = self._wrapped(positions[drawn]) @ self._axes[2]
            near = np.clip((depth - self._far) / (self._near - self._far), 0, 1)
            faces = faded(faces, near[:, None], background)
            artist.set_edgecolor(faces * [RIM, RIM, RIM, 1])  # type: ignore[arg-type]
            artist.set_linewidth(RIM_WIDTH)
        artist.set_array(None)  # The colours are as given.
        artist.set_facecolor(faces)  # type: ignore[arg-type]
        artist.set_offsets(points[order])

    def outside(self, positions: Floats) -> int:
        """How many of ``positions`` ``[N, d]`` the picture does not show."""
        seen = self._wrapped(positions) @ self._axes[:2].T
        return int(((seen < self.lower) | (seen > self.upper)).any(axis=1).sum())

    def segments(self, positions: Floats, pairs: NDArray[np.int64]) -> NDArray[np.float64]:
        """``[lines, 2, 2]`` ends of the edges ``pairs`` ``[2, E]``, each drawn once.

        Those that run through a periodic boundary are left out: they would cross the picture.
        """
        wrapped = self._wrapped(positions)
        first, second = pairs[:, pairs[0] < pairs[1]]
        across = wrapped[second] - wrapped[first]
        direct = np.isclose(across, minimum_image(across, self._box)).all(axis=1)
        flat = wrapped @ self._axes[:2].T
        return np.stack([flat[first[direct]], flat[second[direct]]], axis=1)

    def _wrapped(self, positions: Floats) -> NDArray[np.float64]:
        """``positions`` inside the bounds along periodic axes."""
        inside = positions.astype(np.float64)
        if self._box is not None:
            for axis in np.flatnonzero(np.isfinite(self._box) & (self._box > 0)):
                inside[:, axis] = self._lower[axis] + np.mod(
                    inside[:, axis] - self._lower[axis], self._box[axis]
                )
        return inside


def faded(
    colours: NDArray[np.float64], near: NDArray[np.float64], background: str
) -> NDArray[np.float64]:
    """``colours`` ``[..., 4]`` in front of ``background``, where ``near`` is 0 in the farthest
    corner of the bounds, and 1 in the nearest."""
    away = np.array(to_rgba(background))
    seen: NDArray[np.float64] = away + (colours - away) * (FARTHEST + (1 - FARTHEST) * near)
    return seen
