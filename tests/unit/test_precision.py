"""The network in bf16 against the same in float32, and where the option reaches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from torch import Tensor

from adaptgns import _core, fused
from adaptgns.checkpoint import LAST, read_checkpoint
from adaptgns.config import Precision, RolloutConfig, TrainConfig
from adaptgns.rollout import write_rollouts
from adaptgns.rollout_file import RolloutFile
from tests.unit.test_fit import trainer
from tests.unit.test_fused import Case

QUIET = Console(quiet=True)


def off(values: Tensor, reference: Tensor) -> float:
    """The relative difference in the Euclidean norm."""
    return float((values - reference).norm() / reference.norm())


@pytest.mark.parametrize(
    "sizes",
    [{}, {"with_edges": False}, {"hidden_layers": 2, "latent": 33, "steps": 1}],
    ids=["with edges", "without", "deeper"],
)
@pytest.mark.parametrize("form", ["core", "torch"])
def test_bf16_is_float32_within_its_rounding(
    form: str, sizes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """bf16 rounds to 2^-9; three steps add up a few such errors in the outputs, and in the
    gradients, which go through them twice, some more."""
    asked: list[bool] = []
    for name in ("network_forward", "network_backward"):

        def spied(*arguments: Any, name: str = name, **options: Any) -> Any:
            asked.append(options["bf16"])
            return getattr(_core, name)(*arguments, **options)

        monkeypatch.setattr(fused, name, spied)
    if form == "torch":
        monkeypatch.setattr(fused, "applies", lambda _: False)
    case = Case(300, 2_000, **({"latent": 32, "steps": 3} | sizes))
    outputs = 2
    exact = case.run()
    case.network.precision = "bf16"
    rounded = case.run()
    assert asked == ([False, False, True, True] if form == "core" else [])
    assert all(tensor.dtype == torch.float32 for tensor in rounded)
    assert all(0 < off(a, b) < 0.01 for a, b in zip(rounded[:outputs], exact, strict=False))
    together, reference = (
        torch.cat([gradient.flatten() for gradient in run[outputs:]]) for run in (rounded, exact)
    )
    assert off(together, reference) < 0.03
    # None of them alone is wrong, as sums in bf16 are; most off are those of the features, small
    # and behind all maps of an encoder.
    maps = sizes.get("hidden_layers", 1) + 1
    for one, other in zip(rounded[outputs:], exact[outputs:], strict=True):
        assert off(one, other) < 0.075 * maps


def test_only_edges_and_products_are_in_bf16(monkeypatch: pytest.MonkeyPatch) -> None:
    """In torch's form, which GPUs take."""
    monkeypatch.setattr(fused, "applies", lambda _: False)
    case = Case()
    case.network.precision = "bf16"
    seen: dict[str, tuple[torch.dtype, ...]] = {}
    for name, module in case.network.named_modules():
        module.register_forward_hook(
            lambda _, given, out, name=name: (
                seen.update({name: (given[0].dtype, out.dtype)})
                if isinstance(out, Tensor)
                else None
            )
        )
    layer = case.network.layers[0]
    layer.register_forward_hook(
        lambda _, given, out: seen.update(step=(out[0].dtype, out[1].dtype))
    )
    case.run()
    low, full = torch.bfloat16, torch.float32
    assert seen["step"] == (full, low)  # nodes, edges
    assert seen["layers.0.node_mlp.0"][1] == low
    assert seen["layers.0.node_mlp.3"][1] == full  # the LayerNorm
    assert seen["decoder"] == seen["variance_head"] == (full, full)


def test_heads_of_the_core_are_in_float32() -> None:
    """Of numbers that bf16 has, an encoder gives the same either way; a head's do not fit in it."""
    rng = np.random.default_rng(0)
    bias = np.zeros(32, np.float32)
    encoder = [np.eye(32, dtype=np.float32), bias]
    head = [rng.random((2, 32), dtype=np.float32), bias[:2]]
    nodes = rng.integers(0, 100, (50, 32)).astype(np.float32)
    exact, rounded = (
        _core.network_forward([encoder, head], nodes, None, heads=1, keep=False, bf16=bf16)[0][0]
        for bf16 in (False, True)
    )
    np.testing.assert_allclose(exact, nodes @ head[0].T, rtol=1e-6)
    np.testing.assert_allclose(rounded, exact, rtol=1e-6)


def test_training_in_bf16_keeps_float32_and_rollouts_stay_close(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    run = trainer(drops, tmp_path, replace(small_config, precision="bf16"))
    assert run.simulator.network.precision == "bf16"
    run.run(QUIET)
    tensors = read_checkpoint(tmp_path / LAST).tensors
    assert any(name.startswith("optimizer.") for name in tensors)
    assert all(tensor.dtype == torch.float32 for tensor in tensors.values())

    def positions(precision: Precision) -> np.ndarray:
        out = tmp_path / f"{precision}.h5"
        options = RolloutConfig(tmp_path, out, steps=10, trajectories=1, precision=precision)
        write_rollouts(options, QUIET)
        with RolloutFile(out) as file:
            assert file.settings["precision"] == precision
            return np.array(file[0].predicted)

    exact, rounded = positions("float32"), positions("bf16")
    moved = np.abs(exact[-1] - exact[0]).mean()
    assert 0 < np.abs(rounded - exact).mean() < 0.01 * moved
