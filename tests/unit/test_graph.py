"""The graph builders against scipy and numpy, and as citizens of a Python process."""

import itertools
import subprocess
import sys
import threading
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from adaptgns.graph import adaptive_graph, knn_graph, radius_graph

Positions = np.ndarray[Any, np.dtype[np.float64]]
EVERY = settings(deadline=None, derandomize=True, max_examples=100)


@st.composite
def positions(draw: st.DrawFn, most: int = 60) -> Positions:
    """Points of [0, 8)^d, half of the time on a lattice of spacing 1/4."""
    n, d = draw(st.integers(0, most)), draw(st.integers(2, 3))
    if draw(st.booleans()):
        return draw(arrays(np.int64, (n, d), elements=st.integers(0, 31))) / 4
    return draw(arrays(np.float64, (n, d), elements=st.floats(0, 8, exclude_max=True)))


def both_directions(pairs: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """scipy's i < j pairs as a sorted edge_index."""
    edges = np.concatenate([pairs, pairs[:, ::-1]]).T
    return edges[:, np.lexsort(edges)]


@EVERY
@given(positions(), st.sampled_from([0.3, 1.0, 2.3]), st.booleans())
def test_radius_graph_equals_scipy(pos: Positions, r: float, periodic: bool) -> None:
    tree = cKDTree(pos.reshape(-1, pos.shape[1]), boxsize=8.0 if periodic else None)
    # Pairs within rounding of the radius may fall either way.
    near, nearer = (tree.query_pairs(r * (1 + s), output_type="ndarray") for s in (1e-9, -1e-9))
    assume(len(near) == len(nearer))
    edges = radius_graph(pos, r, box=[8.0] * pos.shape[1] if periodic else None)
    np.testing.assert_array_equal(edges, both_directions(near))


@EVERY
@given(positions(), st.data())
def test_adaptive_graph_uses_the_percentile_of_numpy(pos: Positions, data: st.DataObject) -> None:
    n = len(pos)
    assume(n > 0)
    kind = data.draw(st.sampled_from([np.float32, np.float64]))
    width = 8 * np.dtype(kind).itemsize
    sigma = data.draw(arrays(kind, n, elements=st.floats(0, 10, width=width)))
    tau = data.draw(st.floats(0, 100))
    eligible = data.draw(arrays(np.bool_, n))
    high = np.zeros(n, dtype=bool)
    if eligible.any():
        high = eligible & (sigma > np.percentile(sigma[eligible], tau))
    edges = adaptive_graph(pos, sigma, 0.9, tau, 1.267, eligible=eligible)
    expected = radius_graph(pos, np.where(high, 0.9 * 1.267, 0.9))
    np.testing.assert_array_equal(edges, expected)


@EVERY
@given(positions(), st.integers(1, 9), st.booleans())
def test_knn_graph_finds_the_distances_of_scipy(pos: Positions, k: int, periodic: bool) -> None:
    n = len(pos)
    assume(k < n)
    side = 8.0 if periodic else None
    edges = knn_graph(pos, k, box=None if side is None else [side] * pos.shape[1])
    np.testing.assert_array_equal(edges[1], np.repeat(np.arange(n), k))
    assert (edges[0] != edges[1]).all()
    offset = np.abs(pos[edges[0]] - pos[edges[1]])
    if side is not None:
        offset = np.minimum(offset, side - offset)
    distances = np.sort(np.linalg.norm(offset, axis=1).reshape(n, k), axis=1)
    expected = cKDTree(pos, boxsize=side).query(pos, k + 1)[0][:, 1:]
    np.testing.assert_allclose(distances, expected, atol=1e-12)


def test_adaptive_graph_without_high_particles_is_the_base_graph() -> None:
    rng = np.random.default_rng(0)
    pos, sigma = rng.random((300, 2)), rng.random(300)
    base = radius_graph(pos, 0.1)
    for s, tau, factor in [(sigma, 100, 1.5), (sigma, 70, 1.0), (np.ones(300), 0, 2.0)]:
        np.testing.assert_array_equal(adaptive_graph(pos, s, 0.1, tau, factor), base)
    assert adaptive_graph(pos, sigma, 0.1, 70, 1.5).shape[1] > base.shape[1]


def test_each_graph_of_a_batch_has_its_own_percentile() -> None:
    rng = np.random.default_rng(1)
    pos = rng.random((400, 3)).astype(np.float32)
    sigma = rng.random(400) * np.repeat([1.0, 100.0], [150, 250])
    ptr = np.array([0, 150, 150, 400])
    parts = [
        adaptive_graph(pos[a:b], sigma[a:b], 0.1, 70, 1.5) + a for a, b in itertools.pairwise(ptr)
    ]
    batch = adaptive_graph(pos, sigma, 0.1, 70, 1.5, ptr=ptr)
    np.testing.assert_array_equal(batch, np.concatenate(parts, axis=1))


def test_arrays_are_handed_over_as_promised() -> None:
    pos = np.random.default_rng(2).random((500, 2))
    edges, offsets = radius_graph(pos, 0.1, self_edges=True, return_offsets=True)
    assert edges.dtype == offsets.dtype == np.int64
    assert edges.flags.c_contiguous
    assert edges.flags.writeable
    np.testing.assert_array_equal(offsets, np.searchsorted(edges[1], np.arange(501)))
    assert radius_graph(np.empty((0, 3)), 1.0).shape == (2, 0)
    assert knn_graph(np.empty((0, 2)), 5).shape == (2, 0)


def test_any_strides_are_read_and_nothing_is_written() -> None:
    rng = np.random.default_rng(3)
    pos = rng.random((200, 2))
    sigma = rng.random(200)
    expected = adaptive_graph(pos, sigma, 0.1, 70, 1.5)
    record = np.zeros(200, dtype=[("flag", "i1"), ("pos", "f8", 2)])
    record["pos"] = pos
    wide = np.zeros((400, 6))
    wide[::2, 1:5:3] = pos
    frozen = pos.copy()
    frozen.flags.writeable = False
    for view in [
        np.asfortranarray(pos),
        pos[::-1][::-1],
        pos[::-1].copy()[::-1],
        wide[::2, 1:5:3],
        record["pos"],  # not aligned
        frozen,
    ]:
        before = view.copy()
        strided = np.repeat(sigma, 3)[::3]
        np.testing.assert_array_equal(adaptive_graph(view, strided, 0.1, 70, 1.5), expected)
        np.testing.assert_array_equal(view, before)


def test_any_number_of_threads_gives_the_same_graph() -> None:
    rng = np.random.default_rng(4)
    pos, sigma = rng.random((20_000, 3)), rng.random(20_000)
    for build in (
        lambda threads: radius_graph(pos, 0.03, threads=threads),
        lambda threads: adaptive_graph(pos, sigma, 0.03, 70, 1.267, threads=threads),
        lambda threads: knn_graph(pos, 5, threads=threads),
    ):
        alone = build(1)
        for threads in (None, 2, 7):
            np.testing.assert_array_equal(build(threads), alone)


class _Graphs(torch.utils.data.Dataset[torch.Tensor]):
    pos = np.random.default_rng(5).random((30_000, 2))

    def __len__(self) -> int:
        return 6

    def __getitem__(self, index: int) -> torch.Tensor:
        edges = radius_graph(self.pos, 0.005 + 0.001 * index)
        return torch.tensor(edges.shape[1])


def test_forked_workers_build_graphs_after_the_parent_used_its_threads() -> None:
    graphs = _Graphs()
    expected = [int(graphs[i]) for i in range(len(graphs))]
    loader = torch.utils.data.DataLoader(
        graphs, batch_size=None, num_workers=2, multiprocessing_context="fork", timeout=60
    )
    with warnings.catch_warnings():
        # Python 3.12 warns of any fork of a process with threads; surviving it is tested here.
        warnings.filterwarnings("ignore", ".*fork.*", DeprecationWarning)
        found = [int(count) for count in loader]
    assert found == expected
    assert int(graphs[0]) == expected[0]


def test_other_python_threads_run_meanwhile() -> None:
    pos = np.zeros((3000, 2), dtype=np.float32)
    building, counted = threading.Event(), 0
    stop = threading.Event()

    def count() -> None:
        nonlocal counted
        building.wait()
        while not stop.is_set():
            counted += 1

    counter = threading.Thread(target=count)
    counter.start()
    building.set()
    before = counted
    # While the GIL is held nobody counts; nine million edges take long enough for many.
    radius_graph(pos, 1.0, threads=1)
    after = counted
    stop.set()
    counter.join()
    assert after > before


def test_more_edges_than_memory_is_an_error() -> None:
    with pytest.raises(MemoryError, match="available memory holds"):
        radius_graph(np.zeros((1_000_000, 2)), 1.0)


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


def test_the_core_needs_numpy_alone() -> None:
    code = (
        "import sys; import adaptgns._core; "
        "assert not {'torch', 'h5py', 'scipy', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_any_byte_but_0_makes_a_particle_eligible() -> None:
    """numpy takes a view of an image mask, of 0 and 255, for the same as one of 0 and 1."""
    rng = np.random.default_rng(0)
    pos, sigma, mask = rng.random((500, 2)), rng.random(500), rng.random(500) < 0.1
    expected = adaptive_graph(pos, sigma, 0.05, 60, 1.5, eligible=mask)
    for byte in (2, 3, 255):
        view = (mask * np.uint8(byte)).view(np.bool_)
        found = adaptive_graph(pos, sigma, 0.05, 60, 1.5, eligible=view)
        np.testing.assert_array_equal(found, expected)
