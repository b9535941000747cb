"""Policies and stepping."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import get_args

import h5py
import numpy as np
import pytest
import torch
from rich.console import Console

from adaptgns.checkpoint import (
    BEST,
    Checkpoint,
    build_simulator,
    with_prefix,
    write_checkpoint,
)
from adaptgns.config import (
    AdaptiveConfig,
    Loss,
    ModelConfig,
    PolicyName,
    RolloutConfig,
    TrainConfig,
)
from adaptgns.data.errors import DataError
from adaptgns.data.metadata import Metadata, read_metadata, write_metadata
from adaptgns.data.trajectories import Trajectory, open_split
from adaptgns.policies import Adaptive, Edges, Fixed, State, make_policy
from adaptgns.rollout import Step, main, steps, write_rollouts
from adaptgns.rollout_file import RolloutFile
from adaptgns.simulator import Simulator

RULE = AdaptiveConfig(tau=70, factor=1.5)


@pytest.fixture
def simulator(metadata: Metadata) -> Simulator:
    torch.manual_seed(0)
    config = ModelConfig(latent=8, hidden_layers=1, steps=1)
    return Simulator(config, metadata, noise=0.0, variance=True).eval()


@pytest.fixture
def trajectory(drops: Path) -> Trajectory:
    return open_split(drops, "test")[0]


def still(simulator: Simulator) -> Simulator:
    """The simulator with a decoder that predicts an acceleration of zero."""
    last = simulator.network.decoder[-1]
    torch.nn.init.zeros_(last.weight)
    with torch.no_grad():
        last.bias.copy_(-simulator.acceleration_mean / simulator.acceleration_std)
    return simulator


def test_zero_acceleration_holds_the_velocity(simulator: Simulator, trajectory: Trajectory) -> None:
    rolled = list(steps(still(simulator), trajectory, Fixed(), 3))
    velocity = trajectory.positions[5] - trajectory.positions[4]
    expected = trajectory.positions[5] + velocity * np.arange(1, 4)[:, None, None]
    np.testing.assert_allclose([s.positions for s in rolled], expected, atol=1e-6)


def test_error_is_that_of_the_acceleration(simulator: Simulator, trajectory: Trajectory) -> None:
    (step,) = steps(still(simulator), trajectory, Fixed(), 1)
    true = np.diff(trajectory.positions[4:7].astype(np.float64), n=2, axis=0)[0]
    std = simulator.acceleration_std.numpy()
    expected = ((true / std) ** 2).sum(1)
    np.testing.assert_allclose(step.squared_error, expected, rtol=1e-2, atol=1e-6)


def test_adaptive_lags_by_one_step(simulator: Simulator, trajectory: Trajectory) -> None:
    fixed = list(steps(simulator, trajectory, Fixed(), 2, teacher_forcing=True))
    adaptive = list(steps(simulator, trajectory, Adaptive(RULE), 2, teacher_forcing=True))
    assert adaptive[0].edges == fixed[0].edges
    assert adaptive[1].edges > fixed[1].edges


def test_two_pass_expands_at_once(simulator: Simulator, trajectory: Trajectory) -> None:
    two_pass = make_policy("two-pass", RULE, k=0, seed=0)
    (fixed,) = steps(simulator, trajectory, Fixed(), 1)
    (both,) = steps(simulator, trajectory, two_pass, 1)
    assert both.edges > fixed.edges


def test_base_sigma_is_that_of_the_fixed_graph_one_step_ago(
    simulator: Simulator, trajectory: Trajectory
) -> None:
    fixed = list(steps(simulator, trajectory, Fixed(), 4, teacher_forcing=True))
    policy = make_policy("base-sigma", RULE, k=0, seed=0)
    seen: list[tuple[State, Edges]] = []

    class Spy:
        name, needs_sigma, looks_back = policy.name, policy.needs_sigma, policy.looks_back

        def edges(self, state: State) -> Edges:
            edges = policy.edges(state)
            seen.append((state, edges))
            return edges

    def spied(trajectory: Trajectory) -> None:
        seen.clear()
        list(steps(simulator, trajectory, Spy(), 4, teacher_forcing=True))
        first, edges = seen[0]
        np.testing.assert_array_equal(edges[0], first.base()[0])

    spied(trajectory)
    fed_back = False
    for before, (state, edges) in zip(fixed[:-1], seen[1:], strict=True):
        assert before.sigma is not None
        assert state.sigma is not None
        np.testing.assert_array_equal(edges[0], state.expanded(before.sigma, RULE)[0])
        assert edges[0].shape[1] > state.base()[0].shape[1]
        fed_back |= not np.array_equal(edges[0], state.expanded(state.sigma, RULE)[0])
    assert fed_back, "nothing tells it from the policy adaptive"
    # The same policy goes on with another rollout, of fewer particles.
    fewer = replace(
        trajectory,
        positions=trajectory.positions[:, 1:],
        particle_type=trajectory.particle_type[1:],
    )
    spied(fewer)


def test_random_is_seeded(simulator: Simulator, trajectory: Trajectory) -> None:
    def edges(seed: int) -> list[int]:
        policy = make_policy("random", RULE, k=0, seed=seed)
        return [s.edges for s in steps(simulator, trajectory, policy, 8, teacher_forcing=True)]

    assert edges(1) == edges(1) != edges(2)


@pytest.mark.parametrize("name", get_args(PolicyName))
def test_single_steps_now_and_then_are_those_of_all(
    simulator: Simulator, trajectory: Trajectory, name: PolicyName
) -> None:
    def forced(every: int) -> list[Step]:
        policy = make_policy(name, RULE, k=4, seed=0)
        return list(steps(simulator, trajectory, policy, 8, teacher_forcing=True, every=every))

    for one, other in zip(forced(1)[::3], forced(3), strict=True):
        assert one.edges == other.edges
        np.testing.assert_array_equal(one.positions, other.positions)
        np.testing.assert_array_equal(one.squared_error, other.squared_error)
    with pytest.raises(ValueError, match="every: got 2; accepted is 1, with teacher"):
        next(steps(simulator, trajectory, Fixed(), 8, every=2))


def test_knn_has_k_senders_each(simulator: Simulator, trajectory: Trajectory) -> None:
    (step,) = steps(simulator, trajectory, make_policy("knn", RULE, k=4, seed=0), 1)
    assert step.edges == 4 * len(trajectory.particle_type)


def brute_force(positions: np.ndarray, radii: np.ndarray) -> set[tuple[int, int]]:
    """Pairs no farther apart than the larger of their ends' radii."""
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    near = distance <= np.maximum(radii[:, None], radii[None])
    np.fill_diagonal(near, False)
    return set(zip(*map(list, np.nonzero(near)), strict=True))


