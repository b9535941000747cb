"""Every block of the page about one's own data runs, in order, in one folder."""

from __future__ import annotations

import re
import shlex
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from adaptgns import convert, inspect, train
from adaptgns.checkpoint import Checkpoint, build_simulator, with_prefix, write_checkpoint
from adaptgns.config import ModelConfig, TrainConfig
from adaptgns.data import Trajectory, read_metadata
from adaptgns.data.npz_writer import write_npz

PAGE = Path(__file__).parents[2] / "docs" / "data.md"
COMMANDS = {"convert": convert.main, "inspect": inspect.main, "train": train.main}


def sources() -> None:
    """The files of others that the page names, as small as can be."""
    meshio = pytest.importorskip("meshio")
    Path("frames").mkdir()
    for frame in range(7):
        meshio.Mesh(np.full((4, 3), 0.1 + 0.1 * frame), []).write(f"frames/{frame}.ply")
    Path("DeepMind/WaterDrop").mkdir(parents=True)
    metadata = read_metadata(Path("my_data"))
    one = Trajectory("", np.random.default_rng(0).random((9, 5, 2), np.float32), np.zeros(5, int))
    write_npz(Path("DeepMind/WaterDrop/train.npz"), [one])
    Path("DeepMind/WaterDrop/metadata.json").write_text(Path("my_data/metadata.json").read_text())
    config = TrainConfig(model=ModelConfig(latent=8, steps=1), loss="mse")
    simulator = build_simulator(config, metadata)
    tensors = with_prefix("model", simulator.state_dict())
    write_checkpoint(
        Path("runs/my_run/best.safetensors"), Checkpoint(config, metadata, 0, 1.0, tensors)
    )
    convert.main(["runs/my_run", "model-400.pt"])
    Path("metadata.json").write_text(Path("my_data/metadata.json").read_text())


def test_every_block_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its own deprecations
        pytest.importorskip("torch_geometric")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```(\w+)\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    assert [kind for kind, _ in blocks].count("python") == 5
    scope: dict[str, object] = {}
    for kind, text in blocks:
        if kind == "python":
            exec(text, scope)
            continue
        if "DeepMind" in text:
            sources()
        for line in text.splitlines():
            words = shlex.split(line, comments=True)
            assert words[:2] == ["python", "-m"]
            COMMANDS[words[2].removeprefix("adaptgns.")](words[3:])
    assert read_metadata(tmp_path / "mixture").material_properties == 2
    tank = read_metadata(tmp_path / "tank")
    assert tank.periodic == (True, False)
    assert tank.velocity_mean[0] == pytest.approx(0.01, abs=1e-3)
    assert (tmp_path / "my_run" / "metrics.json").exists()
    assert torch.load(tmp_path / "model.pt", weights_only=True)
