"""The embedded data generator as Python sees it; its physics is tested in Rust."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from adaptgns._core import simulate

SMALL = (60, 120)
GRAVITY_PER_FRAME = 9.81 * 0.0025**2


@pytest.mark.parametrize(("scene", "particle_type"), [("waterdrop", 5), ("sand", 6)])
@pytest.mark.parametrize("dim", [2, 3])
def test_shapes_types_and_bounds(scene: str, particle_type: int, dim: int) -> None:
    positions, types = simulate(scene, seed=1, frames=40, dim=dim, particles=SMALL)
    count = positions.shape[1]
    assert positions.shape == (40, count, dim)
    assert SMALL[0] <= count <= SMALL[1]
    assert positions.dtype == np.float32
    assert positions.flags.c_contiguous
    assert positions.min() >= 0.1
    assert positions.max() <= 0.9
    assert types.dtype == np.int64
    np.testing.assert_array_equal(types, np.full(count, particle_type))


def test_most_scenes_begin_in_free_fall() -> None:
    accelerations = []
    for seed in range(20):
        positions = simulate("waterdrop", seed=seed, frames=4, particles=SMALL)[0]
        changes = np.diff(positions.astype(np.float64), n=2, axis=0)
        accelerations.append(np.median(changes, axis=(0, 1)))
    typical = np.median(accelerations, axis=0)
    np.testing.assert_allclose(typical, [0, -GRAVITY_PER_FRAME], atol=1e-7)


def test_same_in_every_thread() -> None:
    def make(seed: int) -> np.ndarray:
        return simulate("sand", seed=seed, frames=20, particles=SMALL)[0]

    alone = [make(seed) for seed in range(4)]
    with ThreadPoolExecutor(4) as pool:
        for seed, positions in enumerate(pool.map(make, list(range(4)) * 3)):
            np.testing.assert_array_equal(positions, alone[seed % 4])
    assert alone[0].shape != alone[1].shape or not np.array_equal(alone[0], alone[1])


def test_large_seeds_are_accepted_and_differ() -> None:
    first, last = (
        simulate("waterdrop", seed=seed, frames=1, particles=(64, 64))[0] for seed in (0, 2**64 - 1)
    )
    assert not np.array_equal(first, last)


def test_the_gil_is_free_while_it_runs() -> None:
    """Another thread counts on during the call; with the GIL held it could not."""
    running, started = threading.Event(), threading.Event()
    counts = [0]

    def count() -> None:
        started.set()
        while not running.is_set():
            counts[0] += 1

    counter = threading.Thread(target=count)
    counter.start()
    started.wait()
    before = counts[0]
    simulate("waterdrop", seed=0, frames=300, particles=(300, 300))
    during = counts[0] - before
    running.set()
    counter.join()
    assert during > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scene": "lava"}, r"scene: got 'lava', accepted are 'waterdrop', 'sand'"),
        ({"frames": 0}, "frames: got 0"),
        ({"dim": 4}, "dim: got 4, accepted are 2 and 3"),
        ({"particles": (8, 100)}, r"particles: got \(8, 100\), accepted is 16 <= low"),
        ({"particles": (100, 50)}, r"particles: got \(100, 50\)"),
        ({"particles": (100, 10**9)}, r"particles: got \(100, 1000000000\)"),
    ],
)
def test_wrong_arguments_are_named(arguments: dict[str, object], message: str) -> None:
    correct: dict[str, object] = {"scene": "waterdrop", "seed": 0, "frames": 2}
    with pytest.raises(ValueError, match=message):
        simulate(**(correct | arguments))  # type: ignore[arg-type]


def test_negative_integers_and_endless_trajectories_are_refused() -> None:
    with pytest.raises(OverflowError):
        simulate("waterdrop", seed=-1, frames=2)
    with pytest.raises(MemoryError, match="frames"):
        simulate("waterdrop", seed=0, frames=2**60)
