"""The scenes that the embedded solver draws, and what is fixed about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

SceneName = Literal["waterdrop", "sand"]


@dataclass(frozen=True)
class Scene:
    """What every trajectory of a scene has in common.

    Attributes:
        frames: length of the published set's trajectories.
        dt: seconds between frames.
        low, high: the walls, on every axis, in metres.
        radius: connectivity radius, in metres.
    """

    frames: int
    dt: float = 0.0025
    low: float = 0.1
    high: float = 0.9
    radius: float = 0.015


SCENES: dict[SceneName, Scene] = {
    "waterdrop": Scene(frames=1000),
    "sand": Scene(frames=320),
}
