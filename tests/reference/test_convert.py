"""Conversions of files that other programs wrote."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from adaptgns.checkpoint import read_checkpoint
from adaptgns.convert import main
from adaptgns.data import open_split, read_metadata
from adaptgns.data.trajectories import SPLITS
from adaptgns.policies import Fixed
from adaptgns.rollout import steps
from adaptgns.segment import Graph
from adaptgns.simulator import Simulator
from adaptgns.train import main as train
from tests.conftest import graph_of


@pytest.mark.parametrize("to", ["h5", "npz"])
def test_tensorflow_s_file(shared: Path, tmp_path: Path, to: str) -> None:
    """It holds the first 121 frames of two trajectories that are there as npz, too."""
    main([str(shared / "data" / "tfrecord_water"), str(tmp_path / "out"), "--to", to])
    converted = open_split(tmp_path / "out", "test")
    for one, other in zip(
        converted, open_split(shared / "data" / "taichi_water", "test"), strict=True
    ):
        assert one.positions.tobytes() == other.positions[:121].tobytes()
        np.testing.assert_array_equal(one.particle_type, other.particle_type)


@pytest.mark.parametrize("name", ["taichi_water", "lagrangebench_lj3d"])
def test_there_and_back(shared: Path, tmp_path: Path, name: str) -> None:
    source = shared / "data" / name
    main([str(source), str(tmp_path / "h5")])
    main([str(tmp_path / "h5"), str(tmp_path / "npz"), "--to", "npz"])
    for split in SPLITS:
        for folder in ("h5", "npz"):
            pairs = zip(
                open_split(tmp_path / folder, split), open_split(source, split), strict=True
            )
            for one, other in pairs:
                assert one.positions.tobytes() == other.positions.tobytes()
                np.testing.assert_array_equal(one.particle_type, other.particle_type)
    assert read_metadata(tmp_path / "h5") == read_metadata(source)


def test_layout_is_that_of_lagrangebench_s_own_file(shared: Path, tmp_path: Path) -> None:
    source = shared / "data" / "lagrangebench_lj3d"
    main([str(source), str(tmp_path / "out")])
    with h5py.File(source / "train.h5") as theirs, h5py.File(tmp_path / "out" / "train.h5") as ours:
        assert list(ours) == list(theirs)
        assert sorted(ours["00000"]) == sorted(theirs["00000"])
        assert ours["00000/position"].dtype == theirs["00000/position"].dtype
        assert ours["00000/particle_type"].dtype.kind == theirs["00000/particle_type"].dtype.kind
    theirs, ours = (
        json.loads((folder / "metadata.json").read_text()) for folder in (source, tmp_path / "out")
    )
    assert theirs.items() <= ours.items()


def test_periodic_data_trains_and_rolls_out(shared: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    train(["--preset", "smoke", "--data", str(shared / "data" / "lagrangebench_lj3d"),
           "--out", str(out), "--steps", "5", "--test-horizon", "20"])  # fmt: skip
    with h5py.File(out / "rollouts" / "fixed.h5") as file:
        predicted = file["00000/predicted"][()]
    assert predicted.shape == (20, 3, 3)
    assert ((predicted >= 0) & (predicted <= 5)).all()


# --- geoelements/gns ---------------------------------------------------------------------------


def plain(theirs: dict[str, Tensor], simulator: Simulator, window: Tensor, graph: Graph,
          *, legacy: bool) -> Tensor:  # fmt: skip
    """The peer's forward pass by hand, from the tensors under its names."""

    def net(name: str, x: Tensor, *, norm: bool = True) -> Tensor:
        block = f"_encode_process_decode.{name}." + ("0." if norm else "")
        for layer in range(3):
            weight, bias = (theirs[f"{block}NN-{layer}.{kind}"] for kind in ("weight", "bias"))
            x = functional.linear(x, weight, bias)
            x = x if layer == 2 else x.relu()
        if not norm:
            return x
        scale, shift = (theirs[f"_encode_process_decode.{name}.1.{k}"] for k in ("weight", "bias"))
        return functional.layer_norm(x, x.shape[1:], scale, shift)

    nodes = net(
        "_encoder.node_fn", simulator.node_features(window, torch.zeros(len(window)).long())
    )
    edges = net("_encoder.edge_fn", simulator.edge_features(window, graph))
    for layer in range(10):
        name = f"_processor.gnn_stacks.{layer}"
        ends = [nodes[graph.receivers], nodes[graph.senders], edges]
        messages = net(f"{name}.edge_fn", torch.cat(ends, dim=1))
        summed = torch.zeros_like(nodes).index_add(0, graph.receivers, messages)
        nodes = nodes + net(f"{name}.node_fn", torch.cat([summed, nodes], dim=1))
        edges = edges + (edges if legacy else messages)
    return net("_decoder.node_fn", nodes, norm=False)


