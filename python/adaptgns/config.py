"""Every option of a run, as frozen dataclasses that are stored whole in each checkpoint."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import cattrs
import torch
from cattrs.preconf.json import make_converter
from cattrs.v import format_exception

from adaptgns.data.trajectory import INPUT_FRAMES

HISTORY = INPUT_FRAMES
"""Positions the network looks at: the current one and the five before it."""

TYPE_EMBEDDING = 16

Loss = Literal["nll", "beta-nll", "decoupled", "mse"]
Preset = Literal["smoke", "laptop", "paper"]
RuledPolicy = Literal[
    "adaptive", "two-sided", "two-pass", "base-sigma", "random", "acceleration", "divergence"
]
"""Those under which some particles see farther, by the adaptive graph's rule"""
PolicyName = Literal["fixed", RuledPolicy, "knn"]
Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["float32", "bf16"]
EdgeUpdate = Literal["fixed", "legacy"]

Range = tuple[str, Callable[[float], bool]]
"""What is accepted, in words and as a test; NaN fails them all."""

COUNT: Range = ("whole numbers >= 1", lambda value: value >= 1)
NOT_NEGATIVE: Range = ("finite numbers >= 0", lambda value: 0 <= value < math.inf)
POSITIVE: Range = ("finite numbers > 0", lambda value: 0 < value < math.inf)
SHARE: Range = ("numbers from 0 to 1", lambda value: 0 <= value <= 1)
ABOVE_ZERO_TO_ONE: Range = ("numbers above 0, up to 1", lambda value: 0 < value <= 1)
PERCENTILE: Range = ("numbers from 0 to 100", lambda value: 0 <= value <= 100)
FACTOR: Range = ("finite numbers >= 1", lambda value: 1 <= value < math.inf)


def _require(config: object, **ranges: Range) -> None:
    """Raise ValueError for the first field of ``config`` that is outside its range; None, where a
    field may be that, is inside."""
    for name, (accepted, holds) in ranges.items():
        value = getattr(config, name)
        if value is not None and not holds(value):
            raise ValueError(f"{name}: got {value}; accepted are {accepted}")


@dataclass(frozen=True)
class ModelConfig:
    """The network."""

    latent: int = 128
    """Width of the latents and of the hidden layers."""
    hidden_layers: int = 2
    """Hidden layers of each MLP."""
    steps: int = 10
    """Message-passing steps."""
    edges: bool = True
    """False: the per-particle MLP baseline, the same network without any edges."""
    self_edges: bool = True
    """Connect every particle with itself, too."""
    radius: float | None = None
    """Connectivity radius (length units of the data); None: the data set's own."""
    relative_motion: bool = False
    """Features that tell small differences of velocity apart: of the particles, the last velocity
    and the accelerations before it instead of all five velocities; of the edges, also the relative
    velocity of their ends and its part along the edge."""
    walls: bool = False
    """Hold particles inside the bounds of open axes, as solid walls do."""

    edge_update: EdgeUpdate = "fixed"
    """What each step leaves of the edges' latents: fixed adds the messages; legacy doubles them, as
    geoelements/gns did before its pull request 94 (December 2024)."""

    variance_layers: int = 1
    """Hidden layers of the variance head."""

    def __post_init__(self) -> None:
        _require(
            self,
            latent=COUNT,
            hidden_layers=COUNT,
            steps=COUNT,
            radius=POSITIVE,
            variance_layers=COUNT,
        )

    def radius_or(self, default: float) -> float:
        """The radius, or the data set's."""
        return default if self.radius is None else self.radius


@dataclass(frozen=True)
class AdaptiveConfig:
    """The adaptive graph rule."""

    tau: float = 70.0
    """Percentile of sigma above which a particle sees farther."""
    factor: float = 1.267
    """How many times farther."""
    low_tau: float = 30.0
    """Two-sided alone: percentile, at most tau, below which a particle sees less far."""
    low_factor: float = 0.8
    """Two-sided alone: how many times as far."""

    def __post_init__(self) -> None:
        _require(
            self, tau=PERCENTILE, factor=FACTOR, low_tau=PERCENTILE, low_factor=ABOVE_ZERO_TO_ONE
        )

    def require_two_sides(self) -> None:
        """Raise ValueError where the two sides of the rule overlap."""
        if self.low_tau > self.tau:
            raise ValueError(
                f"low_tau: got {self.low_tau:g}; accepted for two-sided graphs are numbers up to "
                f"tau, {self.tau:g}"
            )


