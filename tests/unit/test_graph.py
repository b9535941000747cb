"""The graph builders against scipy, numpy and brute force, through the Python interface."""

from __future__ import annotations

import itertools
import subprocess
import sys
import threading
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch.utils.data import DataLoader, Dataset

from adaptgns._core import adaptive_graph, knn_graph, radius_graph

Edges = NDArray[np.int64]


def in_order(pairs: NDArray[np.int64]) -> Edges:
    """``[E, 2]`` (sender, receiver) pairs as a sorted edge list ``[2, E]``."""
    return np.ascontiguousarray(pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))].T)


def brute_force(
    pos: NDArray[np.float64],
    cutoff: float | NDArray[np.float64],
    box: NDArray[np.float64] | None = None,
    ptr: list[int] | None = None,
    self_edges: bool = False,
) -> Edges:
    """All pairs, the cutoff per pair (``[N, N]``) or for all."""
    difference = pos[:, None] - pos[None]
    if box is not None:
        for axis in np.flatnonzero(np.isfinite(box) & (box > 0)):
            difference[..., axis] -= box[axis] * np.round(difference[..., axis] / box[axis])
    near = np.sqrt((difference**2).sum(-1)) <= cutoff
    np.fill_diagonal(near, self_edges)
    if ptr is not None:
        graph = np.searchsorted(ptr, np.arange(len(pos)), side="right")
        near &= graph[:, None] == graph[None]
    return in_order(np.argwhere(near))


@st.composite
def clouds(draw: st.DrawFn) -> tuple[NDArray[np.float64], float]:
    """Positions on a fine grid that no distance of which lies within rounding of the radius."""
    dim = draw(st.sampled_from([2, 3]))
    count = draw(st.integers(0, 60))
    seed = draw(st.integers(0, 2**32 - 1))
    extent = draw(st.sampled_from([4, 12, 40]))
    rng = np.random.default_rng(seed)
    pos = rng.integers(-extent, extent, (count, dim)).astype(np.float64)
    # Squared distances are whole numbers, the squared radius is not.
    return pos, float(np.sqrt(draw(st.integers(1, 60)) + 0.5))


@settings(max_examples=60, deadline=None)
@given(clouds(), st.sampled_from([np.float32, np.float64]), st.booleans())
def test_radius_graph_is_scipys(
    cloud: tuple[NDArray[np.float64], float], dtype: type, self_edges: bool
) -> None:
    pos, r = cloud
    edges, offsets = radius_graph(pos.astype(dtype), r, self_edges=self_edges, return_offsets=True)
    pairs = (
        cKDTree(pos).query_pairs(r, output_type="ndarray") if len(pos) else np.zeros((0, 2), int)
    )
    loops = np.repeat(np.arange(len(pos)), 2).reshape(-1, 2)
    both = [pairs, pairs[:, ::-1]] + ([loops] if self_edges else [])
    np.testing.assert_array_equal(edges, in_order(np.concatenate(both).astype(np.int64)))
    assert edges.dtype == offsets.dtype == np.int64
    np.testing.assert_array_equal(offsets, np.searchsorted(edges[1], np.arange(len(pos) + 1)))


@settings(max_examples=60, deadline=None)
@given(clouds(), st.sampled_from([3.0, 7.0, 25.0, np.inf, 0.0]), st.integers(0, 60))
def test_periodic_batches_and_radii_per_particle(
    cloud: tuple[NDArray[np.float64], float], period: float, cut: int
) -> None:
    pos, r = cloud
    rng = np.random.default_rng(len(pos) + cut)
    box = np.full(pos.shape[1], np.inf)
    box[0] = period
    ptr = [0, min(cut, len(pos)), len(pos)]
    # A half of an odd period is no distance on the grid, so the nearest image is unique.
    edges = radius_graph(pos, r, box=box, ptr=np.array(ptr))
    np.testing.assert_array_equal(edges, brute_force(pos, r, box, ptr))
    radii = np.sqrt(rng.integers(1, 40, len(pos)) + 0.5)
    edges = radius_graph(pos, radii, box=box, ptr=np.array(ptr))
    expected = brute_force(pos, np.maximum(radii[:, None], radii[None]), box, ptr)
    np.testing.assert_array_equal(edges, expected)


