from collections.abc import Sequence
from typing import Literal, TypeAlias, overload

import numpy as np
import numpy.typing as npt

__all__ = ["adaptive_graph", "knn_graph", "radius_graph"]

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
