"""`python -m adaptgns.convert`: data sets and checkpoints from and to the formats of others."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import Progress

from adaptgns.atomic import folder_written_whole
from adaptgns.checkpoint import (
    BEST,
    LAST,
    Checkpoint,
    CheckpointError,
    read_checkpoint,
    with_prefix,
    write_checkpoint,
)
from adaptgns.command import plain_errors
from adaptgns.config import EdgeUpdate, TrainConfig
from adaptgns.data.dataset import counts, refuse_taken
from adaptgns.data.errors import DataError
from adaptgns.data.frames import FrameFolders, holds_frames
from adaptgns.data.metadata import (
    FILE_NAME,
    GNS_KINEMATIC,
    Metadata,
    read_metadata,
    training_section,
    write_metadata,
)
from adaptgns.data.npz import NpzSource
from adaptgns.data.npz_writer import write_npz
from adaptgns.data.store import write_split
from adaptgns.data.store_source import StoreSource
from adaptgns.data.tfrecord import TfrecordFile
from adaptgns.data.trajectories import SPELLINGS, Trajectories, find_split, open_split
from adaptgns.geoelements import read_geoelements, write_geoelements
from adaptgns.progress import progress_bar

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from adaptgns.data.trajectory import Trajectory

Target = Literal["h5", "npz", "safetensors", "pt"]

_DATA = (".h5", ".npz", ".tfrecord")
_CHECKPOINTS = {".pt": "safetensors", ".safetensors": "pt"}


@dataclass(frozen=True)
class ConvertConfig:
    """Convert a data set or a checkpoint.

    Data: HDF5 (LagrangeBench, this project), GNS .npz, DeepMind .tfrecord, and folders of VTK, VTU
    or PLY frames become HDF5 or .npz. Checkpoints: geoelements/gns .pt becomes .safetensors, and
    back. What exists is never replaced, and DEST appears whole or not at all.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Folder of a data set (train, valid, test, metadata.json), one file of it, a folder of frames
    or of folders of frames, or a checkpoint."""
    dest: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DEST")]
    """Folder for a data set, else a file."""
    to: Target | None = None
    """Format of DEST; None: by its ending, h5 for a folder."""
    dim: Literal[2, 3] | None = None
    """Spatial dimensions of frames; None: that of metadata.json, else 2 where z is 0."""
    edge_update: EdgeUpdate | None = None
    """Of a geoelements/gns .pt, which doesn't tell: legacy if it was trained before pull request 94
    (December 2024), else fixed."""
    metadata: Path | None = None
    """Folder with the metadata.json of the data that a .pt was trained on; None: where it lies."""
    noise: float = 6.7e-4
    """Training noise of a .pt (length per frame)."""


def convert(config: ConvertConfig, console: Console) -> list[str]:
    """Converts as `config` says and returns what its user should know about the result.

    Raises:
        DataError: the source can't be read or expressed, or the destination is taken.
        CheckpointError: the same for checkpoints.
        OSError: the disk is full or the folder can't be written.
    """
    source, dest = config.source, config.dest
    if not source.exists():
        raise DataError(f"{source}: there is no such file or folder")
    refuse_taken(dest)
    if source.suffix == ".pt":
        _check_target(config, dest, (".safetensors",))
        return _import_checkpoint(config)
    if source.suffix == ".safetensors" or any((source / name).is_file() for name in (BEST, LAST)):
        _check_target(config, dest, (".pt",))
        return _export_checkpoint(source, dest)
    if source.is_dir() and not _is_frames(source):
        return _convert_folder(config, console)
    if source.is_file() and source.suffix not in _DATA:
        raise DataError(
            f"{source}: {', '.join((*_DATA, *_CHECKPOINTS))} files and folders are accepted"
        )
    suffix = _check_target(config, dest, (".h5", ".npz"))
    with progress_bar(console, "trajectories") as progress:
        _write(
            dest,
            suffix,
            _told(_open(source, config.dim, flatten=config.dim == 2), source.name, progress),
        )
    return []


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command with `argv`, or with the process's own arguments."""
    config = tyro.cli(ConvertConfig, args=argv, prog="python -m adaptgns.convert")
    with plain_errors():
        notes = convert(config, Console(stderr=True))
    print(f"{config.dest}: written")
    for note in notes:
        print(f"note: {note}")