@dataclass(frozen=True)
class RolloutConfig:
    """Rollouts of a trained model over a split."""

    checkpoint: Path
    """Run folder or .safetensors file; waterdrop and sand: models that come with the package."""
    out: Path
    """HDF5 file to write."""
    data: str | None = None
    """Folder of a data set or name of an embedded one; None: the one the model was trained on."""
    split: Literal["train", "valid", "test"] = "test"
    """Which part of the data."""
    policy: PolicyName = "fixed"
    """Graph of each step: fixed radius; adaptive (sigma of the step before), two-sided (and shorter
    edges where it is low), two-pass (sigma of this step), base-sigma (of the step before, on the
    base graph); the same share of particles chosen at random, by the acceleration before, or
    by the divergence of the velocities around; knn."""
    adaptive: AdaptiveConfig = field(default_factory=AdaptiveConfig)
    k: int = 6
    """Neighbours of the policy knn."""
    radius: float | None = None
    """Radius of the graph alone (length units of the data); features stay divided by the radius
    of training. None: that one."""
    steps: int | None = None
    """Frames to predict, at most; None: to each trajectory's end."""
    trajectories: int | None = None
    """Trajectories to roll out, from the first; None: all."""
    one_step_every: int = 10
    """Frames between the true states at which the error of a single step is measured."""
    seed: int = 0
    """Seed of the policy random."""
    device: Device = "auto"
    """auto: a GPU where there is one."""
    precision: Precision = "float32"
    """bf16: the edges' latents and the factors of products up to the heads in 16 bits, all else in
    32; for processors with instructions for it, and GPUs."""

    def __post_init__(self) -> None:
        _require(
            self,
            k=COUNT,
            radius=POSITIVE,
            steps=COUNT,
            trajectories=COUNT,
            one_step_every=COUNT,
            seed=NOT_NEGATIVE,
        )


@dataclass(frozen=True)
class TrainConfig:
    """A training run, from the data to the table of results."""

    data: str = "waterdrop"
    """Folder of a data set, or the name of an embedded one: waterdrop or sand."""
    out: Path | None = None
    """Run folder; None: runs/<data>-<preset>-<model>-<loss>-<seed>."""
    preset: Preset = "laptop"
    """Which set of defaults all other options start from."""
    resume: Path | None = None
    """Go on with the run in this folder, with the configuration saved there."""
    init: Path | None = None
    """Begin with the weights of this checkpoint, of the same --model options: a run folder, a
    .safetensors file, or waterdrop or sand."""
    model: ModelConfig = field(default_factory=ModelConfig)
    adaptive: AdaptiveConfig = field(default_factory=AdaptiveConfig)
    loss: Loss = "nll"
    """nll trains a variance beside the acceleration; beta-nll does and weighs hard particles more;
    decoupled trains the acceleration as mse does, and the variance on the errors that leaves; mse
    trains the acceleration alone."""
    variance_weight: float = 0.0
    """Of the loss decoupled: weight of the variance's likelihood, through which it shapes the
    latents, too; 0: the variance head learns alone."""
    variance_ahead: bool = False
    """Of the loss decoupled: the variance stands for the error one frame later, on the graph that
    it chooses; needs unroll >= 2."""
    graph: Literal["base", "adaptive", "two-sided"] = "base"
    """Graph seen in training; all but base have the one-step lag of the rollout. Validation always
    rolls out on the base graph."""
    steps: int = 20_000
    """Optimizer steps."""
    batch: int = 2
    """Samples (windows of one trajectory) per step."""
    batch_particles: int | None = None
    """Particles per step at most, where the next sample would exceed it; None: unlimited."""
    lr: float = 1e-4
    """Learning rate at its highest."""
    lr_final: float = 1e-6
    """Learning rate that the schedule ends at (cosine) or falls to (exponential)."""
    schedule: Literal["exponential", "cosine"] = "exponential"
    """exponential: a factor 0.1 per 5,000,000 steps; cosine: to lr_final at the last step."""
    warmup: int = 0
    """Steps of linear increase of the learning rate from zero."""
    clip: float | None = None
    """Largest gradient norm; None: unlimited."""
    noise: float = 6.7e-4
    """Std of the random-walk noise on the last input velocity (length per frame)."""
    drift: float = 0.0
    """Scale of the noise on the accelerations before the last velocity that all particles of a
    sample share (length per frame squared); 0: none, as GNS."""
    velocity_correction: float = 1.0
    """Share of the last velocity's noise that the target undoes in one frame; 1: all, as GNS."""
    position_correction: float = 0.0
    """Share of the last position's noise that the target undoes in one frame; 0: none, as GNS."""
    compression: float = 0.0
    """Scale of the strain of smooth random compressions, to which the target adds the acceleration
    that undoes them; none in samples with kinematic particles. 0: none at all, as GNS."""
    unroll: int = 1
    """Frames that each sample predicts one after the other, with gradients through all of them, in
    the second half of the training. The noise is undone by its shares, what the model itself adds
    in full. 1: never more than one frame, as GNS."""
    mirror: bool = False
    """Reflect every other sample along the first axis (for physics that is symmetric there)."""
    seed: int = 0
    """Seed of the weights, the data order and the noise."""
    device: Device = "auto"
    """auto: a GPU where there is one."""
    workers: int = 0
    """Processes that load data and build graphs; 0: the main one does."""
    threads: int | None = None
    """CPU threads; None: as many as torch would take, one per core."""
    validate_every: int = 5_000
    """Steps between validations."""
    validate_trajectories: int = 4
    """Validation trajectories that are rolled out."""
    validate_horizon: int = 200
    """Frames of those rollouts."""
    checkpoint_every: int = 1_000
    """Steps between checkpoints."""
    test_trajectories: int | None = None
    """Test trajectories rolled out at the end; None: all."""
    test_horizon: int | None = 200
    """Frames of those rollouts; None: to the end."""
    precision: Precision = "float32"
    """bf16: the factors of products up to the heads in 16 bits, in validation the edges' latents,
    too, all else in 32; for processors with instructions for it, and GPUs."""

    def __post_init__(self) -> None:
        _require(
            self,
            steps=COUNT,
            batch=COUNT,
            batch_particles=COUNT,
            lr=POSITIVE,
            lr_final=NOT_NEGATIVE,
            warmup=NOT_NEGATIVE,
            clip=POSITIVE,
            noise=NOT_NEGATIVE,
            drift=NOT_NEGATIVE,
            velocity_correction=SHARE,
            position_correction=SHARE,
            compression=SHARE,
            variance_weight=NOT_NEGATIVE,
            unroll=COUNT,
            seed=NOT_NEGATIVE,
            workers=NOT_NEGATIVE,
            threads=COUNT,
            validate_every=COUNT,
            validate_trajectories=COUNT,
            validate_horizon=COUNT,
            checkpoint_every=COUNT,
            test_trajectories=COUNT,
            test_horizon=COUNT,
        )
        if self.variance_ahead and (self.loss != "decoupled" or self.unroll < 2):
            raise ValueError(
                f"variance_ahead: needs the loss decoupled and unroll >= 2; got {self.loss} and "
                f"{self.unroll}"
            )


