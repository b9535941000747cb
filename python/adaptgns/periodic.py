"""Differences of positions in periodic boxes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def minimum_image(
    difference: NDArray[np.floating[Any]], box: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """``difference`` ``[..., d]`` of positions, to the nearest image, float64.

    ``box`` ``[d]`` holds the period lengths, inf (or 0) along open axes; None: all axes are open.
    """
    exact = np.asarray(difference, dtype=np.float64)
    if box is None:
        return exact
    periodic = np.isfinite(box) & (box > 0)
    periods = np.where(periodic, box, 0.0)
    return exact - periods * np.round(exact / np.where(periodic, box, 1.0))
