"""Where particles appear in a picture: 2D as it is, 3D from an elevated corner."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from adaptgns.data.metadata import Metadata
from adaptgns.metrics import Floats
from adaptgns.periodic import minimum_image

AZIMUTH, ELEVATION = np.radians(-60.0), np.radians(22.0)
"""Of the camera, around the second axis, against which gravity acts, and above the other two"""
MARGIN = 0.02
"""Around the bounds, as a share of their longer side"""


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
        corners = np.array(list(product(*zip(self._lower, self._upper, strict=True))))
        flat = corners @ self._axes[:2].T
        first, second = np.triu_indices(len(corners), 1)
        one_axis_apart = (corners[first] != corners[second]).sum(axis=1) == 1
        self.frame: NDArray[np.float64] = np.stack([flat[first], flat[second]], axis=1)[
            one_axis_apart
        ]
        """``[lines, 2, 2]`` ends of the edges of the bounds"""
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