T = TypeVar("T")


def torch_device(name: Device) -> torch.device:
    """The device that ``name`` means on this machine."""
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device: got cuda, but torch finds no GPU here; accepted are auto and cpu")
    return torch.device(
        "cuda" if name == "auto" and torch.cuda.is_available() else name.replace("auto", "cpu")
    )


_converter = make_converter(forbid_extra_keys=True)
_converter.register_unstructure_hook(Path, str)
_converter.register_structure_hook(Path, lambda value, _: Path(_exactly(value, str)))
_converter.register_structure_hook(float, lambda value, _: float(_exactly(value, float, int)))
for plain in (bool, int, str):
    _converter.register_structure_hook(plain, lambda value, kind: _exactly(value, kind))  # noqa: PLW0108
_converter.register_structure_hook_func(
    lambda kind: get_origin(kind) is Literal,  # type: ignore[comparison-overlap]
    lambda value, kind: _one_of(value, get_args(kind)),
)


def _one_of(value: Any, accepted: tuple[Any, ...]) -> Any:
    """``value`` if it is one of ``accepted``."""
    if value not in accepted:
        raise ValueError(f"got {value!r}; accepted are {', '.join(map(str, accepted))}")
    return value


def _exactly(value: Any, *kinds: type) -> Any:
    """``value`` if it is of one of these types; cattrs would make one of nearly anything."""
    if type(value) not in kinds:
        raise ValueError(f"got {value!r}; accepted is a value of type {kinds[0].__name__}")
    return value


class ConfigError(ValueError):
    """A configuration with unknown keys or values of a wrong kind."""


def to_json(config: object) -> dict[str, Any]:
    """A configuration as JSON types."""
    result: dict[str, Any] = _converter.unstructure(config)
    return result


def from_json(kind: type[T], values: dict[str, Any], *, source: str) -> T:
    """The configuration of dataclass ``kind`` that :func:`to_json` gave; unknown keys are refused.

    ``source`` names where the values came from, for the message of :class:`ConfigError`.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"configuration {source}: got {values!r}; an object is accepted")
    try:
        return _converter.structure(values, kind)
    except cattrs.BaseValidationError as error:
        problems = "; ".join(cattrs.transform_error(error, format_exception=_describe))
        raise ConfigError(f"configuration {source}: {problems}") from error


def _describe(error: BaseException, kind: type | None) -> str:
    """A problem in a configuration, in words; those that ``_require`` found have their own."""
    if type(error) is ValueError and str(error):
        return str(error)
    if isinstance(error, AttributeError):  # what should be an object has no keys
        return "an object is accepted"
    return format_exception(error, kind)