def state_of(rng: np.random.Generator, **changes: object) -> State:
    start = rng.uniform(0.3, 0.4, (60, 1, 2))
    history = (start + rng.normal(0, 1e-3, (60, 6, 2)).cumsum(1)).astype(np.float32)
    given: dict = {
        "history": history,
        "sigma": rng.random(60).astype(np.float32),
        "mobile": np.arange(60) >= 10,
        "radius": 0.015,
        "self_edges": False,
        "box": None,
        "predict_sigma": None,
    }
    return State(**given | changes)


def pairs(edges: Edges) -> set[tuple[int, int]]:
    return set(zip(*edges[0].tolist(), strict=True))


def test_two_sided_cuts_where_it_is_sure_and_adds_where_it_is_not() -> None:
    state = state_of(np.random.default_rng(0))
    rule = AdaptiveConfig(tau=70, factor=1.5, low_tau=40, low_factor=0.6)
    assert state.sigma is not None
    low, high = np.percentile(state.sigma[10:], (40, 70))
    radii = np.full(60, 0.015)
    radii[10:][state.sigma[10:] < low] *= 0.6
    radii[10:][state.sigma[10:] > high] *= 1.5
    policy = make_policy("two-sided", rule, k=0, seed=0)
    found, base = pairs(policy.edges(state)), pairs(state.base())
    assert found == brute_force(state.positions, radii)
    assert found - base
    assert base - found
    assert pairs(policy.edges(replace(state, sigma=None))) == base
    one_sided = make_policy("adaptive", rule, k=0, seed=0)
    never_low = make_policy("two-sided", replace(rule, low_tau=0.0), k=0, seed=0)
    assert pairs(never_low.edges(state)) == pairs(one_sided.edges(state))


