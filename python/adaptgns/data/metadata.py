"""What a model must know about a data set, read from the `metadata.json` beside it."""

from __future__ import annotations

import json
import math
import os
import warnings
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from adaptgns.atomic import replace_text
from adaptgns.data.errors import DataError, DataWarning
from adaptgns.data.statistics import FILE_KEYS, MotionStatistics, compute_statistics
from adaptgns.data.trajectories import SPLITS, find_split, open_split

FILE_NAME = "metadata.json"
RADIUS_KEY = "default_connectivity_radius"

GNS_KINEMATIC = (3,)
LAGRANGEBENCH_KINEMATIC = (1, 2)


@dataclass(frozen=True)
class Metadata:
    """Everything about a data set that a model must know; stored in checkpoints.

    Attributes:
        dim: number of spatial dimensions, 2 or 3.
        dt: time between frames, in the data's time unit.
        bounds: `(low, high)` per axis, in the data's length unit.
        periodic: per axis, whether `high` is the same place as `low`.
        radius: default connectivity radius, in the data's length unit.
        velocity_mean, velocity_std: per axis, of the displacements per frame.
        acceleration_mean, acceleration_std: per axis, of the second differences, per frame².
        kinematic_types: particle types that follow a given trajectory.
        material_properties: number of material properties per particle.
    """

    dim: int
    dt: float
    bounds: tuple[tuple[float, float], ...]
    periodic: tuple[bool, ...]
    radius: float
    velocity_mean: tuple[float, ...]
    velocity_std: tuple[float, ...]
    acceleration_mean: tuple[float, ...]
    acceleration_std: tuple[float, ...]
    kinematic_types: tuple[int, ...]
    material_properties: int = 0

    def __post_init__(self) -> None:
        _check_geometry(self.dim, self.dt, self.bounds, self.periodic, self.radius)
        for ours, key in FILE_KEYS.items():
            _check_statistic(key, getattr(self, ours), self.dim)

    @property
    def box(self) -> npt.NDArray[np.float64] | None:
        """Period length per axis, `inf` on open axes; None when nothing is periodic."""
        return period_lengths(self.bounds, self.periodic)

    def mobile(self, particle_type: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Which particles of these types `[N]` are not kinematic, bool `[N]`."""
        return ~np.isin(particle_type, self.kinematic_types)

    def suited(self, folder: Path, split: str) -> tuple[Metadata, list[str]]:
        """What a model that was trained on this goes by in rollouts of a split of `folder`: this,
        with the bounds there, which geoelements/gns may state apart for its test data. And what a
        user should know: in what they differ, statistics of motion apart, which a rollout doesn't
        need.

        Raises:
            DataError: they differ in what a model can't do without, or `metadata.json` is wrong.
        """
        if not (folder / FILE_NAME).exists():
            note = f"{folder}: there is no {FILE_NAME} that tells whether the model suits the data"
            return self, [note]
        content = _load(folder / FILE_NAME)
        section = training_section(content)
        if split == "test" and isinstance(content.get("rollout"), dict):
            section = section | content["rollout"]
        notes, bounds = [], self.bounds
        try:
            settings = _setting({RADIUS_KEY: self.radius} | section, folder)
        except DataError as error:
            raise DataError(f"{folder / FILE_NAME}, for {split}: {error}") from error
        for name, given in settings.items():
            trained = getattr(self, name)
            if given == trained:
                continue
            if name in {"dim", "periodic", "material_properties"}:
                raise DataError(
                    f"{folder}: {name} is {given}; the model was trained with {trained} and "
                    "accepts no other"
                )
            if name == "bounds":
                bounds = given
                notes.append(f"{folder}: bounds are {given}; the model was trained in {trained}")
            else:
                notes.append(
                    f"{folder}: {name} is {given}; the model goes by {trained}, with which it was "
                    "trained"
                )
        return replace(self, bounds=bounds), notes

    def to_json(self) -> dict[str, Any]:
        """Plain values that `from_json` reads back exactly."""
        return asdict(self)

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Metadata:
        """The inverse of `to_json`, also after a trip through JSON text.

        Raises:
            DataError: keys are missing or unknown, or a value can't be.
        """
        known = {field.name for field in fields(cls)}
        if set(content) != known:
            wrong = sorted(set(content) ^ known)
            raise DataError(f"metadata: keys missing or unknown: {', '.join(wrong)}")
        return cls(**{name: _frozen(value) for name, value in content.items()})


def read_metadata(folder: Path, *, radius: float | None = None) -> Metadata:
    """Reads `metadata.json` of GNS, LagrangeBench or this project.

    GNS files split into a `train` and a `rollout` section are understood. Missing statistics are
    computed from the train split and written back; where the file can't be written they are kept
    in memory and a `DataWarning` says so. `radius` stands for one that the file doesn't state.

    Raises:
        DataError: no such file, not JSON, or missing or impossible values; names file and key.
    """
    folder = Path(folder)
    path = folder / FILE_NAME
    content = _load(path)
    section = training_section(content)
    try:
        metadata = _parse(section if radius is None else {RADIUS_KEY: radius, **section}, folder)
    except DataError as error:
        if str(error).startswith(f"{folder}{os.sep}"):  # it is about another file
            raise
        raise DataError(f"{path}: {error}") from error
    missing = [key for key in FILE_KEYS.values() if key not in section]
    if missing:
        _write_back(path, content, metadata)
    return metadata


def states_radius(folder: Path) -> bool:
    """Whether `metadata.json` in `folder` states a connectivity radius."""
    return RADIUS_KEY in training_section(_load(folder / FILE_NAME))


def write_metadata(folder: Path, content: dict[str, Any]) -> None:
    """Writes `metadata.json` in `folder`, whole or not at all."""
    replace_text(Path(folder) / FILE_NAME, json.dumps(content, indent=2, allow_nan=False) + "\n")


def period_lengths(
    bounds: tuple[tuple[float, float], ...], periodic: tuple[bool, ...]
) -> npt.NDArray[np.float64] | None:
    """Period length per axis, `inf` on open axes; None when nothing is periodic."""
    if not any(periodic):
        return None
    return np.array(
        [
            high - low if wraps else np.inf
            for (low, high), wraps in zip(bounds, periodic, strict=True)
        ]
    )


def _load(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise DataError(f"{path}: there is no such file") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable as JSON: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds a {type(content).__name__}; an object is accepted")
    return content


def training_section(content: dict[str, Any]) -> dict[str, Any]:
    """What describes the training data: geoelements/gns may have a section for it."""
    return content["train"] if isinstance(content.get("train"), dict) else content


def _setting(section: dict[str, Any], folder: Path) -> dict[str, Any]:
    """All of `Metadata` but the statistics of motion."""
    dim = _integer(section, "dim")
    bounds = tuple(_pair(axis) for axis in _list(section, "bounds"))
    periodic = _periodic(section, dim)
    # LagrangeBench's dt is the solver's; it keeps every write_every-th step as a frame.
    dt = _number(section, "dt") * (
        _number(section, "write_every") if "write_every" in section else 1.0
    )
    try:
        radius = _number(section, RADIUS_KEY)
    except DataError as error:
        if RADIUS_KEY in section:
            raise
        raise DataError(f"{error}; `python -m adaptgns.inspect {folder}` proposes one") from None
    _check_geometry(dim, dt, bounds, periodic, radius)
    return {
        "dim": dim,
        "dt": dt,
        "bounds": bounds,
        "periodic": periodic,
        "radius": radius,
        "kinematic_types": _kinematic_types(section),
        "material_properties": _material_properties(section, folder),
    }


def _parse(section: dict[str, Any], folder: Path) -> Metadata:
    setting = _setting(section, folder)
    stated: dict[str, Any] = {
        ours: tuple(_list(section, key)) for ours, key in FILE_KEYS.items() if key in section
    }
    if len(stated) == len(FILE_KEYS):
        return Metadata(**setting, **stated)
    computed = asdict(
        _compute(folder, setting["bounds"], setting["periodic"], setting["kinematic_types"])
    )
    for ours in ("velocity_std", "acceleration_std"):
        if ours not in stated and not all(value > 0 for value in computed[ours]):
            raise DataError(
                f"{FILE_KEYS[ours]} of the train split is {list(computed[ours])}; numbers above 0 "
                "are accepted: from motion that never changes nothing can be learned"
            )
    return Metadata(**setting, **(computed | stated))


def _compute(
    folder: Path,
    bounds: tuple[tuple[float, float], ...],
    periodic: tuple[bool, ...],
    kinematic: tuple[int, ...],
) -> MotionStatistics:
    try:
        train = open_split(folder, "train")
    except DataError as error:
        raise DataError(f"no motion statistics, and none can be computed: {error}") from error
    return compute_statistics(
        train, box=period_lengths(bounds, periodic), kinematic_types=kinematic
    )


def _write_back(path: Path, content: dict[str, Any], metadata: Metadata) -> None:
    """Adds the statistics that were missing to each section of the file."""
    rollout = content.get("rollout")
    apart = [rollout] if isinstance(rollout, dict) and "dim" in rollout else []  # a whole one
    for section in (training_section(content), *apart):
        for ours, key in FILE_KEYS.items():
            section.setdefault(key, list(getattr(metadata, ours)))
    try:
        write_metadata(path.parent, content)
    except OSError as error:
        warnings.warn(
            f"{path}: the statistics computed from the train split are kept in memory only, "
            f"since the file can't be written: {error}",
            DataWarning,
            stacklevel=3,
        )


def _kinematic_types(section: dict[str, Any]) -> tuple[int, ...]:
    """As stated in our own files; else walls for LagrangeBench, boundary particles for GNS."""
    if "kinematic_types" in section:
        types = tuple(_list(section, "kinematic_types"))
        if not all(isinstance(kind, int) for kind in types):
            raise DataError(f"kinematic_types is {list(types)}; integers are accepted")
        return types
    is_lagrangebench = "periodic_boundary_conditions" in section
    return LAGRANGEBENCH_KINEMATIC if is_lagrangebench else GNS_KINEMATIC


def _periodic(section: dict[str, Any], dim: int) -> tuple[bool, ...]:
    """LagrangeBench may list three axes for two-dimensional data; the third says nothing."""
    if "periodic_boundary_conditions" not in section:
        return (False,) * dim
    periodic = _list(section, "periodic_boundary_conditions")
    return tuple(periodic[:2] if dim == 2 and len(periodic) == 3 else periodic)


def _material_properties(section: dict[str, Any], folder: Path) -> int:
    if "material_properties" in section:
        return _integer(section, "material_properties")
    present = next((split for split in SPLITS if find_split(folder, split)), None)
    return 0 if present is None else open_split(folder, present).material_properties


def _check_geometry(
    dim: int,
    dt: float,
    bounds: tuple[tuple[float, float], ...],
    periodic: tuple[bool, ...],
    radius: float,
) -> None:
    if dim not in {2, 3}:
        raise DataError(f"dim is {dim}; 2 or 3 are accepted")
    if len(bounds) != dim:
        raise DataError(f"bounds has {len(bounds)} axes; dim is {dim}")
    for low, high in bounds:
        if not low < high or not math.isfinite(high - low):
            raise DataError(f"bounds hold [{low}, {high}]; low < high, both finite, is accepted")
    if len(periodic) != dim or not all(isinstance(axis, bool) for axis in periodic):
        raise DataError(
            f"periodic_boundary_conditions is {list(periodic)}; {dim} booleans are accepted"
        )
    for name, value in (("dt", dt), (RADIUS_KEY, radius)):
        if not (math.isfinite(value) and value > 0):
            raise DataError(f"{name} is {value}; a finite number above 0 is accepted")


def _check_statistic(key: str, values: tuple[float, ...], dim: int) -> None:
    if len(values) != dim:
        raise DataError(f"{key} is {list(values)}; {dim} numbers are accepted, since dim is {dim}")
    if not all(_is_number(value) and math.isfinite(value) for value in values):
        raise DataError(f"{key} is {list(values)}; finite numbers are accepted")
    if key.endswith("_std") and not all(value > 0 for value in values):
        raise DataError(
            f"{key} is {list(values)}; numbers above 0 are accepted (leave the key out to have it "
            "computed from the train split)"
        )


def _required(section: dict[str, Any], key: str) -> Any:
    if key not in section:
        raise DataError(f"no {key}; the keys are {', '.join(sorted(section))}")
    return section[key]


def _integer(section: dict[str, Any], key: str) -> int:
    value = _required(section, key)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise DataError(f"{key} is {value!r}; an integer of 0 or more is accepted")
    return value


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _number(section: dict[str, Any], key: str) -> float:
    value = _required(section, key)
    if not _is_number(value):
        raise DataError(f"{key} is {value!r}; a number is accepted")
    return float(value)


def _list(section: dict[str, Any], key: str) -> list[Any]:
    value = _required(section, key)
    if not isinstance(value, list):
        raise DataError(f"{key} is {value!r}; a list is accepted")
    return value


def _pair(axis: Any) -> tuple[float, float]:
    if not (isinstance(axis, list) and len(axis) == 2 and all(_is_number(end) for end in axis)):
        raise DataError(f"bounds hold {axis!r}; [low, high] per axis is accepted")
    return float(axis[0]), float(axis[1])


def _frozen(value: Any) -> Any:
    return tuple(_frozen(item) for item in value) if isinstance(value, (list, tuple)) else value