@pytest.fixture
def peer(shared: Path) -> Path:
    return shared / "peer" / "geoelements_gns"


@pytest.mark.parametrize("edge_update", ["fixed", "legacy"])
def test_checkpoint_in_and_out(peer: Path, tmp_path: Path, edge_update: str) -> None:
    saved = tmp_path / "m.safetensors"
    main([str(peer / "model-400.pt"), str(saved), "--edge-update", edge_update])
    checkpoint = read_checkpoint(saved)
    assert checkpoint.step == 400
    simulator = checkpoint.simulator()
    theirs = torch.load(peer / "model-400.pt", weights_only=True)

    record = np.load(peer / "rollout.npz")
    window = torch.from_numpy(record["initial_positions"]).transpose(0, 1)
    graph = graph_of(record["initial_positions"][-1], simulator.radius)
    types = torch.zeros(len(window), dtype=torch.int64)
    with torch.no_grad():
        ours = simulator(window, types, graph).acceleration
        by_hand = {
            legacy: plain(theirs, simulator, window, graph, legacy=legacy)
            for legacy in (False, True)
        }
    torch.testing.assert_close(ours, by_hand[edge_update == "legacy"], rtol=1e-4, atol=1e-5)
    assert (ours - by_hand[edge_update != "legacy"]).abs().max() > 1e-2

    main([str(saved), str(tmp_path / "out.pt")])
    back = torch.load(tmp_path / "out.pt", weights_only=True)
    assert list(back) == list(theirs)
    assert all(torch.equal(back[name], theirs[name]) for name in theirs)


@pytest.mark.parametrize(("edge_update", "follows"), [("fixed", True), ("legacy", False)])
def test_the_recorded_rollout_is_of_the_fixed_kind(
    peer: Path, shared: Path, tmp_path: Path, edge_update: str, follows: bool
) -> None:
    saved = tmp_path / "m.safetensors"
    main([str(peer / "model-400.pt"), str(saved), "--edge-update", edge_update])
    record = np.load(peer / "rollout.npz")
    # Trajectory 1 of test.npz from frame 20 on.
    trajectory = open_split(shared / "data" / "taichi_water", "test").window(1, 20, 86)
    simulator = read_checkpoint(saved).simulator()
    for index, step in enumerate(steps(simulator, trajectory, Fixed(), 5)):
        deviation = np.abs(step.positions - record["predicted_rollout"][index]).max()
        assert (deviation < 1e-6) == follows


def test_a_changed_peer_file_is_refused(
    peer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copyfile(peer / "metadata.json", tmp_path / "metadata.json")
    content = (peer / "model-400.pt").read_bytes()
    (tmp_path / "model-400.pt").write_bytes(content[: len(content) // 2])
    with pytest.raises(SystemExit):
        main(
            [
                str(tmp_path / "model-400.pt"),
                str(tmp_path / "o.safetensors"),
                "--edge-update",
                "fixed",
            ]
        )
    assert "model-400.pt: it is not a geoelements/gns state_dict" in capsys.readouterr().err
    assert not (tmp_path / "o.safetensors").exists()
