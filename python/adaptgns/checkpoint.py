"""Checkpoints: one safetensors file each, written whole or not at all.

The file's header holds the run's configuration and the data's metadata as JSON, enough to rebuild
the simulator with nothing else. Tensors: ``model.*``, and ``optimizer.*`` in the files that
training goes on from.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from adaptgns.atomic import written_whole
from adaptgns.config import TrainConfig, from_json, to_json
from adaptgns.data.metadata import Metadata
from adaptgns.simulator import Simulator

PRETRAINED = Path(__file__).parent / "pretrained"
"""Checkpoints that come with the package, one for each embedded data set, by its name"""
BEST = "best.safetensors"
LAST = "last.safetensors"
FORMAT = "adaptgns-checkpoint-1"


class CheckpointError(ValueError):
    """A checkpoint that is missing, damaged or of another kind."""


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint file holds."""

    config: TrainConfig
    metadata: Metadata
    step: int
    """Optimizer steps taken."""
    best_score: float
    """Lowest validation score so far; inf before the first."""
    tensors: dict[str, Tensor]
    validated: bool = True
    """Whether the validation that is due at this step has been done."""
    types: tuple[int, ...] | None = None
    """Particle types that it was trained on, ascending; None: not known."""

    def group(self, name: str) -> dict[str, Tensor]:
        """The tensors whose names start with ``name.``, without that prefix."""
        prefix = name + "."
        return {k.removeprefix(prefix): v for k, v in self.tensors.items() if k.startswith(prefix)}

    def simulator(self) -> Simulator:
        """The trained simulator."""
        simulator = build_simulator(self.config, self.metadata)
        simulator.load_state_dict(self.group("model"))
        return simulator.eval()


def build_simulator(config: TrainConfig, metadata: Metadata) -> Simulator:
    """An untrained simulator for ``config``, on data described by ``metadata``."""
    return Simulator(
        config.model,
        metadata,
        noise=config.noise,
        variance=config.loss != "mse",
        variance_alone=config.loss == "decoupled" and config.variance_weight == 0,
        precision=config.precision,
    )


def take_weights(simulator: Simulator, path: Path) -> tuple[list[str], list[str]]:
    """Give ``simulator`` the weights of the checkpoint ``path``; the names of those that it lacks,
    which stay as they were, and of those that have no place here. Such is a variance head.

    CheckpointError where the models differ in more.
    """
    checkpoint = read_checkpoint(path)
    there, here = vars(checkpoint.config.model), vars(simulator.config)
    apart = {n: there[n] for n in here if n not in ("radius", "walls") and here[n] != there[n]}
    if apart:
        told = ", ".join(f"model.{n} is {value}, here {here[n]}" for n, value in apart.items())
        raise CheckpointError(f"checkpoint {path}: {told}; accepted is one of the same network")
    own, given = simulator.state_dict(), checkpoint.group("model")
    taken = {name: weights for name, weights in given.items() if name in own}
    for name, weights in taken.items():
        if (shape := list(weights.shape)) != list(own[name].shape):
            raise CheckpointError(
                f"checkpoint {path}: {name} has the shape {shape}, in this model "
                f"{list(own[name].shape)}; accepted is one with as many dimensions, open axes and "
                "material properties"
            )
    simulator.load_state_dict(own | taken)
    return [name for name in own if name not in given], [name for name in given if name not in own]


def with_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """``tensors`` named as a group of a checkpoint."""
    return {f"{prefix}.{name}": tensor.detach().contiguous() for name, tensor in tensors.items()}


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write ``checkpoint`` to ``path``, replacing what is there only when it is safely on disk."""
    header = {
        "format": FORMAT,
        "config": json.dumps(to_json(checkpoint.config)),
        "metadata": json.dumps(checkpoint.metadata.to_json()),
        "step": str(checkpoint.step),
        "best_score": repr(checkpoint.best_score),
        "validated": str(checkpoint.validated),
    }
    if checkpoint.types is not None:
        header["types"] = json.dumps(checkpoint.types)
    with written_whole(path) as partial:
        partial.write_bytes(save(checkpoint.tensors, header))


def read_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint in the file ``path``, or in the run folder ``path``: its best one, else its
    last. The name of an embedded data set, where there is no such file or folder, stands for the
    pretrained one.

    Raises :class:`CheckpointError` where there is none or it is not whole, ConfigError or DataError
    where its configuration or its data's metadata are not of this version.
    """
    file = checkpoint_file(path)
    try:
        with safe_open(file, framework="pt") as archive:
            header = archive.metadata() or {}
            tensors = {name: archive.get_tensor(name) for name in archive.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"checkpoint {file}: cannot be read as .safetensors ({error}); rollouts (.h5) are for "
            "evaluate and plot, other kinds of checkpoints for convert"
        ) from error
    if header.get("format") != FORMAT:
        raise CheckpointError(
            f"checkpoint {file}: its format is {header.get('format')!r}; accepted is {FORMAT!r}"
        )
    return Checkpoint(
        config=from_json(TrainConfig, json.loads(header["config"]), source=str(file)),
        metadata=Metadata.from_json(json.loads(header["metadata"])),
        step=int(header["step"]),
        best_score=float(header["best_score"]),
        tensors=tensors,
        validated=header.get("validated") != "False",
        types=tuple(json.loads(header["types"])) if "types" in header else None,
    )


def checkpoint_file(path: Path) -> Path:
    """The checkpoint file that ``path``, a file, a run folder or a pretrained model's name, stands
    for."""
    candidates = [path] if path.is_file() else [path / BEST, path / LAST]
    if not path.exists():
        candidates = [PRETRAINED / f"{path}.safetensors"]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    names = ", ".join(sorted(file.stem for file in PRETRAINED.glob("*.safetensors")))
    raise CheckpointError(
        f"checkpoint {path}: not found; accepted are a .safetensors file, a run folder that holds "
        f"{BEST} or {LAST}, and the pretrained {names}"
    )
