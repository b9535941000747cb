"""Tensors as few characters: sixteen bits a number, what changes from frame to frame, deflated."""

from __future__ import annotations

import gzip
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OUTSIDE = 0xFFFF
"""The code of what is not in the range"""
LARGEST = OUTSIDE - 1


@dataclass(frozen=True)
class Range:
    """What the codes 0 and LARGEST stand for, scalars or one value an axis."""

    lower: np.float64 | NDArray[np.float64]
    upper: np.float64 | NDArray[np.float64]


def quantized(values: NDArray[np.float64], limits: Range) -> NDArray[np.uint16]:
    """The codes of ``values`` inside ``limits``, each off by half a step at most."""
    share = (values - limits.lower) / (limits.upper - limits.lower)
    return np.rint(share * LARGEST).astype(np.uint16)


def encoded(codes: NDArray[np.uint16], *, order: int) -> bytes:
    """``codes`` ``[F, ...]`` as differences of this order along the frames, modulo 2¹⁶, their low
    bytes before their high ones, gzipped.

    What moves smoothly has small differences, whose high bytes are all alike.
    """
    change = codes.reshape(len(codes), -1).copy()
    for _ in range(order):
        change[1:] -= change[:-1].copy()
    low, high = (change & 0xFF).astype(np.uint8), (change >> 8).astype(np.uint8)
    # No time in the header: one rollout gives one file.
    return gzip.compress(low.tobytes() + high.tobytes(), compresslevel=6, mtime=0)
