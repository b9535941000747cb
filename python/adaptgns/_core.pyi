from collections.abc import Sequence
from typing import Literal, TypeAlias, overload

import numpy as np
import numpy.typing as npt

__all__ = ["adaptive_graph", "knn_graph", "radius_graph", "simulate"]

_Reals: TypeAlias = npt.NDArray[np.float32] | npt.NDArray[np.float64]
_Integers: TypeAlias = npt.NDArray[np.int64]
_Lengths: TypeAlias = Sequence[float] | _Reals
_Graph: TypeAlias = tuple[_Integers, _Integers]

@overload
def radius_graph(
    pos: _Reals,
    r: float | _Reals,
    *,
    ptr: _Integers | None = None,
    box: _Lengths | None = None,
    self_edges: bool = False,
    threads: int | None = None,
    return_offsets: Literal[False] = False,
) -> _Integers: ...
@overload
def radius_graph(
    pos: _Reals,
    r: float | _Reals,
    *,
    ptr: _Integers | None = None,
    box: _Lengths | None = None,
    self_edges: bool = False,
    threads: int | None = None,
    return_offsets: Literal[True],
) -> _Graph: ...
@overload
def adaptive_graph(
    pos: _Reals,
    sigma: _Reals,
    r: float,
    tau: float,
    factor: float,
    *,
    eligible: npt.NDArray[np.bool_] | None = None,
    ptr: _Integers | None = None,
    box: _Lengths | None = None,
    self_edges: bool = False,
    threads: int | None = None,
    return_offsets: Literal[False] = False,
) -> _Integers: ...
@overload
def adaptive_graph(
    pos: _Reals,
    sigma: _Reals,
    r: float,
    tau: float,
    factor: float,
    *,
    eligible: npt.NDArray[np.bool_] | None = None,
    ptr: _Integers | None = None,
    box: _Lengths | None = None,
    self_edges: bool = False,
    threads: int | None = None,
    return_offsets: Literal[True],
) -> _Graph: ...
@overload
def knn_graph(
    pos: _Reals,
    k: int,
    *,
    ptr: _Integers | None = None,
    box: _Lengths | None = None,
    self_edges: bool = False,
    threads: int | None = None,
    return_offsets: Literal[False] = False,
) -> _Integers: ...
@overload
def knn_graph(
    pos: _Reals,
    k: int,
    *,
    ptr: _Integers | None = None,
    box: _Lengths | None = None,
    self_edges: bool = False,
    threads: int | None = None,
    return_offsets: Literal[True],
) -> _Graph: ...
def simulate(
    scene: str,
    *,
    seed: int,
    frames: int,
    dim: int = 2,
    particles: tuple[int, int] | None = None,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """One trajectory of the embedded data generator (MLS-MPM, Hu et al. 2018).

    A box from 0.1 to 0.9 along every axis [m], gravity 9.81 m/s² against the second axis,
    0.0025 s between frames. The first frame is the scene as drawn.

    Args:
        scene: 'waterdrop', 'sand', 'goop', 'jelly', 'multimaterial', 'waterramps' or 'stirrer'.
        seed: any integer from 0 to 2**64 - 1; the result depends on the arguments alone,
            whatever else runs.
        frames: number of frames T, at least 1.
        dim: 2 or 3.
        particles: smallest and largest number of particles, from 16 to as many as fill half
            the room for them; None for the published mix. Those of obstacles are not counted.

    Returns:
        Positions [T, N, dim], all inside the box, and GNS's particle types [N]: 5 for water,
        6 for sand, 7 for goop and jelly, 3 for obstacles, which come last.

    One thread does the work, with the GIL released: call it from several threads to make
    several trajectories at once.

    Raises:
        ValueError: an argument outside what is accepted.
        OverflowError: a negative or too large integer.
        MemoryError: the trajectory does not fit in memory.
    """