def _check_target(config: ConvertConfig, dest: Path, accepted: tuple[str, ...]) -> str:
    """The ending of `dest`, which must be one of those accepted and agree with `--to`."""
    if dest.suffix not in accepted:
        raise DataError(
            f"{dest}: {config.source} can become a file that ends in {' or '.join(accepted)}"
        )
    if config.to is not None and f".{config.to}" != dest.suffix:
        raise DataError(f"to is {config.to}, but {dest} ends in {dest.suffix}")
    return dest.suffix


def _is_frames(folder: Path) -> bool:
    """Whether `folder` holds frames, or folders of frames that aren't named as splits."""
    if holds_frames(folder):
        return True
    names = {entry.name for entry in folder.iterdir() if holds_frames(entry)}
    spellings = {spelling for split in SPELLINGS.values() for spelling in split}
    return bool(names - spellings) and not any(_find(folder, split) for split in SPELLINGS)


def _find(folder: Path, split: str) -> Path | None:
    """What holds `split` in `folder`: a file, or a folder of frames or of folders of them."""
    found = find_split(folder, split)
    if found is not None:
        return found
    for spelling in SPELLINGS[split]:
        file, frames = folder / f"{spelling}.tfrecord", folder / spelling
        if file.is_file():
            return file
        if frames.is_dir():
            return frames
    return None


def _open(
    path: Path, dim: Literal[2, 3] | None, *, flatten: bool
) -> Trajectories | TfrecordFile | FrameFolders:
    """The trajectories in `path`; no more than one of them stays in memory."""
    if path.is_dir():
        return FrameFolders(path, dim=dim, flatten=flatten)
    if path.suffix == ".tfrecord":
        return TfrecordFile(path)
    kind = NpzSource if path.suffix == ".npz" else StoreSource
    return Trajectories(kind(path, cache_bytes=0))


def _told(
    trajectories: Trajectories | TfrecordFile | FrameFolders, name: str, progress: Progress
) -> Iterator[Trajectory]:
    task = progress.add_task(name, total=len(trajectories))
    for trajectory in trajectories:
        yield trajectory
        progress.advance(task)


