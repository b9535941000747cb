"""The scenes that the embedded solver draws, and what is fixed about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

SceneName = Literal[
    "waterdrop", "sand", "goop", "jelly", "multimaterial", "waterramps", "stirrer", "vortices"
]


@dataclass(frozen=True)
class Scene:
    """What every trajectory of a scene has in common.

    Attributes:
        frames: length of the published set's trajectories, or one that shows the scene come to
            rest where there is no such set.
        dt: seconds between frames.
        low, high: the walls, on every axis, in metres.
        periodic: whether the walls are one and the same place.
        radii: connectivity radius in two and in three dimensions, in metres.
    """

    frames: int
    dt: float = 0.0025
    low: float = 0.1
    high: float = 0.9
    periodic: bool = False
    radii: tuple[float, float] = (0.015, 0.035)


SCENES: dict[SceneName, Scene] = {
    "waterdrop": Scene(frames=1000),
    "sand": Scene(frames=320),
    "goop": Scene(frames=400),
    "jelly": Scene(frames=400),
    "multimaterial": Scene(frames=1000),
    "waterramps": Scene(frames=600),
    "stirrer": Scene(frames=600),
    "vortices": Scene(frames=400, periodic=True, radii=(0.024, 0.058)),
}
