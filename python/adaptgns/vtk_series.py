"""A rollout as series of VTK files, which ParaView and other viewers open.

Three series: ``truth`` and ``prediction`` hold a point a particle, ``graph`` the predicted
positions with a line an edge. Frame 0 is the last true one that the rollout starts from, frame k
the result of step k; its time is k·dt. Positions in 2D get z = 0.

Fields of the points: ``velocity`` (length per time), ``speed``, ``particle_type``; of the
prediction also ``error``, the distance to the truth, and ``sigma`` (normalized; NaN in frame 0,
which nothing predicted). Fields of the lines: ``extra``, 1 for those beyond the base radius, and
``length``. The graph is that of the step which starts from the frame, under other policies than
``fixed`` and ``adaptive`` the base graph. Lines that run through a periodic boundary are left out:
they would cross the picture.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptgns.atomic import replace_text, written_whole
from adaptgns.metrics import Floats
from adaptgns.next_graph import next_graph
from adaptgns.periodic import minimum_image
from adaptgns.rollout_file import Rollout, RolloutFile

SERIES = ("truth", "prediction", "graph")


def write_series(file: RolloutFile, rollout: Rollout, folder: Path, every: int = 1) -> None:
    """Write the series of ``rollout`` of ``file`` into ``folder``, every ``every``-th frame and the
    last. The indices, ``truth.pvd`` and the like, are written when all their frames are there.

    ValueError for ``every`` below 1, a folder that holds series already, and a prediction that is
    not finite; ImportError without meshio.
    """
    if every < 1:
        raise ValueError(f"every: got {every}; accepted is 1 or more")
    if any((folder / f"{name}.pvd").exists() for name in SERIES):
        raise ValueError(f"{folder}: holds series already; remove it or name another")
    meshio = _meshio()
    frames = Frames(file, rollout)
    shown = sorted({*range(0, rollout.steps + 1, every), rollout.steps})
    for frame in shown:
        for name, mesh in zip(SERIES, frames.meshes(meshio, frame), strict=True):
            with written_whole(folder / name / f"{frame:05d}.vtu") as partial:
                mesh.write(partial, file_format="vtu")
    for name in SERIES:
        replace_text(folder / f"{name}.pvd", _index(name, shown, file.metadata.dt))


class Frames:
    """Frames 0 … K of one rollout as meshes."""

    def __init__(self, file: RolloutFile, rollout: Rollout) -> None:
        self._file = file
        self._types = rollout.particle_type
        self._mobile = file.metadata.mobile(rollout.particle_type)
        self._sigma = rollout.sigma
        # Row k + 1 is frame k: the first velocity needs the frame before.
        start = rollout.initial[-2:]
        self._true = np.concatenate([start, rollout.true])
        self._predicted = np.concatenate([start, rollout.predicted])
        wrong = np.flatnonzero(~np.isfinite(self._predicted).all(axis=(1, 2)))
        if wrong.size:
            raise ValueError(
                f"rollout: the prediction of trajectory {rollout.name} in {file.path} holds "
                f"positions that are not finite from step {wrong[0] - 1} on, which VTK can't show"
            )

    def meshes(self, meshio: ModuleType, frame: int) -> tuple[Any, Any, Any]:
        """Truth, prediction and graph."""
        true, predicted = self._true[frame + 1], self._predicted[frame + 1]
        sigma = None if self._sigma is None or frame == 0 else self._sigma[frame - 1]
        error = minimum_image(predicted - true.astype(np.float64), self._file.metadata.box)
        of_prediction = {"error": np.linalg.norm(error, axis=1)}
        if self._sigma is not None:
            nothing = np.full(len(true), np.nan, dtype=np.float32)
            of_prediction["sigma"] = nothing if sigma is None else sigma
        vertices = [("vertex", np.arange(len(true))[:, None])]
        predicted_fields = self._fields(self._predicted, frame) | of_prediction
        pairs, of_lines = self._lines(predicted, sigma)
        return (
            meshio.Mesh(_spatial(true), vertices, point_data=self._fields(self._true, frame)),
            meshio.Mesh(_spatial(predicted), vertices, point_data=predicted_fields),
            meshio.Mesh(
                _spatial(predicted),
                [("line", pairs)],
                point_data=predicted_fields,
                cell_data={name: [values] for name, values in of_lines.items()},
            ),
        )

    def _fields(self, course: NDArray[np.float32], frame: int) -> dict[str, NDArray[Any]]:
        moved = course[frame + 1].astype(np.float64) - course[frame]
        velocity = minimum_image(moved, self._file.metadata.box) / self._file.metadata.dt
        return {
            "velocity": _spatial(velocity),
            "speed": np.linalg.norm(velocity, axis=1),
            "particle_type": self._types,
        }

    def _lines(
        self, positions: NDArray[np.float32], sigma: NDArray[np.float32] | None
    ) -> tuple[NDArray[np.int64], dict[str, NDArray[Any]]]:
        """``[E, 2]`` ends of the lines, each pair once, and their fields ``[E]``."""
        base, extra = next_graph(self._file, positions, sigma, self._mobile)
        pairs = np.concatenate([base, extra], axis=1)
        beyond = np.arange(pairs.shape[1]) >= base.shape[1]
        across = positions[pairs[0]].astype(np.float64) - positions[pairs[1]]
        direct = np.isclose(across, minimum_image(across, self._file.metadata.box)).all(axis=1)
        shown = direct & (pairs[0] < pairs[1])
        length = np.linalg.norm(across[shown], axis=1)
        return pairs[:, shown].T, {"extra": beyond[shown].astype(np.int8), "length": length}


def _meshio() -> ModuleType:
    try:
        # Optional: nothing else needs it.
        import meshio  # noqa: PLC0415
    except ImportError:
        raise ImportError(
            "VTK files are written with meshio, which is not installed: "
            "pip install 'adaptgns[formats]'"
        ) from None
    module: ModuleType = meshio
    return module


def _spatial(vectors: Floats) -> NDArray[Any]:
    """``[N, 3]`` of ``[N, d]``."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


def _index(name: str, frames: list[int], dt: float) -> str:
    """A ParaView collection: the file of each time."""
    lines = [
        f'    <DataSet timestep="{frame * dt!r}" file="{name}/{frame:05d}.vtu"/>'
        for frame in frames
    ]
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="Collection" version="1.0">',
            "  <Collection>",
            *lines,
            "  </Collection>",
            "</VTKFile>",
            "",
        ]
    )