@settings(max_examples=60, deadline=None)
@given(
    clouds(),
    st.sampled_from([0.0, 30.0, 70.0, 99.0, 100.0]),
    st.sampled_from([1.0, 1.267, 2.5]),
    st.booleans(),
)
def test_adaptive_graph_uses_numpys_percentile(
    cloud: tuple[NDArray[np.float64], float], tau: float, factor: float, some_are_not: bool
) -> None:
    pos, r = cloud
    rng = np.random.default_rng(len(pos))
    sigma = rng.integers(0, 6, len(pos)).astype(np.float64)
    ptr = [0, len(pos) // 3, len(pos)]
    eligible = rng.random(len(pos)) < 0.6 if some_are_not else np.ones(len(pos), bool)
    high = np.zeros(len(pos), bool)
    for start, stop in itertools.pairwise(ptr):
        part = eligible[start:stop]
        if part.any():
            threshold = np.percentile(sigma[start:stop][part], tau)
            high[start:stop] = part & (sigma[start:stop] > threshold)
    far = factor * r if (np.abs(np.rint((factor * r) ** 2) - (factor * r) ** 2) > 1e-9) else r
    cutoff = np.where(high[:, None] | high[None], far, r)
    edges = adaptive_graph(
        pos, sigma, r, tau, far / r, ptr=np.array(ptr), eligible=eligible if some_are_not else None
    )
    np.testing.assert_array_equal(edges, brute_force(pos, cutoff, ptr=ptr))
    if tau == 100.0 or factor == 1.0:
        np.testing.assert_array_equal(edges, radius_graph(pos, r, ptr=np.array(ptr)))


def test_equal_sigma_expands_nothing() -> None:
    pos = np.random.default_rng(0).random((200, 2))
    np.testing.assert_array_equal(
        adaptive_graph(pos, np.full(200, 0.3), 0.1, 70, 2), radius_graph(pos, 0.1)
    )


@settings(max_examples=40, deadline=None)
@given(clouds(), st.integers(1, 8), st.booleans(), st.booleans())
def test_knn_graph_breaks_ties_by_index(
    cloud: tuple[NDArray[np.float64], float], k: int, periodic: bool, self_edges: bool
) -> None:
    pos, _ = cloud
    if len(pos) <= k:
        return
    box = np.array([7.0] + [np.inf] * (pos.shape[1] - 1)) if periodic else None
    difference = pos[:, None] - pos[None]
    if periodic:
        difference[..., 0] -= 7 * np.round(difference[..., 0] / 7)
    distance = (difference**2).sum(-1)
    np.fill_diagonal(distance, np.inf)
    senders = np.argsort(distance, axis=1, kind="stable")[:, :k]
    pairs = np.stack([senders, np.repeat(np.arange(len(pos))[:, None], k, 1)], -1).reshape(-1, 2)
    if self_edges:
        pairs = np.concatenate([pairs, np.repeat(np.arange(len(pos)), 2).reshape(-1, 2)])
    edges = knn_graph(pos, k, box=box, self_edges=self_edges)
    np.testing.assert_array_equal(edges, in_order(pairs))


@pytest.mark.parametrize("dim", [2, 3])
def test_permuting_and_shifting(dim: int) -> None:
    rng = np.random.default_rng(dim)
    pos = rng.random((400, dim))
    edges = radius_graph(pos, 0.15)
    order = rng.permutation(400)
    permuted = radius_graph(pos[order], 0.15)
    np.testing.assert_array_equal(in_order(order[permuted].T), edges)
    np.testing.assert_array_equal(radius_graph(pos - 1000.0, 0.15), edges)
    np.testing.assert_array_equal(in_order(edges[::-1].T), edges)  # symmetric


def graphs(pos: NDArray[np.float32], threads: int | None) -> list[Edges]:
    sigma = pos[:, 0].copy() % 0.1
    return [
        radius_graph(pos, 0.01, threads=threads),
        adaptive_graph(pos, sigma, 0.01, 70, 1.267, threads=threads),
        knn_graph(pos, 5, threads=threads),
    ]


def test_output_is_independent_of_the_threads() -> None:
    pos = np.random.default_rng(1).random((60_000, 2), dtype=np.float32)
    alone = graphs(pos, 1)
    for threads in (2, 5, None):
        for a, b in zip(alone, graphs(pos, threads), strict=True):
            np.testing.assert_array_equal(a, b)


def test_any_strides_and_read_only_input() -> None:
    pos = np.random.default_rng(2).random((300, 2)).astype(np.float32)
    expected = radius_graph(pos, 0.1)
    wide = np.zeros((600, 5), np.float32)
    wide[::2, 1:4:2] = pos
    for view in (wide[::2, 1:4:2], np.asfortranarray(pos), pos[::-1][::-1]):
        np.testing.assert_array_equal(radius_graph(view, 0.1), expected)
    pos.setflags(write=False)
    np.testing.assert_array_equal(radius_graph(pos, 0.1), expected)


def test_empty_and_single() -> None:
    for dim in (2, 3):
        edges, offsets = radius_graph(np.zeros((0, dim)), 1.0, return_offsets=True)
        assert edges.shape == (2, 0)
        assert offsets.tolist() == [0]
        assert radius_graph(np.zeros((1, dim)), 1.0).shape == (2, 0)
        assert radius_graph(np.zeros((1, dim)), 1.0, self_edges=True).tolist() == [[0], [0]]
        assert adaptive_graph(np.zeros((0, dim)), np.zeros(0), 1.0, 70, 2).shape == (2, 0)


def test_at_the_radius() -> None:
    pos = np.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]])
    assert radius_graph(pos, 0.5).T.tolist() == [[1, 0], [0, 1], [2, 1], [1, 2]]


