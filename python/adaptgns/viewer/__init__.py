"""A rollout as one HTML file that plays in any browser, with no network and no server.

The page is ``viewer.html`` with its style and scripts beside it; this module fills in the data:
frames 0 … K, of which frame 0 is the last true one that the rollout starts from and frame k the
result of step k.
"""

from __future__ import annotations

import html
import json
import math
from base64 import b64encode
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptgns import palette
from adaptgns.atomic import replace_text
from adaptgns.data.metadata import GNS_KINEMATIC
from adaptgns.metrics import Floats, position_mse
from adaptgns.periodic import minimum_image
from adaptgns.rollout_file import Rollout, RolloutFile
from adaptgns.viewer.encoding import OUTSIDE, Range, encoded, quantized

LIMIT = 60_000_000
"""Bytes of the file; frames are thinned until it is below, and the page says so"""
MARGIN = 0.02
"""Around the bounds along open axes, as a share of their length"""
CLIPPED = (1.0, 99.5)
"""Percentiles that the colour scales end at"""
SCRIPTS = ("data.js", "graph.js", "scene.js", "curves.js", "viewer.js")
TYPE_NAMES = {3: "boundary", 5: "water", 6: "sand", 7: "goop"}
"""Of the data of geoelements/gns"""


def write_viewer(file: RolloutFile, rollout: Rollout, path: Path) -> None:
    """Write the page of ``rollout`` of ``file`` to ``path``, whole or not at all.

    ValueError for a path that is not called .html, or a trajectory that predicts nothing.
    """
    if path.suffix.lower() != ".html":
        raise ValueError(f"out: got {path}; a file called .html is accepted")
    if not file.metadata.mobile(rollout.particle_type).any():
        raise ValueError(
            f"rollout: trajectory {rollout.name} of {file.path} has kinematic particles only; "
            "nothing in it is predicted"
        )
    every = 1
    while len(page := _page(file, rollout, every)) > LIMIT and every < rollout.steps:
        every = math.ceil(every * len(page) / LIMIT)
    replace_text(path, page)


def _page(file: RolloutFile, rollout: Rollout, every: int) -> str:
    """The page with every ``every``-th frame and the last one."""
    with np.errstate(invalid="ignore"):  # of a prediction that diverged to infinity
        scene, tensors = _content(file, rollout, every)
    folder = files("adaptgns.viewer")
    text = {
        name: folder.joinpath(name).read_text("utf-8") for name in ("viewer.html", "viewer.css")
    }
    script = "\n".join(folder.joinpath(name).read_text("utf-8") for name in SCRIPTS)
    data = [_block("scene", json.dumps(scene, allow_nan=False).encode())]
    data += [_block(name, content) for name, content in tensors.items()]
    filled = {
        "{{title}}": html.escape(f"{scene['label']}, {scene['policy']}: {scene['name']}"),
        "{{style}}": text["viewer.css"],
        "{{script}}": script,
        "{{data}}": "\n".join(data),
    }
    page = text["viewer.html"]
    for mark, content in filled.items():
        before, after = page.split(mark)
        page = before + content + after
    return page


def _block(name: str, content: bytes) -> str:
    """Data in the page; base64 holds nothing that could end the element."""
    return f'<script type="text/plain" id="data-{name}">{b64encode(content).decode()}</script>'


