"""Checkpoints of geoelements/gns, read into a :class:`Simulator`.

Its ``state_dict`` holds the same network under other names.
"""

from __future__ import annotations

import re
from pathlib import Path

import torch
from torch import Tensor

from adaptgns.checkpoint import CheckpointError
from adaptgns.config import ModelConfig
from adaptgns.data.metadata import Metadata
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


def read_geoelements(path: Path, metadata: Metadata, *, noise: float = 6.7e-4) -> Simulator:
    """The simulator of a geoelements/gns checkpoint (``model-*.pt``, a ``state_dict``).

    ``metadata`` is that of the data it was trained on, and ``noise`` its training noise (length
    per frame), which widened the normalization. No pickled code is run. Raises
    :class:`CheckpointError` for a file that is something else.
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
        )
        simulator = Simulator(config, metadata, noise=noise, variance=False)
        simulator.load_state_dict(ours)
    except Exception as error:
        raise CheckpointError(
            f"checkpoint {path}: it is not a geoelements/gns state_dict that fits the metadata "
            f"({type(error).__name__}: {error})"
        ) from error
    return simulator.eval()