@pytest.mark.parametrize("name", ["acceleration", "divergence"])
def test_physical_priors_expand_what_moves_most(name: PolicyName) -> None:
    """Particles that alone are accelerated, or fly apart, see farther; a common motion is none."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(*[np.arange(12) * 0.01] * 2), -1).reshape(-1, 2) + 0.3
    time = np.arange(6)[:, None, None]
    moving = grid + time * [3e-3, 1e-3]
    chosen = rng.permutation(144)[:20] if name == "acceleration" else np.arange(20)
    away = grid[chosen] - grid[chosen].mean(0) if name == "divergence" else rng.normal(size=(20, 2))
    moving[-1, chosen] += 2e-2 * away if name == "divergence" else 2e-4 * away
    history = moving.transpose(1, 0, 2).astype(np.float32)
    state = state_of(rng, history=history, mobile=np.ones(144, bool), sigma=None)
    policy = make_policy(name, AdaptiveConfig(tau=80, factor=1.5), k=0, seed=0)
    extra = pairs(policy.edges(state)) - pairs(state.base())
    assert extra
    near = set(chosen.tolist())
    if name == "divergence":  # neighbours of what parts see it, too
        near |= {one for one, other in pairs(state.base()) if other in near}
    assert all(one in near or other in near for one, other in extra)
    assert not policy.needs_sigma


@pytest.mark.parametrize(
    "name",
    ["adaptive", "two-pass", "base-sigma", "random", "acceleration", "divergence"],
)
def test_every_policy_without_expansion_is_fixed(
    simulator: Simulator, trajectory: Trajectory, name: PolicyName
) -> None:
    policy = make_policy(name, AdaptiveConfig(tau=70, factor=1.0), k=0, seed=0)
    expected = [s.positions for s in steps(simulator, trajectory, Fixed(), 4)]
    np.testing.assert_array_equal(
        [s.positions for s in steps(simulator, trajectory, policy, 4)], expected
    )


def test_kinematic_particles_follow_their_trajectory(
    simulator: Simulator, trajectory: Trajectory
) -> None:
    types = trajectory.particle_type.copy()
    types[::3] = 3
    rolled = list(steps(simulator, replace(trajectory, particle_type=types), Fixed(), 5))
    predicted = np.stack([s.positions for s in rolled])
    np.testing.assert_array_equal(predicted[:, ::3], trajectory.positions[6:11, ::3])
    assert not np.array_equal(predicted[:, 1::3], trajectory.positions[6:11, 1::3])


def test_positions_that_are_lost_stay_lost(
    simulator: Simulator, trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    advance, calls = simulator.advance, 0

    def losing(*arguments: torch.Tensor) -> torch.Tensor:
        nonlocal calls
        calls += 1
        positions = advance(*arguments)
        return positions * torch.nan if calls == 3 else positions

    monkeypatch.setattr(simulator, "advance", losing)
    made = list(steps(simulator, trajectory, Adaptive(RULE), 6))
    assert [bool(np.isfinite(step.positions).all()) for step in made] == [True] * 2 + [False] * 4
    assert [step.edges for step in made[3:]] == [0, 0, 0]
    assert made[-1].sigma is not None
    assert calls == 3


def test_radius_changes_the_graph_alone(simulator: Simulator, trajectory: Trajectory) -> None:
    (narrow,) = steps(simulator, trajectory, Fixed(), 1)
    (wide,) = steps(simulator, trajectory, Fixed(), 1, radius=0.03)
    assert wide.edges > 2 * narrow.edges
    assert simulator.radius == 0.015


def test_variance_is_needed_by_two_pass(metadata: Metadata, trajectory: Trajectory) -> None:
    config = ModelConfig(latent=8, hidden_layers=1, steps=1)
    without = Simulator(config, metadata, noise=0.0, variance=False).eval()
    with pytest.raises(ValueError, match="needs the model's variance"):
        list(steps(without, trajectory, make_policy("two-pass", RULE, k=0, seed=0), 1))


def test_two_sides_may_meet_but_not_overlap() -> None:
    for policy in ("adaptive", "two-sided"):
        make_policy(policy, AdaptiveConfig(tau=30, low_tau=30), k=0, seed=0)
    overlapping = AdaptiveConfig(tau=20, low_tau=30)
    make_policy("adaptive", overlapping, k=0, seed=0)
    message = "low_tau: got 30; accepted for two-sided graphs are numbers up to tau, 20"
    with pytest.raises(ValueError, match=message):
        make_policy("two-sided", overlapping, k=0, seed=0)


def test_too_long_a_horizon_is_named(simulator: Simulator, trajectory: Trajectory) -> None:
    with pytest.raises(ValueError, match=r"count: .* has 40 frames, so 1 to 34 steps.*got 35"):
        list(steps(simulator, trajectory, Fixed(), 35))


@pytest.mark.parametrize(
    ("edges", "loss", "policy", "message"),
    [
        (True, "mse", "adaptive", "policy: got adaptive, which needs the model's variance"),
        (True, "mse", "random", "policy: got random, which needs the model's variance"),
        (False, "nll", "knn", "policy: got knn; this model has no edges"),
    ],
)
def test_a_policy_that_the_model_cannot_follow_is_refused(
    drops: Path, tmp_path: Path, edges: bool, loss: Loss, policy: PolicyName, message: str
) -> None:
    model = ModelConfig(latent=8, hidden_layers=1, steps=1, edges=edges)
    config = TrainConfig(data=str(drops), model=model, loss=loss)
    metadata = read_metadata(drops)
    weights = with_prefix("model", build_simulator(config, metadata).state_dict())
    write_checkpoint(tmp_path / BEST, Checkpoint(config, metadata, 0, 0.0, weights))
    out = tmp_path / "rollout.h5"
    with pytest.raises(ValueError, match=message):
        write_rollouts(
            RolloutConfig(checkpoint=tmp_path, out=out, policy=policy), Console(quiet=True)
        )
    assert not out.exists()


def test_wrong_options_are_told_plainly(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["--checkpoint", "run", "--out", "x.h5", "--steps", "0"])
    assert exit_.value.code == 2
    assert "steps: got 0; accepted are whole numbers >= 1" in capsys.readouterr().err


def test_data_must_suit_the_model(drops: Path, tmp_path: Path) -> None:
    metadata = read_metadata(drops)
    assert metadata.suited(drops, "test") == (metadata, [])
    for change, told in (
        ({"periodic": (True, False)}, "periodic is (False, False); the model was"),
        ({"material_properties": 1}, "material_properties is 0; the model was trained with 1"),
    ):
        with pytest.raises(DataError, match=re.escape(told)):
            replace(metadata, **change).suited(drops, "test")
    faster = replace(metadata, dt=0.01, velocity_std=(1.0, 1.0))
    assert faster.suited(drops, "test") == (
        faster,
        [f"{drops}: dt is {metadata.dt}; the model goes by 0.01, with which it was trained"],
    )
    same, (note,) = metadata.suited(tmp_path, "test")
    assert same == metadata
    assert "there is no metadata.json" in note


def test_what_is_wrong_with_other_bounds_is_told_with_its_file(drops: Path, tmp_path: Path) -> None:
    metadata = read_metadata(drops)
    content = json.loads((drops / "metadata.json").read_text())
    del content["default_connectivity_radius"]  # which a rollout does not need
    write_metadata(tmp_path, content)
    assert metadata.suited(tmp_path, "test") == (metadata, [])
    write_metadata(tmp_path, content | {"rollout": {"bounds": [[0, 1]]}})
    assert metadata.suited(tmp_path, "valid") == (metadata, [])
    with pytest.raises(DataError, match=r"metadata\.json, for test: bounds has 1 axes; dim is 2"):
        metadata.suited(tmp_path, "test")


@pytest.mark.parametrize("apart", [False, True])
def test_walls_are_those_of_the_data(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], apart: bool
) -> None:
    """``apart``: in geoelements/gns' section for the test data."""
    content = json.loads((drops / "metadata.json").read_text())
    wider = content | {"bounds": [[0.1, 1.7], [0.1, 0.9]]}
    other = tmp_path / "other"
    shutil.copytree(drops, other)
    with h5py.File(other / "test.h5", "r+") as file:
        for trajectory in file.values():  # through the wall, if there were one
            time = np.arange(len(trajectory["position"]))[:, None]
            trajectory["position"][..., 0] = trajectory["position"][:1, :, 0] + 0.03 * time
    write_metadata(other, {"train": content, "rollout": wider} if apart else wider)
    options = ["--checkpoint", "waterdrop", "--data", str(other), "--trajectories", "1"]
    farthest = []
    for split in ("test", "valid"):
        out = tmp_path / f"{split}.h5"
        main([*options, "--split", split, "--out", str(out)])
        told = "bounds are ((0.1, 1.7), (0.1, 0.9)); the model was trained in ((0.1, 0.9)"
        assert (told in capsys.readouterr().out) == (split == "test" or not apart)
        with RolloutFile(out) as file:
            farthest.append(file[0].predicted[..., 0].max())
            assert (file.metadata.bounds[0][1] == 1.7) == (split == "test" or not apart)
    assert farthest[0] > 0.95
    assert farthest[1] <= 0.9


