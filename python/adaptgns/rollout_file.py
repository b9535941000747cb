"""The HDF5 file of rollouts: what is in it, its writer and its reader.

One file holds the rollouts of one checkpoint under one policy over one split. The root has the
attributes ``format``, ``version``, ``metadata`` (JSON of :class:`Metadata`) and ``settings`` (JSON
of what was run, see :class:`RolloutFile`). Each trajectory is a group ``00000``, ``00001``, … with
the attribute ``name`` and the tensors of :data:`CATALOGUE`; those with a sigma or a variance are
absent for a model without a variance head, ``one_step`` where no single steps were taken.

Letters of the shapes: H frames that the rollout starts from, K predicted steps, N particles,
d dimensions, M single steps from true positions. Step k, the k-th predicted frame, is row k - 1 and
frame H + k - 1 of the trajectory. Edges are directed and without self-edges. Normalized units are
those of the network's output: accelerations per frame² divided by their (noise-widened) std.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import h5py
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from adaptgns.atomic import written_whole
from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectory import INPUT_FRAMES, Trajectory

FORMAT = "adaptgns-rollout"
VERSION = 1
CHUNK_BYTES = 1 << 18
"""About the size of the pieces in which a tensor grows"""


@dataclass(frozen=True)
class Tensor:
    """A dataset of a trajectory's group."""

    shape: str
    dtype: DTypeLike
    unit: str


CATALOGUE: Mapping[str, Tensor] = {
    "initial": Tensor("H N d", np.float32, "length"),
    "predicted": Tensor("K N d", np.float32, "length"),
    "true": Tensor("K N d", np.float32, "length"),
    "particle_type": Tensor("N", np.int64, "1"),
    "sigma": Tensor("K N", np.float32, "normalized"),
    "edges": Tensor("K", np.int64, "1"),
    "graph_ms": Tensor("K", np.float32, "ms"),
    "model_ms": Tensor("K", np.float32, "ms"),
    "one_step/frame": Tensor("M", np.int64, "frame of the trajectory"),
    "one_step/squared_error": Tensor("M N", np.float32, "normalized²"),
    "one_step/variance": Tensor("M N", np.float32, "normalized²"),
}


class RolloutFileError(ValueError):
    """A file that is no whole rollout file of this version."""


class StepRecord(Protocol):
    """What is kept of one step."""

    @property
    def positions(self) -> NDArray[np.float32]:
        """``[N, d]`` predicted"""

    @property
    def sigma(self) -> NDArray[np.float32] | None:
        """``[N]`` predicted standard deviation, normalized units; None without a variance head"""

    @property
    def squared_error(self) -> NDArray[np.float32]:
        """``[N]`` of the acceleration, summed over dimensions, normalized units"""

    @property
    def edges(self) -> int:
        """Number of directed edges without self-edges"""

    @property
    def graph_ms(self) -> float:
        """Milliseconds that the graph took"""

    @property
    def model_ms(self) -> float:
        """Milliseconds that the network and the integration took"""


class RolloutWriter:
    """Writes a rollout file trajectory by trajectory; use it in a ``with`` statement.

    The file appears under ``path`` when the block ends without an exception, and not before.
    Memory stays that of one step, however long the rollouts are.
    """

    def __init__(self, path: Path, *, metadata: Metadata, settings: Mapping[str, Any]) -> None:
        self._path = path
        self._attributes = {
            "format": FORMAT,
            "version": VERSION,
            "metadata": json.dumps(metadata.to_json()),
            "settings": json.dumps(settings),
        }
        self._stack = ExitStack()
        self._count = 0

    def __enter__(self) -> RolloutWriter:
        with ExitStack() as stack:
            partial = stack.enter_context(written_whole(self._path))
            self._file: h5py.File = stack.enter_context(h5py.File(partial, "w"))
            self._file.attrs.update(self._attributes)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool | None:
        return self._stack.__exit__(kind, error, traceback)

    def add(
        self,
        trajectory: Trajectory,
        steps: Iterable[StepRecord],
        one_step: Iterable[tuple[int, StepRecord]] = (),
    ) -> None:
        """Append the rollout of ``trajectory``: one step after another from its first frames.

        ``one_step`` are single steps from the true positions, each with the frame of
        ``trajectory`` that it predicts; only their errors and variances are kept.
        """
        group = self._file.create_group(f"{self._count:05d}")
        group.attrs["name"] = trajectory.name
        _create(group, "initial", trajectory.positions[:INPUT_FRAMES])
        _create(group, "particle_type", trajectory.particle_type)
        count = 0
        for step in steps:
            count += 1
            _append(group, "predicted", step.positions)
            _append(group, "edges", step.edges)
            _append(group, "graph_ms", step.graph_ms)
            _append(group, "model_ms", step.model_ms)
            if step.sigma is not None:
                _append(group, "sigma", step.sigma)
        if count == 0:
            raise ValueError(
                f"steps: got none for trajectory {trajectory.name}; expected 1 or more"
            )
        _create(group, "true", trajectory.positions[INPUT_FRAMES : INPUT_FRAMES + count])
        for frame, step in one_step:
            _append(group, "one_step/frame", frame)
            _append(group, "one_step/squared_error", step.squared_error)
            if step.sigma is not None:
                _append(group, "one_step/variance", np.square(step.sigma))
        _check(group)
        self._count += 1