def _write(path: Path, suffix: str, trajectories: Iterable[Trajectory]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    (write_npz if suffix == ".npz" else write_split)(path, trajectories)


def _convert_folder(config: ConvertConfig, console: Console) -> list[str]:
    source, dest = config.source, config.dest
    if config.to not in {None, "h5", "npz"}:
        raise DataError(f"to is {config.to}; h5 and npz are accepted for a data set")
    if dest.suffix in {*_DATA, *_CHECKPOINTS}:
        raise DataError(f"{dest}: the folder {source} can become a folder; got the name of a file")
    suffix = ".npz" if config.to == "npz" else ".h5"
    found = {split: path for split in SPELLINGS if (path := _find(source, split)) is not None}
    if not found:
        open_split(source, "train")  # its error says what the folder holds
    content = _content(source)
    dim = config.dim or (None if content is None else training_section(content).get("dim"))
    with folder_written_whole(dest) as partial:
        try:
            with progress_bar(console, "trajectories") as progress:
                for split, path in found.items():
                    trajectories = _told(_open(path, dim, flatten=config.dim == 2), split, progress)
                    _write(partial / f"{split}{suffix}", suffix, trajectories)
            if content is not None:
                return _write_metadata(partial, content, suffix)
        except DataError as error:  # which is the source's, though found in the copy
            raise DataError(str(error).replace(str(partial), str(source))) from error
        return [
            f"there is no {source / FILE_NAME}; write {dest / FILE_NAME} with dim, dt, bounds "
            "and default_connectivity_radius"
        ]


def _content(folder: Path) -> dict[str, Any] | None:
    path = folder / FILE_NAME
    if not path.exists():
        return None
    try:
        content = json.loads(path.read_bytes())
    except ValueError as error:
        raise DataError(f"{path}: not readable as JSON: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds a {type(content).__name__}; an object is accepted")
    return content


def _write_metadata(folder: Path, content: dict[str, Any], suffix: str) -> list[str]:
    """Writes the metadata of a converted data set: what there was and its readers need."""
    section = dict(training_section(content))
    write_metadata(folder, section)
    metadata = read_metadata(folder)  # computes missing statistics
    section = json.loads((folder / FILE_NAME).read_bytes())
    lengths = [
        set(open_split(folder, split).lengths.tolist())
        for split in SPELLINGS
        if find_split(folder, split)
    ]
    notes = []
    if suffix == ".npz":
        section |= _for_geoelements(metadata, sorted(set.union(*lengths)))
        if not set(metadata.kinematic_types) <= set(GNS_KINEMATIC):
            notes.append(
                f"particles of types {list(metadata.kinematic_types)} are kinematic here; "
                "geoelements/gns holds only those of type 3"
            )
        if any(metadata.periodic):
            notes.append("the data is periodic, which geoelements/gns doesn't know")
    else:
        section = {
            "write_every": 1,
            "periodic_boundary_conditions": list(metadata.periodic),
            "kinematic_types": list(metadata.kinematic_types),
        } | section | counts(folder)  # fmt: skip
        if any(len(of_split) > 1 for of_split in lengths):
            notes.append(
                "LagrangeBench takes all trajectories of a split to be as long as its first one"
            )
    if section.get("context_mean") is not None:
        kept = "is kept, but no model here takes it"
        dropped = "is dropped, since geoelements/gns has no place for it"
        notes.append(f"step_context {dropped if suffix == '.npz' else kept}")
    if isinstance(content.get("rollout"), dict):
        section["rollout"] = content["rollout"]
    write_metadata(folder, section)
    read_metadata(folder)
    return notes


def _for_geoelements(metadata: Metadata, lengths: list[int]) -> dict[str, Any]:
    """Its rollouts need the exact number of frames, or null where it differs; its network takes
    its input sizes from here where there is a material property."""
    own: dict[str, Any] = {"sequence_length": lengths[0] if len(lengths) == 1 else None}
    if metadata.material_properties:
        own["nnode_in"] = 7 * metadata.dim + 16 + metadata.material_properties
        own["nedge_in"] = metadata.dim + 1
    return own


def _import_checkpoint(config: ConvertConfig) -> list[str]:
    path = config.source
    if config.edge_update is None:
        raise CheckpointError(
            f"checkpoint {path}: geoelements/gns computes edges in two ways under the same names; "
            "say --edge-update legacy if it was trained before its pull request 94 (December "
            "2024), else --edge-update fixed"
        )
    folder = config.metadata or path.parent
    metadata = read_metadata(folder)
    clip = training_section(_content(folder) or {}).get("boundary_augment", 1.0)
    if clip != 1.0:
        raise CheckpointError(
            f"checkpoint {path}: {folder / FILE_NAME} says boundary_augment {clip}; 1 is accepted"
        )
    simulator = read_geoelements(path, metadata, noise=config.noise, edge_update=config.edge_update)
    step = re.fullmatch(r"model-(\d+)", path.stem)
    write_checkpoint(
        config.dest,
        Checkpoint(
            config=TrainConfig(
                data=str(folder), model=simulator.config, loss="mse", noise=config.noise
            ),
            metadata=simulator.metadata,
            step=int(step[1]) if step else 0,
            best_score=float("inf"),
            tensors=with_prefix("model", simulator.state_dict()),
        ),
    )
    return []


def _export_checkpoint(source: Path, dest: Path) -> list[str]:
    checkpoint = read_checkpoint(source)
    simulator = checkpoint.simulator()
    write_geoelements(dest, simulator)
    model = simulator.config
    notes = [
        f"run geoelements/gns with --noise_std={checkpoint.config.noise} and a metadata.json with "
        f"default_connectivity_radius {simulator.radius:g} and the statistics of "
        f"{checkpoint.config.data}"
    ]
    if simulator.network.variance_head is not None:
        notes.append("the variance head is left out: geoelements/gns predicts no sigma")
    if model.edge_update == "legacy":
        notes.append("edges are updated the old way: use geoelements/gns before pull request 94")
    if (model.latent, model.hidden_layers, model.steps) != (128, 2, 10):
        notes.append(
            f"its train.py builds latent 128, 2 layers and 10 steps; build {model.latent}, "
            f"{model.hidden_layers} and {model.steps}"
        )
    return notes


if __name__ == "__main__":
    main()
