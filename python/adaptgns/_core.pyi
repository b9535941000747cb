from collections.abc import Sequence
from typing import Literal, TypeAlias, final, overload

import numpy as np
import numpy.typing as npt

__all__ = [
    "NetworkTape",
    "adaptive_graph",
    "knn_graph",
    "network_backward",
    "network_forward",
    "radius_graph",
    "simulate",
]

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
    0.0025 s between frames. The first frame is the scene as drawn. In 'vortices' the box is
    periodic and there is no gravity.

    Args:
        scene: 'waterdrop', 'sand', 'goop', 'jelly', 'multimaterial', 'waterramps', 'stirrer' or
            'vortices'.
        seed: any integer from 0 to 2**64 - 1; the result depends on the arguments alone,
            whatever else runs.
        frames: number of frames T, at least 1.
        dim: 2 or 3.
        particles: smallest and largest number of particles, from 16 to as many as fill half
            the room for them; None for the published mix. Those of obstacles are not counted.
            'vortices' has 2,500 particles, in 3D 8,000, whatever else the range holds.

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

_Floats: TypeAlias = npt.NDArray[np.float32]
_Perceptrons: TypeAlias = Sequence[Sequence[_Floats]]
_Edges: TypeAlias = tuple[_Floats, Sequence[_Integers]] | None

@final
class NetworkTape:
    """What the backward pass needs of a forward pass."""

def network_forward(
    perceptrons: _Perceptrons,
    node_features: _Floats,
    edges: _Edges,
    *,
    heads: int,
    keep: bool,
    bf16: bool = False,
    threads: int | None = None,
) -> tuple[list[_Floats], NetworkTape | None]:
    """The encode-process-decode network (Sanchez-Gonzalez et al. 2020).

    All arrays are C-contiguous. Results are the same for any number of threads.

    Args:
        perceptrons: node encoder, edge encoder, each step's edge and node perceptron, heads;
            without ``edges`` node encoder, a node perceptron per step, heads. Each is weight
            [outputs, inputs] and bias [outputs] in turn, ReLU between them, and perhaps scale and
            shift of a LayerNorm at last. Edge perceptrons see [receiver, sender, edge], node
            perceptrons [sum of messages, node]; both are residual.
        node_features: [N, :].
        edges: features [E, :], then senders [E], receivers [E] and receivers' offsets [N + 1],
            and for a backward pass the edges sorted by sender [E] and senders' offsets [N + 1];
            None for a network without edges.
        heads: how many of the last perceptrons are read from the last step's nodes.
        keep: whether a backward pass follows.
        bf16: whether the factors of products, but for those of the heads, are rounded to bf16, and
            without ``keep`` the edges' latents; sums and all else are float32.
        threads: how many threads may work on the call, all cores if absent.

    Returns:
        The heads' outputs [N, :], and with ``keep`` the tape.

    Raises:
        ValueError, TypeError: arguments that do not fit together, by name.
    """

def network_backward(
    perceptrons: _Perceptrons,
    node_features: _Floats,
    edges: _Edges,
    tape: NetworkTape,
    gradients: Sequence[_Floats],
    *,
    alone: bool = False,
    bf16: bool = False,
    threads: int | None = None,
) -> tuple[_Floats, _Floats, _Floats]:
    """The way back through :func:`network_forward` with the same arguments.

    Args:
        tape: what the forward pass kept.
        gradients: those of the heads' outputs, [N, :] each.
        alone: whether the heads behind the first learn without a word to the rest of the network.

    Returns:
        Gradients, flat, of all parameters in order, of the node features, and of the edge
        features (empty without edges).

    Raises:
        ValueError, TypeError: arguments that do not fit together, by name.
    """