def test_what_the_model_takes_otherwise_is_told(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads((drops / "metadata.json").read_text())
    other = tmp_path / "other"
    other.mkdir()
    (other / "test.h5").write_bytes((drops / "test.h5").read_bytes())
    kept = {name: value for name, value in content.items() if not name.endswith(("_mean", "_std"))}
    write_metadata(other, kept | {"default_connectivity_radius": 0.02})
    options = ["--checkpoint", "waterdrop", "--data", str(other), "--trajectories", "1"]
    main([*options, "--steps", "2", "--out", str(tmp_path / "r.h5")])
    assert "note: " in (out := capsys.readouterr().out)
    assert "radius is 0.02; the model goes by 0.015" in out
    assert "vel_std" not in json.loads((other / "metadata.json").read_text())
    write_metadata(other, content | {"periodic_boundary_conditions": [True, False]})
    with pytest.raises(SystemExit):
        main([*options, "--out", str(tmp_path / "s.h5")])
    assert "periodic is (True, False)" in capsys.readouterr().err


def test_types_that_the_model_was_not_trained_on_are_told(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for model, told in (("sand", True), ("waterdrop", False)):
        options = ["--checkpoint", model, "--data", str(drops), "--trajectories", "2"]
        main([*options, "--split", "train", "--steps", "1", "--out", str(tmp_path / model)])
        message = "has particles of type 5; the model was trained on type 6 alone"
        assert capsys.readouterr().out.count(message) == told


def test_what_a_model_was_trained_at_is_in_its_name(
    drops: Path, tmp_path: Path, small_config: TrainConfig
) -> None:
    metadata = read_metadata(drops)
    labels = []
    for radius in (None, 0.02):
        model = replace(small_config.model, radius=radius)
        config = replace(small_config, model=model, data=str(drops))
        tensors = with_prefix("model", build_simulator(config, metadata).state_dict())
        write_checkpoint(tmp_path / BEST, Checkpoint(config, metadata, 1, 0.1, tensors))
        out = tmp_path / f"{radius}.h5"
        write_rollouts(RolloutConfig(tmp_path, out, steps=1, device="cpu"), Console(quiet=True))
        with RolloutFile(out) as file:
            labels.append(file.label)
    assert labels == ["GNS nll", "GNS nll, trained at r = 0.02"]


def test_other_material_properties_than_the_models_are_refused(
    simulator: Simulator, trajectory: Trajectory
) -> None:
    other = replace(
        trajectory, material_property=np.zeros((len(trajectory.particle_type), 2), np.float32)
    )
    with pytest.raises(ValueError, match="has 2 material properties; this model was trained on 0"):
        next(steps(simulator, other, Fixed(), 1))


def test_a_horizon_behind_the_end_of_the_data_is_told(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--checkpoint", "waterdrop", "--data", str(drops), "--trajectories", "1"]
    for steps_asked, told in (("35", True), ("34", False)):
        main([*options, "--steps", steps_asked, "--out", str(tmp_path / f"{steps_asked}.h5")])
        ends = "1 of 1 trajectories end before step 35" in capsys.readouterr().out
        assert ends == told


def test_more_neighbours_than_particles_are_refused_at_once(
    drops: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.h5"
    options = ["--checkpoint", "waterdrop", "--data", str(drops), "--policy", "knn", "--k", "500"]
    with pytest.raises(SystemExit):
        main([*options, "--out", str(out)])
    told = capsys.readouterr().err
    assert re.search(r"k: got 500; trajectory \d+ of .*test\.h5 has \d+ particles", told)
    assert not out.exists()


def test_a_file_that_is_there_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rollout.h5"
    out.write_bytes(b"dear")
    with pytest.raises(SystemExit):
        main(["--checkpoint", "run", "--out", str(out)])
    assert "is there already" in capsys.readouterr().err
    assert out.read_bytes() == b"dear"