def lattice() -> NDArray[np.float64]:
    return np.stack(np.meshgrid(np.arange(300.0), np.arange(300.0)), -1).reshape(-1, 2)


@pytest.mark.parametrize(
    ("pos", "r", "edges"),
    [
        pytest.param(
            np.concatenate([lattice() * 0.9, [[1e6, 0.0]]]), 1.0, 4 * 300 * 299, id="outlier"
        ),
        pytest.param(
            np.concatenate([lattice(), lattice() + 1e7]), 1.0, 8 * 300 * 299, id="two clusters"
        ),
        pytest.param(
            np.stack([np.arange(1e5), np.zeros(100_000)], 1), 1.0, 2 * 99_999, id="on a line"
        ),
        pytest.param(lattice(), 1.0, 4 * 300 * 299, id="square lattice"),
        pytest.param(np.zeros((3_000, 3)), 1.0, 3_000 * 2_999, id="coincident"),
        pytest.param(lattice() + 1e6, 1.0, 4 * 300 * 299, id="far from the origin"),
        pytest.param(-lattice(), 1.0, 4 * 300 * 299, id="negative"),
    ],
)
def test_adversarial_shapes(pos: NDArray[np.float64], r: float, edges: int) -> None:
    assert radius_graph(pos, r).shape == (2, edges)
    assert radius_graph(pos.astype(np.float32), r).shape == (2, edges)
    if edges < 1e6:
        assert knn_graph(pos, 3).shape == (2, 3 * len(pos))


def test_more_edges_than_memory_is_an_error_before_they_are_allocated() -> None:
    with pytest.raises(MemoryError, match="edges"):
        radius_graph(np.zeros((1_000_000, 2), np.float32), 1.0)


def test_the_gil_is_free() -> None:
    """Another Python thread runs on while graphs are built."""
    pos = np.random.default_rng(3).random((1_000_000, 2), dtype=np.float32)
    turns = 0
    done = threading.Event()

    def build() -> None:
        radius_graph(pos, 0.002, threads=1)
        done.set()

    thread = threading.Thread(target=build)
    thread.start()
    while not done.is_set():
        turns += 1
    thread.join()
    # With the GIL held, this thread would get no turn but for the calls around the build.
    assert turns > 1_000


class Graphs(Dataset[torch.Tensor]):
    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> torch.Tensor:
        pos = np.random.default_rng(index).random((60_000, 2), dtype=np.float32)
        return torch.from_numpy(radius_graph(pos, 0.005))


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_worker_after_the_pool_was_used() -> None:
    data = Graphs()
    here = [data[i] for i in range(4)]
    loader = DataLoader(
        data, batch_size=None, num_workers=2, multiprocessing_context="fork", timeout=120
    )
    for a, b in zip(here, loader, strict=True):
        assert torch.equal(a, b)


