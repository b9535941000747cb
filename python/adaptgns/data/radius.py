"""How many neighbours a radius gives, and which radius to take.

Rule of thumb: the radius at which a particle has 6 neighbours on average in 2D, 18 in 3D. The
published GNS sets lie there (WaterDrop 5.4, Sand 6.8 at r = 0.015), and so does a lattice cut at
about 1.45 spacings, the usual choice for SPH data: 8 in 2D and 18 in 3D inside the material,
fewer at its surface.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from adaptgns._core import radius_graph
from adaptgns.periodic import minimum_image

if TYPE_CHECKING:
    from collections.abc import Sequence

_SAMPLED = 256
"""Particles of a frame that a radius to begin with is taken from."""

NEIGHBOURS = {2: 6.0, 3: 18.0}
"""The mean degree to aim at, by dimension."""


class DegreeCurve:
    """Mean degree against radius, over several frames of particles.

    Built from the sorted distances of all pairs up to a radius that gives somewhat more than the
    degree aimed at; the degree at any smaller radius is then a count.
    """

    def __init__(
        self,
        frames: Sequence[npt.NDArray[np.float32]],
        radius: float,
        box: npt.NDArray[np.float64] | None,
    ) -> None:
        """Args:
        frames: positions `[N, d]` of one or more graphs.
        radius: one that covers all pairs of interest at least; grown as needed.
        box: period lengths, `inf` on open axes; None when nothing is periodic.
        """
        self._nodes = sum(len(positions) for positions in frames)
        self._target = NEIGHBOURS[frames[0].shape[1]]
        possible = sum(len(positions) * (len(positions) - 1) for positions in frames)
        self._wanted = int(np.ceil(self._target * self._nodes))
        self._reachable = self._wanted <= possible
        while True:
            self._distances = np.sort(
                np.concatenate([_distances(positions, radius, box) for positions in frames])
            )
            if len(self._distances) >= min(self._wanted, possible):
                break
            radius *= 1.5

    def degree(self, radius: float) -> float:
        """Mean degree at a radius no larger than the one given at first."""
        return float(np.searchsorted(self._distances, radius, side="right") / self._nodes)

    def advice(self) -> float | None:
        """The radius with the mean degree aimed at; None with too few particles for it."""
        return float(self._distances[self._wanted - 1]) if self._reachable else None


def advise_radius(
    frames: Sequence[npt.NDArray[np.float32]], box: npt.NDArray[np.float64] | None
) -> float | None:
    """The radius with the mean degree aimed at over `frames` `[N, d]`; None with too few particles
    for it, or none of them apart."""
    # Begin where half of a few particles have as many: strays and gaps do not matter.
    reaches = []
    for positions in frames:
        wanted = min(int(NEIGHBOURS[positions.shape[1]]) + 1, len(positions))
        some = positions[:: -(-len(positions) // _SAMPLED)]
        reaches.append(np.atleast_2d(cKDTree(positions).query(some, [wanted])[0]).ravel())
    begin = float(np.median(np.concatenate(reaches)))
    return DegreeCurve(frames, begin, box).advice() if begin > 0 else None


def _distances(
    positions: npt.NDArray[np.float32], radius: float, box: npt.NDArray[np.float64] | None
) -> npt.NDArray[np.float64]:
    sender, receiver = radius_graph(positions, radius, box=box)
    exact = positions.astype(np.float64)
    displacement = minimum_image(exact[sender] - exact[receiver], box)
    distances: npt.NDArray[np.float64] = np.linalg.norm(displacement, axis=1)
    return distances
