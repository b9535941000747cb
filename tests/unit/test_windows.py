"""Training samples: order, noise, targets and graphs."""

from __future__ import annotations

import itertools
import pickle
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch

from adaptgns import threads
from adaptgns.config import TrainConfig
from adaptgns.data.metadata import read_metadata
from adaptgns.data.trajectories import open_split
from adaptgns.simulator import Simulator
from adaptgns.threads import thread_count
from adaptgns.windows import Batch, Sample, ShuffledKeys, Windows, training_batches


@pytest.fixture
def windows(drops: Path, small_config: TrainConfig) -> Windows:
    return Windows(open_split(drops, "train"), read_metadata(drops), small_config, noise=3e-4)


def keys(first: int, last: int, most: int | None = None) -> list[list[tuple[int, int]]]:
    particles = np.array([5, 9, 2, 4, 4, 1, 7])
    batches = ShuffledKeys(particles, batch=3, most=most, seed=1, first=first, last=last)
    assert len(batches) == last - first
    return list(batches)


def test_every_window_once_an_epoch_and_any_start_gives_the_same_order() -> None:
    batches = keys(0, 7)
    counts = Counter(key for batch in batches for key in batch)
    assert counts == {(epoch, number): 1 for epoch in range(3) for number in range(7)}
    assert keys(4, 7) == batches[4:]
    order = [number for batch in batches for _, number in batch]
    assert order[:7] != order[7:14]


def test_batches_keep_to_their_particles() -> None:
    particles = [5, 9, 2, 4, 4, 1, 7]
    batches = keys(0, 12, most=8)
    assert keys(5, 12, most=8) == batches[5:]
    sizes = [[particles[number] for _, number in batch] for batch in batches]
    assert all(len(batch) == 1 or sum(batch) <= 8 for batch in sizes)
    assert {len(batch) for batch in sizes} == {1, 2, 3}
    for batch, following in itertools.pairwise(sizes):
        assert len(batch) == 3 or sum(batch) + following[0] > 8


def test_samples_depend_on_seed_epoch_and_number_alone(windows: Windows) -> None:
    assert np.array_equal(windows[0, 5].positions, windows[0, 5].positions)
    assert not np.array_equal(windows[0, 5].positions, windows[1, 5].positions)
    assert not np.array_equal(windows[0, 5].positions, windows[0, 6].positions)


def test_noise_moves_the_following_position_with_the_last(windows: Windows) -> None:
    noisy = windows[0, 5].positions
    clean = Windows(windows.trajectories, windows.metadata, windows.config, noise=0.0)[
        0, 5
    ].positions
    noise = noisy - clean
    assert (noise[0] == 0).all()
    assert np.abs(noise[1:]).min() > 0
    np.testing.assert_allclose(noise[-1], noise[-2], atol=1e-7)


def test_target_undoes_the_noise_of_the_last_velocity(windows: Windows) -> None:
    simulator = Simulator(windows.config.model, windows.metadata, noise=3e-4, variance=True)
    batch = windows.collate([windows[0, 5]])
    advanced = simulator.advance(
        batch.window, simulator.target(batch.window, batch.following[:, 0])
    )
    clean = Windows(windows.trajectories, windows.metadata, windows.config, noise=0.0)
    after = clean.collate([clean[0, 5]])
    noise = batch.window[:, -1] - after.window[:, -1]
    torch.testing.assert_close(advanced - noise, after.following[:, 0], rtol=0, atol=3e-7)


def test_kinematic_particles_carry_no_noise(windows: Windows) -> None:
    all_kinematic = replace(windows.metadata, kinematic_types=(5,))
    config = replace(windows.config, drift=3e-5, compression=0.2)
    still = Windows(windows.trajectories, all_kinematic, config, noise=3e-4)
    clean = Windows(windows.trajectories, windows.metadata, windows.config, noise=0.0)
    assert np.array_equal(still[0, 5].positions, clean[0, 5].positions)
    assert not still.collate([still[0, 5]]).mobile.any()


def test_mirrored_samples_stay_in_the_box(windows: Windows) -> None:
    config = replace(windows.config, mirror=True)
    mirrored = Windows(windows.trajectories, windows.metadata, config, noise=0.0)
    plain = Windows(windows.trajectories, windows.metadata, windows.config, noise=0.0)
    changed = 0
    for number in range(20):
        a, b = mirrored[0, number].positions, plain[0, number].positions
        np.testing.assert_array_equal(a[..., 1], b[..., 1])
        if not np.array_equal(a, b):
            np.testing.assert_allclose(a[..., 0] + b[..., 0], 1.0, atol=1e-6)
            changed += 1
    assert 3 <= changed <= 17


def test_batches_join_unequal_samples_without_edges_between(windows: Windows) -> None:
    lengths = windows.starts
    batch = windows.collate([windows[0, 0], windows[0, int(lengths[1])]])
    first = windows[0, 0].positions.shape[1]
    assert batch.ptr.tolist() == [0, first, len(batch.particle_type)]
    assert batch.graph is not None
    assert ((batch.graph.senders < first) == (batch.graph.receivers < first)).all()
    distance = (
        batch.window[batch.graph.senders, -1] - batch.window[batch.graph.receivers, -1]
    ).norm(dim=1)
    assert distance.max() <= windows.metadata.radius * (1 + 1e-5)


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_number_of_workers_changes_nothing(windows: Windows) -> None:
    def frames(workers: int) -> list[torch.Tensor]:
        config = replace(windows.config, workers=workers, steps=5)
        return [batch.frames for batch in training_batches(windows, config, 0, pin=False)]

    alone, shared = frames(0), frames(2)
    assert len(alone) == 5
    for a, b in zip(alone, shared, strict=True):
        assert torch.equal(a, b)


