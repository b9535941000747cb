"""Whole trajectories kept in memory, the most recently used ones, up to a number of bytes."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from adaptgns.data.trajectory import Trajectory

CACHE_BYTES = 1 << 30
"""Per process and split. Every public GNS set but the largest fits whole."""


class TrajectoryCache:
    """Drops the least recently used once positions exceed `limit` bytes. For one thread."""

    def __init__(self, load: Callable[[int], Trajectory], limit: int = CACHE_BYTES) -> None:
        self._load = load
        self._limit = limit
        self._held: OrderedDict[int, Trajectory] = OrderedDict()
        self._bytes = 0

    def __getitem__(self, index: int) -> Trajectory:
        if index in self._held:
            self._held.move_to_end(index)
            return self._held[index]
        trajectory = self._load(index)
        self._held[index] = trajectory
        self._bytes += trajectory.positions.nbytes
        while self._bytes > self._limit and len(self._held) > 1:
            _, oldest = self._held.popitem(last=False)
            self._bytes -= oldest.positions.nbytes
        return trajectory
