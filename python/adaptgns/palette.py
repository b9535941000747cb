"""The colours of every picture that is made here, in one place.

Colour maps are perceptually uniform: their order survives a print in grey.
"""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, ListedColormap

BACKGROUND, PANEL, LINE, TEXT = "#0a0d13", "#0f131b", "#2b3444", "#aab4c3"
TRUE, PREDICTED, BASE_EDGE, EXTRA_EDGE, KINEMATIC = (
    "#57b8cc",
    "#f0a35e",
    "#52627d",
    "#5cf0ba",
    "#566072",
)
SERIES = ("#10203f", "#b5482a", "#2f8f9d", "#d9a441", "#6b4f9e", "#7f8c9b")
"""Curves on paper, one a run; neighbours differ in lightness"""
TYPES = (
    "#8fb8ff",
    "#f7e08a",
    "#a3542f",
    "#566072",
    "#ff9fb2",
    "#57b8cc",
    "#d8c6ff",
    "#5cf0ba",
    "#7a5fb0",
)
"""Particle types 0 … 8 of geoelements/gns: 3 is a boundary, 5 water, 6 sand, 7 goop"""


def _visible(name: str) -> Colormap:
    """A perceptually uniform map less its darkest part, which would vanish in the background."""
    return ListedColormap(colormaps[name](np.linspace(0.2, 1.0, 256)), name)


SPEED_MAP, SIGMA_MAP, ERROR_MAP = _visible("viridis"), _visible("inferno"), _visible("plasma")