@dataclass(frozen=True)
class Rollout:
    """One trajectory of a rollout file; each property reads its tensor anew."""

    group: h5py.Group

    @property
    def name(self) -> str:
        """The trajectory's name in its data set."""
        return str(self.group.attrs["name"])

    @property
    def steps(self) -> int:
        """K, the number of predicted frames."""
        return int(self.group["predicted"].shape[0])

    @property
    def initial(self) -> NDArray[np.float32]:
        """``[H, N, d]`` true positions that the rollout starts from."""
        return self._read("initial")

    @property
    def predicted(self) -> NDArray[np.float32]:
        """``[K, N, d]`` predicted positions."""
        return self._read("predicted")

    @property
    def true(self) -> NDArray[np.float32]:
        """``[K, N, d]`` true positions."""
        return self._read("true")

    @property
    def particle_type(self) -> NDArray[np.int64]:
        """``[N]`` types."""
        return self._read("particle_type")

    @property
    def sigma(self) -> NDArray[np.float32] | None:
        """``[K, N]`` predicted standard deviations, normalized units; None without a variance."""
        return self._read("sigma") if "sigma" in self.group else None

    @property
    def edges(self) -> NDArray[np.int64]:
        """``[K]`` edges of the graph that each step was predicted on."""
        return self._read("edges")

    @property
    def graph_ms(self) -> NDArray[np.float32]:
        """``[K]`` milliseconds that the graph took."""
        return self._read("graph_ms")

    @property
    def model_ms(self) -> NDArray[np.float32]:
        """``[K]`` milliseconds that the network and the integration took."""
        return self._read("model_ms")

    @property
    def one_step(self) -> OneStep | None:
        """Single steps from the true positions, where the file has them."""
        if "one_step" not in self.group:
            return None
        variance = "one_step/variance"
        return OneStep(
            frame=self._read("one_step/frame"),
            squared_error=self._read("one_step/squared_error"),
            variance=self._read(variance) if variance in self.group else None,
        )

    def _read(self, name: str) -> NDArray[Any]:
        values: NDArray[Any] = self.group[name][()]
        return values


@dataclass(frozen=True)
class OneStep:
    """Single steps from true positions."""

    frame: NDArray[np.int64]
    """``[M]`` frames of the trajectory that were predicted"""
    squared_error: NDArray[np.float32]
    """``[M, N]`` of the acceleration, summed over dimensions, normalized units"""
    variance: NDArray[np.float32] | None
    """``[M, N]`` predicted variance per dimension, normalized units; None without a head for it"""


