"""Checkpoints of geoelements/gns, read into a :class:`Simulator` and written from one.

Its ``state_dict`` holds the same network under other names.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from pickle import UnpicklingError

import torch
from torch import Tensor

from adaptgns.atomic import written_whole
from adaptgns.checkpoint import CheckpointError
from adaptgns.config import HISTORY, TYPE_EMBEDDING, EdgeUpdate, ModelConfig
from adaptgns.data.metadata import GNS_KINEMATIC, Metadata
from adaptgns.simulator import Simulator

_ROOT = "_encode_process_decode."
_BLOCKS = {
    "_encoder.node_fn.0.": "network.node_encoder.",
    "_encoder.node_fn.1.": "network.node_encoder.norm.",
    "_encoder.edge_fn.0.": "network.edge_encoder.",
    "_encoder.edge_fn.1.": "network.edge_encoder.norm.",
    "_decoder.node_fn.": "network.decoder.",
}


def _block(name: str) -> str:
    """Our name for the block of layers that the peer calls ``name``."""
    for theirs, ours in _BLOCKS.items():
        if name.startswith(theirs):
            return name.replace(theirs, ours)
    match = re.fullmatch(r"_processor\.gnn_stacks\.(\d+)\.(edge|node)_fn\.([01])\.(.*)", name)
    if match is None:
        raise KeyError(name)
    layer, kind, part, rest = match.groups()
    return f"network.layers.{layer}.{kind}_mlp." + ("norm." if part == "1" else "") + rest


def _our_name(name: str, linears: int) -> str:
    """Our name of the peer's tensor ``name``; every MLP has ``linears`` linear layers.

    The peer counts an MLP's linear layers NN-0, NN-1, ...; ours alternate with the activations and
    the normalization follows the last.
    """
    if name == "_particle_type_embedding.weight":
        return "type_embedding.weight"
    ours = _block(name.removeprefix(_ROOT))
    ours = ours.replace("norm.", f"{2 * linears - 1}.")
    return re.sub(r"NN-(\d+)\.", lambda m: f"{2 * int(m[1])}.", ours)


def read_geoelements(
    path: Path, metadata: Metadata, *, noise: float = 6.7e-4, edge_update: EdgeUpdate = "fixed"
) -> Simulator:
    """The simulator of a geoelements/gns checkpoint (``model-*.pt``, a ``state_dict``).

    ``metadata`` is that of the data it was trained on, and ``noise`` its training noise (length
    per frame), which widened the normalization. ``edge_update`` is legacy for a model trained
    before its pull request 94 (December 2024): the file doesn't tell. No pickled code is run.
    Raises :class:`CheckpointError` for a file that is something else.
    """
    try:
        theirs: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
        decoder = [n for n in theirs if n.startswith(_ROOT + "_decoder.") and n.endswith("weight")]
        layers = {n.split(".")[3] for n in theirs if n.startswith(_ROOT + "_processor.")}
        ours = {_our_name(name, len(decoder)): tensor for name, tensor in theirs.items()}
        config = ModelConfig(
            latent=theirs[_ROOT + "_decoder.node_fn.NN-0.weight"].shape[1],
            hidden_layers=len(decoder) - 1,
            steps=len(layers),
            edge_update=edge_update,
        )
        # One material property at most, which its metadata may not tell.
        inputs = theirs[_ROOT + "_encoder.node_fn.0.NN-0.weight"].shape[1]
        if inputs == (HISTORY - 1 + 2) * metadata.dim + TYPE_EMBEDDING + 1:
            metadata = replace(metadata, material_properties=1)
        simulator = Simulator(config, metadata, noise=noise, variance=False)
        simulator.load_state_dict(ours)
    except Exception as error:
        asked = re.search(r"GLOBAL (\S+)", str(error))
        if isinstance(error, UnpicklingError) and asked:
            raise CheckpointError(
                f"checkpoint {path}: refused, since it asks for the global {asked[1]}; a "
                "state_dict of tensors alone is accepted"
            ) from error
        # Where names or shapes don't fit, torch says so in a line and which in the next.
        first_lines = " ".join(" ".join(str(error).split("\n")[:2]).split())
        raise CheckpointError(
            f"checkpoint {path}: it is not a geoelements/gns state_dict that fits the metadata "
            f"({type(error).__name__}: {first_lines})"
        ) from error
    return simulator.eval()


def write_geoelements(path: Path, simulator: Simulator) -> None:
    """Write the ``state_dict`` that geoelements/gns loads for the same accelerations; the variance
    head, which it doesn't have, is left out.

    Raises :class:`CheckpointError`, naming the option, for a model that it can't express.
    """
    refusal = _difference(simulator)
    if refusal is not None:
        raise CheckpointError(f"{path}: geoelements/gns has no such model: {refusal}")
    ours = simulator.state_dict()
    linears = simulator.config.hidden_layers + 1
    names = _their_names(simulator.config, linears)
    theirs = {name: ours[_our_name(name, linears)].detach().cpu().clone() for name in names}
    with written_whole(path) as partial:
        torch.save(theirs, partial)


def _difference(simulator: Simulator) -> str | None:
    """The first option that geoelements/gns can't follow, in words."""
    metadata, config = simulator.metadata, simulator.config
    accepted = ModelConfig(
        latent=config.latent,
        hidden_layers=config.hidden_layers,
        steps=config.steps,
        radius=config.radius,
        edge_update=config.edge_update,
    )
    for name, value in vars(accepted).items():
        if getattr(config, name) != value:
            return f"model.{name} is {getattr(config, name)}; {value} is accepted"
    if any(metadata.periodic):
        return f"periodic is {list(metadata.periodic)}; open axes are accepted"
    if not set(metadata.kinematic_types) <= set(GNS_KINEMATIC):
        return f"kinematic_types are {list(metadata.kinematic_types)}; only 3 is accepted"
    if metadata.material_properties > 1:
        return f"material_properties is {metadata.material_properties}; 0 and 1 are accepted"
    return None


def _their_names(config: ModelConfig, linears: int) -> list[str]:
    """The peer's tensor names, in its order."""

    def mlp(prefix: str) -> list[str]:
        return [f"{prefix}NN-{i}.{kind}" for i in range(linears) for kind in ("weight", "bias")]

    def normed(prefix: str) -> list[str]:
        return [*mlp(f"{prefix}.0."), f"{prefix}.1.weight", f"{prefix}.1.bias"]

    blocks = ["_encoder.node_fn", "_encoder.edge_fn"]
    for layer in range(config.steps):
        blocks += [f"_processor.gnn_stacks.{layer}.{kind}_fn" for kind in ("node", "edge")]
    inner = [name for block in blocks for name in normed(block)] + mlp("_decoder.node_fn.")
    return ["_particle_type_embedding.weight", *(_ROOT + name for name in inner)]