def test_the_core_needs_numpy_alone() -> None:
    code = (
        "import sys; import adaptgns._core; "
        "assert not {'torch', 'h5py', 'scipy', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


POS = np.random.default_rng(4).random((6, 2))
ONES = np.ones(6)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: radius_graph(np.full((3, 2), np.nan), 1.0), ValueError, r"pos.*NaN.*finite"),
        (lambda: radius_graph(np.full((3, 2), np.inf), 1.0), ValueError, r"pos.*inf.*finite"),
        (lambda: radius_graph(np.zeros((3, 4)), 1.0), ValueError, r"pos.*4"),
        (lambda: radius_graph(np.zeros(3), 1.0), ValueError, r"pos"),
        (lambda: radius_graph(np.zeros((3, 2), np.int64), 1.0), TypeError, r"pos.*int64.*float32"),
        (lambda: radius_graph([[0.0, 1.0]], 1.0), TypeError, r"pos.*list"),
        (lambda: radius_graph(POS, 0.0), ValueError, r"r: .*0"),
        (lambda: radius_graph(POS, -1.0), ValueError, r"r: .*-1"),
        (lambda: radius_graph(POS, np.nan), ValueError, r"r: .*NaN"),
        (lambda: radius_graph(POS, "wide"), TypeError, r"r.*str"),
        (lambda: radius_graph(POS, np.ones(5)), ValueError, r"r: .*5.*6"),
        (lambda: radius_graph(POS, -ONES), ValueError, r"r: .*-1"),
        (lambda: radius_graph(POS, 1.0, ptr=np.array([0, 3])), ValueError, r"ptr: .*3.*6"),
        (lambda: radius_graph(POS, 1.0, ptr=np.array([1, 6])), ValueError, r"ptr: .*1"),
        (lambda: radius_graph(POS, 1.0, ptr=np.array([0, 4, 2, 6])), ValueError, r"ptr: .*4.*2"),
        (lambda: radius_graph(POS, 1.0, ptr=np.array([0.0, 6.0])), TypeError, r"ptr.*float64"),
        (lambda: radius_graph(POS, 1.0, box=np.ones(3)), ValueError, r"box: .*3"),
        (lambda: radius_graph(POS, 1.0, box=np.array([-1.0, 1.0])), ValueError, r"box: .*-1"),
        (lambda: radius_graph(POS, 1.0, threads=0), ValueError, r"threads.*0"),
        (lambda: adaptive_graph(POS, ONES[:4], 1, 70, 2), ValueError, r"sigma: .*4.*6"),
        (lambda: adaptive_graph(POS, -ONES, 1, 70, 2), ValueError, r"sigma: .*-1"),
        (lambda: adaptive_graph(POS, ONES * np.nan, 1, 70, 2), ValueError, r"sigma: .*NaN"),
        (lambda: adaptive_graph(POS, ONES, 1, 101, 2), ValueError, r"tau: .*101.*100"),
        (lambda: adaptive_graph(POS, ONES, 1, -1, 2), ValueError, r"tau: .*-1"),
        (lambda: adaptive_graph(POS, ONES, 1, 70, 0.9), ValueError, r"factor: .*0\.9.*1"),
        (lambda: adaptive_graph(POS, ONES, 0, 70, 2), ValueError, r"r: .*0"),
        (
            lambda: adaptive_graph(POS, ONES, 1, 70, 2, eligible=np.ones(5, bool)),
            ValueError,
            r"eligible: .*5.*6",
        ),
        (lambda: adaptive_graph(POS, ONES, 1, 70, 2, eligible=ONES), TypeError, r"eligible"),
        (lambda: knn_graph(POS, 0), ValueError, r"k: .*0"),
        (lambda: knn_graph(POS, 6), ValueError, r"k: .*6"),
        (lambda: knn_graph(POS, 2, ptr=np.array([0, 2, 6])), ValueError, r"k: .*2"),
        (lambda: knn_graph(POS, 1.5), TypeError, r"k.*float"),
    ],
)
def test_errors_name_the_argument_and_what_came(
    call: Callable[[], Edges], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        call()