class ThreadCounts(Windows):
    """Instead of batches: how many threads the core may use where they are made."""

    def collate_share(self, samples: Sequence[Sample]) -> int:  # type: ignore[override]
        return thread_count()


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_worker_is_one_thread(
    drops: Path, small_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threads, "_count", 3)
    windows = ThreadCounts(open_split(drops, "train"), read_metadata(drops), small_config, noise=0)
    for workers, count in ((0, 3), (1, 1)):
        config = replace(small_config, workers=workers, steps=2)
        assert list(training_batches(windows, config, 0, pin=False)) == [count, count]


def test_a_batch_reaches_another_process_whole_and_as_bytes(windows: Windows) -> None:
    batch: Batch = windows.collate([windows[0, 3], windows[0, 9]])
    sent = bytes(ForkingPickler.dumps(batch))
    assert len(sent) > batch.frames.nbytes  # no handle of memory that stays where it is
    received: Batch = pickle.loads(sent)
    assert batch.graph is not None
    assert received.graph is not None
    for one, other in ((batch, received), (batch.graph, received.graph)):
        for name, part in vars(one).items():
            if isinstance(part, torch.Tensor):
                assert torch.equal(part, getattr(other, name)), name
    assert received.ahead == batch.ahead
    received.frames.zero_()  # it is the receiver's own
    assert batch.frames.any()


def test_offsets_stay_where_graphs_are_built(windows: Windows) -> None:
    batch: Batch = windows.collate([windows[0, 3]])
    moved = batch.to(torch.device("meta"))
    assert batch.graph is not None
    assert moved.graph is not None
    assert moved.frames.device.type == moved.graph.senders.device.type == "meta"
    assert moved.ptr is batch.ptr


def test_adaptive_training_reads_one_frame_more(windows: Windows) -> None:
    config = replace(windows.config, graph="adaptive")
    longer = Windows(windows.trajectories, windows.metadata, config, noise=0.0)
    batch: Batch = longer.collate([longer[0, 3]])
    assert batch.frames.shape[1] == 8
    assert torch.equal(batch.earlier_window[:, 1:], batch.window[:, :-1])
    assert len(longer) == len(windows) - len(windows.trajectories)


def test_corrections_undo_their_share(windows: Windows) -> None:
    config = replace(windows.config, position_correction=0.25, velocity_correction=0.4)
    corrected, plain, clean = (
        Windows(windows.trajectories, windows.metadata, c, noise=noise)[0, 5].positions
        for c, noise in ((config, 3e-4), (windows.config, 3e-4), (windows.config, 0.0))
    )
    np.testing.assert_array_equal(corrected[:-1], plain[:-1])
    noise = plain - clean
    np.testing.assert_allclose(
        corrected[-1] - clean[-1],
        0.75 * noise[-2] + 0.6 * (noise[-2] - noise[-3]),
        atol=2e-7,
    )


def test_several_frames_follow_and_undo_the_noise_further(windows: Windows) -> None:
    shares = replace(windows.config, unroll=3, position_correction=0.25, velocity_correction=0.4)
    noisy, clean = (
        Windows(windows.trajectories, windows.metadata, shares, noise=noise)
        for noise in (3e-4, 0.0)
    )
    batch = noisy.collate([noisy[0, 3]])
    assert batch.following.shape[1] == 3
    assert torch.equal(batch.following[:, 0], batch.frames[:, 6])
    assert len(noisy) == len(windows) - 2 * len(windows.trajectories)
    offsets = noisy[0, 3].positions - clean[0, 3].positions
    velocities = np.diff(offsets, axis=0)
    for frame in (6, 7, 8):
        undone = 0.6 * velocities[frame - 2] - 0.25 * offsets[frame - 1]
        np.testing.assert_allclose(velocities[frame - 1], undone, atol=3e-7)


def test_compression_moves_all_frames_alike_and_the_target_answers(windows: Windows) -> None:
    config = replace(windows.config, compression=0.2)
    compressed = Windows(windows.trajectories, windows.metadata, config, noise=3e-4)
    difference = compressed[0, 5].positions - windows[0, 5].positions
    displacement = difference[0]
    assert np.abs(displacement).max() > 1e-4
    for frame in difference[1:-1]:
        np.testing.assert_allclose(frame, displacement, rtol=0, atol=1e-6)
    answer = difference[-1] - displacement
    assert (answer * displacement).sum() < 0


@pytest.mark.parametrize("graph", ["base", "adaptive"])
def test_drift_is_shared_and_leaves_the_last_velocity(
    windows: Windows, graph: Literal["base", "adaptive"]
) -> None:
    plain = replace(windows.config, graph=graph)
    clean, drifted = (
        Windows(windows.trajectories, windows.metadata, config, noise=0.0)[0, 5].positions
        for config in (plain, replace(plain, drift=1e-3))
    )
    difference = drifted - clean
    assert np.array_equal(drifted[-3:], clean[-3:])
    assert (np.abs(difference[:-3]).max((1, 2)) > 1e-5).all()
    np.testing.assert_allclose(difference, difference[:, :1].repeat(len(clean[0]), 1), atol=1e-6)


def test_processes_share_every_batch() -> None:
    sizes = np.full(50, 10)
    alone = ShuffledKeys(sizes, batch=5, most=None, seed=3, first=2, last=15)
    shares = [
        ShuffledKeys(sizes, batch=5, most=None, seed=3, first=2, last=15, rank=rank, processes=7)
        for rank in range(7)
    ]
    for whole, *parts in zip(alone, *shares, strict=True):
        assert sorted(whole) == sorted(key for part in parts for key in part)
        assert sum(not part for part in parts) == 2