class RolloutFile:
    """A rollout file open for reading; use it in a ``with`` statement.

    A sequence of :class:`Rollout`; tensors are read when they are asked for. ``settings`` is what
    the writer was given; the properties below name the parts of it that are understood here:
    ``label`` (of the model), ``policy``, ``trained_radius``, ``radius`` (of the graph where it
    differs, or null) and ``adaptive`` with ``tau`` and ``factor``.

    Raises :class:`RolloutFileError` for anything but a whole rollout file of this version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_dir():
            held = ", ".join(
                str(file) for file in sorted([*path.glob("*.h5"), *path.glob("*/*.h5")])[:3]
            )
            raise RolloutFileError(
                f"rollout file {path}: is a folder; a file is accepted"
                + (f", such as {held}" if held else "")
            )
        if not path.is_file():
            raise FileNotFoundError(f"rollout file {path}: there is no such file")
        try:
            self._file = h5py.File(path, "r")
        except OSError as error:
            raise RolloutFileError(
                f"rollout file {path}: not a whole HDF5 file ({error})"
            ) from None
        attributes = self._file.attrs
        if attributes.get("format") != FORMAT or attributes.get("version") != VERSION:
            found = f"{attributes.get('format')!r} version {attributes.get('version')!r}"
            self._file.close()
            raise RolloutFileError(
                f"rollout file {path}: its format is {found}; accepted is {FORMAT!r} version "
                f"{VERSION}, which python -m adaptgns.rollout writes"
            )
        self.metadata: Metadata = Metadata.from_json(json.loads(attributes["metadata"]))
        self.settings: dict[str, Any] = json.loads(attributes["settings"])

    def __enter__(self) -> RolloutFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __len__(self) -> int:
        return len(self._file)

    def __getitem__(self, index: int) -> Rollout:
        if not 0 <= index < len(self):
            raise IndexError(
                f"trajectory: got {index}; {self.path} has {len(self)}, counted from 0"
            )
        return Rollout(self._file[f"{index:05d}"])

    def __iter__(self) -> Iterator[Rollout]:
        return (self[index] for index in range(len(self)))

    @property
    def label(self) -> str:
        """Name of the model."""
        return str(self.settings.get("label", self.path.stem))

    @property
    def policy(self) -> str:
        """Name of the graph policy."""
        return str(self.settings.get("policy", "fixed"))

    @property
    def has_edges(self) -> bool:
        """Whether the model has edges, as far as the settings tell."""
        return bool(self.settings.get("training", {}).get("model", {}).get("edges", True))

    @property
    def graph_radius(self) -> float:
        """Base radius of the graphs (length)."""
        for radius in (self.settings.get("radius"), self.settings.get("trained_radius")):
            if radius is not None:
                return float(radius)
        return float(self.metadata.radius)

    @property
    def tau(self) -> float:
        """Percentile of sigma above which the policy ``adaptive`` lets a particle see farther."""
        return float(self.settings["adaptive"]["tau"])

    @property
    def factor(self) -> float:
        """How many times farther it sees."""
        return float(self.settings["adaptive"]["factor"])


def _create(group: h5py.Group, name: str, values: ArrayLike) -> None:
    tensor = CATALOGUE[name]
    dataset = group.create_dataset(name, data=np.asarray(values, dtype=tensor.dtype))
    dataset.attrs["unit"] = tensor.unit


def _append(group: h5py.Group, name: str, row: ArrayLike) -> None:
    """Add ``row`` at the end of the first axis of the tensor ``name``."""
    values = np.asarray(row, dtype=CATALOGUE[name].dtype)
    if name not in group:
        rows = max(1, min(CHUNK_BYTES // max(values.nbytes, 1), 1024))
        created = group.create_dataset(
            name,
            shape=(0, *values.shape),
            maxshape=(None, *values.shape),
            chunks=(rows, *(max(size, 1) for size in values.shape)),
            dtype=values.dtype,
        )
        created.attrs["unit"] = CATALOGUE[name].unit
    dataset = group[name]
    if dataset.shape[1:] != values.shape:
        raise ValueError(
            f"{name}: got a row of shape {values.shape} after rows of shape {dataset.shape[1:]}"
        )
    dataset.resize(len(dataset) + 1, axis=0)
    dataset[-1] = values


def _check(group: h5py.Group) -> None:
    """Raise ValueError unless the tensors of ``group`` have the catalogue's shapes, one size a
    letter."""
    sizes: dict[str, tuple[int, str]] = {"H": (INPUT_FRAMES, "the input")}
    for name, tensor in CATALOGUE.items():
        if name not in group:
            continue
        letters, shape = tensor.shape.split(), group[name].shape
        agree = len(letters) == len(shape) and all(
            sizes.setdefault(letter, (size, name))[0] == size
            for letter, size in zip(letters, shape, strict=True)
        )
        if not agree:
            known = ", ".join(f"{letter} = {size} by {by}" for letter, (size, by) in sizes.items())
            raise ValueError(
                f"{name}: trajectory {group.attrs['name']} has shape {shape}; expected "
                f"[{', '.join(letters)}] with {known}"
            )