def _content(
    file: RolloutFile, rollout: Rollout, every: int
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """What the page knows of the rollout as JSON, and its tensors."""
    metadata, sigma = file.metadata, rollout.sigma
    mobile = metadata.mobile(rollout.particle_type)
    start = rollout.initial[-1:]
    true, predicted = (np.concatenate([start, x]) for x in (rollout.true, rollout.predicted))
    shown = np.unique([*range(0, rollout.steps + 1, every), rollout.steps])
    bounds = np.array(metadata.bounds, dtype=np.float64)
    margin = np.where(metadata.periodic, 0.0, MARGIN * np.ptp(bounds, axis=1))
    lower, upper = bounds[:, 0] - margin, bounds[:, 1] + margin
    mse = position_mse(rollout.predicted, rollout.true, mobile, metadata.box)
    tensors = {
        name: encoded(_positions(x[shown], lower, upper, metadata.periodic), order=2)
        for name, x in (("true", true), ("predicted", predicted))
    }
    scales: dict[str, Any] = {
        "speed": [0.0, _fast(true, mobile, metadata.box, metadata.dt)],
        "error": _decades(_distance(predicted[1:], true[1:], metadata.box)[:, mobile]),
    }
    logarithm = None
    if sigma is not None:
        finite = np.log(np.maximum(sigma, np.finfo(np.float32).tiny), dtype=np.float64)
        known = np.isfinite(finite)
        finite = np.where(known, finite, finite[known].max() if known.any() else 0.0)
        # Frame 0 has no sigma yet; it repeats the first one and is never looked at.
        finite = np.concatenate([finite[:1], finite])[shown]
        logarithm = Range(finite.min(), max(finite.max(), finite.min() + 1e-6))
        tensors["sigma"] = encoded(quantized(finite, logarithm), order=1)
        scales["sigma"] = _decades(sigma[:, mobile])
    adaptive = file.policy == "adaptive" and sigma is not None
    scene = {
        "label": file.label,
        "policy": file.policy,
        "name": rollout.name,
        "particles": len(mobile),
        "dim": metadata.dim,
        "dt": metadata.dt,
        "frames": shown.tolist(),
        "every": every,
        "bounds": bounds.tolist(),
        "periodic": list(metadata.periodic),
        "lower": lower.tolist(),
        "upper": upper.tolist(),
        "radius": file.graph_radius,
        "adaptive": {"tau": file.tau, "factor": file.factor} if adaptive else None,
        "mobile": mobile.astype(int).tolist(),
        "types": rollout.particle_type.tolist(),
        "type_names": TYPE_NAMES if metadata.kinematic_types == GNS_KINEMATIC else {},
        "log_sigma": None
        if logarithm is None
        else [float(logarithm.lower), float(logarithm.upper)],
        "scales": scales,
        "edges": rollout.edges.tolist(),
        "mse": [value if np.isfinite(value) else None for value in mse.tolist()],
        "palette": _palette(),
    }
    return scene, tensors


def _positions(
    positions: Floats,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    periodic: tuple[bool, ...],
) -> NDArray[np.uint16]:
    """``[F, N, d]`` codes; those of a particle out of the range, or nowhere, are OUTSIDE."""
    inside = positions.astype(np.float64)
    for axis in np.flatnonzero(periodic):
        period = upper[axis] - lower[axis]
        inside[..., axis] = lower[axis] + np.mod(inside[..., axis] - lower[axis], period)
    seen = np.all((inside >= lower) & (inside <= upper), axis=2)
    codes = quantized(np.where(seen[..., None], inside, lower), Range(lower, upper))
    codes[~seen] = OUTSIDE
    return codes


def _distance(a: Floats, b: Floats, box: NDArray[np.float64] | None) -> NDArray[np.float64]:
    difference: NDArray[np.float64] = np.linalg.norm(
        minimum_image(a.astype(np.float64) - b, box), axis=-1
    )
    return difference


def _fast(
    true: Floats, mobile: NDArray[np.bool_], box: NDArray[np.float64] | None, dt: float
) -> float:
    """The speed that the scale of speeds ends at, length per time."""
    speed = _distance(true[1:, mobile], true[:-1, mobile], box) / dt
    fast = float(np.percentile(speed, CLIPPED[1])) if speed.size else 0.0
    return fast if fast > 0 else 1.0


def _decades(values: Floats) -> list[float]:
    """Ends of a logarithmic scale of ``values``; at most four decades below its upper end."""
    seen = values[np.isfinite(values) & (values > 0)]
    low, high = np.percentile(seen, CLIPPED) if seen.size else (1e-4, 1.0)
    return [float(max(low, 1e-4 * high)), float(max(high, 1.01 * low))]


def _palette() -> dict[str, Any]:
    maps = {"speed": palette.SPEED_MAP, "sigma": palette.SIGMA_MAP, "error": palette.ERROR_MAP}
    ramp = np.linspace(0.0, 1.0, 256)
    return {
        "background": palette.BACKGROUND,
        "panel": palette.PANEL,
        "line": palette.LINE,
        "text": palette.TEXT,
        "true": palette.TRUE,
        "predicted": palette.PREDICTED,
        "base": palette.BASE_EDGE,
        "extra": palette.EXTRA_EDGE,
        "kinematic": palette.KINEMATIC,
        "types": list(palette.TYPES),
        "maps": {name: m(ramp, bytes=True)[:, :3].ravel().tolist() for name, m in maps.items()},
    }
