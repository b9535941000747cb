"""Every refusal of the graph builders, with its words."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from adaptgns.graph import adaptive_graph, knn_graph, radius_graph

POS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
SIGMA = np.array([0.1, 0.2, 0.3])
NAN = float("nan")

# (call with one wrong argument, exception, message)
Refusal = tuple[Callable[[], Any], type[Exception], str]
REFUSALS: list[Refusal] = [
    # kinds
    (
        lambda: radius_graph([[0.0, 0.0]], 1.0),
        TypeError,
        "pos: got list, must be a numpy array of float32 or float64",
    ),
    (
        lambda: radius_graph(POS.astype(int), 1.0),
        TypeError,
        "pos: got a numpy array of int64, must be a numpy array of float32 or float64",
    ),
    (
        lambda: radius_graph(POS.astype(">f8"), 1.0),
        TypeError,
        "pos: got a numpy array of >f8, must be a numpy array of float32 or float64",
    ),
    (lambda: radius_graph(POS, "1"), TypeError, "r: got str, must be a number"),
    (lambda: radius_graph(POS, True), TypeError, "r: got bool, must be a number"),
    (lambda: radius_graph(POS, None), TypeError, "r: got NoneType, must be a number"),
    (lambda: radius_graph(POS, 1 + 0j), TypeError, "r: got complex, must be a number"),
    (lambda: radius_graph(POS, np.complex64(1)), TypeError, "r: got complex64, must be a number"),
    (lambda: radius_graph(POS, np.True_), TypeError, "r: got bool, must be a number"),
    (lambda: radius_graph(POS, 10**400), ValueError, "r: got inf, must be a finite number > 0"),
    (lambda: radius_graph(POS, -(10**400)), ValueError, "r: got -inf, must be a finite number > 0"),
    (
        lambda: radius_graph(POS, np.array([1, 1, 1])),
        TypeError,
        "r: got a numpy array of int64, must be a numpy array of float32 or float64",
    ),
    (
        lambda: adaptive_graph(POS, SIGMA.tolist(), 1.0, 70, 1.5),
        TypeError,
        "sigma: got list, must be a numpy array of float32 or float64",
    ),
    (
        lambda: adaptive_graph(POS, SIGMA, SIGMA, 70, 1.5),
        TypeError,
        "r: got a numpy array of float64, must be a number",
    ),
    (
        lambda: adaptive_graph(POS, SIGMA, 1.0, "70", 1.5),
        TypeError,
        "tau: got str, must be a number",
    ),
    (
        lambda: adaptive_graph(POS, SIGMA, 1.0, 70, [1.5]),
        TypeError,
        "factor: got list, must be a number",
    ),
    (
        lambda: adaptive_graph(POS, SIGMA, 1.0, 70, 1.5, eligible=SIGMA),
        TypeError,
        "eligible: got a numpy array of float64, must be a numpy array of bool",
    ),
    (
        lambda: radius_graph(POS, 1.0, ptr=np.array([0, 3], dtype=np.int32)),
        TypeError,
        "ptr: got a numpy array of int32, must be a numpy array of int64",
    ),
    (
        lambda: radius_graph(POS, 1.0, ptr=[0, 3]),
        TypeError,
        "ptr: got list, must be a numpy array of int64",
    ),
    (
        lambda: radius_graph(POS, 1.0, box=1.0),
        TypeError,
        "box: got float, must be a sequence of numbers",
    ),
    (
        lambda: radius_graph(POS, 1.0, box=["1", "1"]),
        TypeError,
        "box: got str, must be a number",
    ),
    (
        lambda: radius_graph(POS, 1.0, self_edges=1),
        TypeError,
        "self_edges",
    ),
    (
        lambda: radius_graph(POS, 1.0, threads=1.5),
        TypeError,
        "threads: got float, must be an integer",
    ),
    (lambda: knn_graph(POS, 1.0), TypeError, "k: got float, must be an integer"),
    (lambda: knn_graph(POS, True), TypeError, "k: got bool, must be an integer"),
    # values
    (
        lambda: radius_graph(POS[0], 1.0),
        ValueError,
        "pos: got an array of 1 axes, must have 2",
    ),
    (
        lambda: radius_graph(np.zeros((3, 4)), 1.0),
        ValueError,
        "pos: got 4 coordinates per particle, must be [N, 2] or [N, 3]",
    ),
    (
        lambda: radius_graph(np.zeros((3, 0)), 1.0),
        ValueError,
        "pos: got 0 coordinates per particle, must be [N, 2] or [N, 3]",
    ),
    (
        lambda: radius_graph(np.array([[0.0, NAN]]), 1.0),
        ValueError,
        "pos: got NaN at flat index 1, every value must be finite",
    ),
    (
        lambda: radius_graph(np.array([[0.0, np.inf]], dtype=np.float32), 1.0),
        ValueError,
        "pos: got inf at flat index 1, every value must be finite",
    ),
    *[
        (
            lambda r=r: radius_graph(POS, r),
            ValueError,
            f"r: got {name}, must be a finite number > 0",
        )
        for r, name in [(0, "0"), (-1.0, "-1"), (NAN, "NaN"), (float("inf"), "inf")]
    ],
    (
        lambda: radius_graph(POS, np.array([1.0, -1.0, 1.0])),
        ValueError,
        "r: got -1, must be a finite number > 0",
    ),
    (
        lambda: radius_graph(POS, np.ones(2)),
        ValueError,
        "r: got 2 values for 3 particles, must be one per particle",
    ),
    (
        lambda: radius_graph(POS, np.ones((3, 1))),
        ValueError,
        "r: got an array of 2 axes, must have 1",
    ),
    (
        lambda: adaptive_graph(POS, SIGMA[:2], 1.0, 70, 1.5),
        ValueError,
        "sigma: got 2 values for 3 particles, must be one per particle",
    ),
    (
        lambda: adaptive_graph(POS, -SIGMA, 1.0, 70, 1.5),
        ValueError,
        "sigma: got -0.1 at flat index 0, every value must be finite and >= 0",
    ),
    (
        lambda: adaptive_graph(POS, SIGMA * NAN, 1.0, 70, 1.5),
        ValueError,
        "sigma: got NaN at flat index 0, every value must be finite and >= 0",
    ),
    *[
        (
            lambda tau=tau: adaptive_graph(POS, SIGMA, 1.0, tau, 1.5),
            ValueError,
            f"tau: got {name}, must be a percentile in [0, 100]",
        )
        for tau, name in [(-1, "-1"), (100.5, "100.5"), (NAN, "NaN")]
    ],
    *[
        (
            lambda factor=factor: adaptive_graph(POS, SIGMA, 1.0, 70, factor),
            ValueError,
            f"factor: got {name}, must be a finite number >= 1",
        )
        for factor, name in [(0.9, "0.9"), (NAN, "NaN"), (float("inf"), "inf")]
    ],
    (
        lambda: adaptive_graph(POS, SIGMA, 1.0, 70, 1.5, eligible=np.ones(4, dtype=bool)),
        ValueError,
        "eligible: got 4 values for 3 particles, must be one per particle",
    ),
    *[
        (
            lambda ptr=ptr: radius_graph(POS, 1.0, ptr=np.array(ptr, dtype=np.int64)),
            ValueError,
            f"ptr: {problem}, must rise from 0 to the number of particles, 3",
        )
        for ptr, problem in [
            ([], "got no offsets"),
            ([1, 3], "starts at 1"),
            ([0, 2], "ends at 2"),
            ([0, 3, 2, 3], "falls from 3 to 2 at index 2"),
        ]
    ],
    (
        lambda: radius_graph(POS, 1.0, box=[1.0]),
        ValueError,
        "box: got 1 lengths, must be 2, one per axis",
    ),
    (
        lambda: radius_graph(POS, 1.0, box=[1.0, -2.0]),
        ValueError,
        "box: got the length -2, must be a positive float64 or, for an open axis, inf or 0",
    ),
    (
        lambda: radius_graph(POS, 1.0, threads=0),
        ValueError,
        "threads: got 0, must be an integer of at least 1",
    ),
    (lambda: knn_graph(POS, 0), ValueError, "k: got 0, must be an integer of at least 1"),
    (lambda: knn_graph(POS, -(10**30)), ValueError, "must be an integer of at least 1"),
    (
        lambda: knn_graph(POS, 3),
        ValueError,
        "k: got 3, must be at least 1 and less than 3, the particles of the smallest graph",
    ),
    (
        lambda: knn_graph(POS, 2, ptr=np.array([0, 1, 3])),
        ValueError,
        "k: got 2, must be at least 1 and less than 1, the particles of the smallest graph",
    ),
]


@pytest.mark.parametrize(("call", "exception", "message"), REFUSALS)
def test_refusal(call: Callable[[], Any], exception: type[Exception], message: str) -> None:
    with pytest.raises(exception, match=re.escape(message)) as caught:
        call()
    assert type(caught.value) is exception
