"""Which particles see which: the graph policies of a rollout.

A policy gets the state before a step and returns the edges of that step. Kinematic particles are
never high: their sigma is not trained.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptgns.config import AdaptiveConfig, PolicyName
from adaptgns.graph import adaptive_graph, knn_graph, radius_graph

Edges = tuple[NDArray[np.int64], NDArray[np.int64]]
"""``[2, E]`` senders and receivers, and the receivers' row offsets ``[N + 1]``"""


@dataclass(frozen=True)
class State:
    """What a policy may look at before a step."""

    positions: NDArray[np.float32]
    """``[N, d]``"""
    sigma: NDArray[np.float32] | None
    """``[N]``, predicted one step ago; None before the first step"""
    mobile: NDArray[np.bool_]
    """``[N]``, the non-kinematic particles"""
    radius: float
    """Base radius of the graph (length units of the data)"""
    self_edges: bool
    box: NDArray[np.float64] | None
    """``[d]`` period lengths, inf along open axes"""
    predict_sigma: Callable[[Edges], NDArray[np.float32]]
    """A forward pass of the model on given edges, for its sigma ``[N]`` alone"""

    def base(self) -> Edges:
        """The radius graph."""
        return radius_graph(
            self.positions,
            self.radius,
            box=self.box,
            self_edges=self.self_edges,
            return_offsets=True,
        )

    def expanded(self, sigma: NDArray[np.float32], rule: AdaptiveConfig) -> Edges:
        """The adaptive graph for ``sigma`` ``[N]``."""
        return adaptive_graph(
            self.positions,
            sigma,
            self.radius,
            rule.tau,
            rule.factor,
            box=self.box,
            self_edges=self.self_edges,
            eligible=self.mobile,
            return_offsets=True,
        )


class Policy(Protocol):
    """Chooses the graph of every step."""

    name: ClassVar[PolicyName]
    needs_sigma: ClassVar[bool]
    """Whether it takes a model with a variance head"""

    def edges(self, state: State) -> Edges:
        """The edges of the step that starts in ``state``."""


@dataclass(frozen=True)
class Fixed:
    """All pairs within the base radius."""

    name: ClassVar[PolicyName] = "fixed"
    needs_sigma: ClassVar[bool] = False

    def edges(self, state: State) -> Edges:
        return state.base()


@dataclass(frozen=True)
class Adaptive:
    """The particles most uncertain one step ago see farther; the first step has the base graph."""

    name: ClassVar[PolicyName] = "adaptive"
    needs_sigma: ClassVar[bool] = True
    rule: AdaptiveConfig

    def edges(self, state: State) -> Edges:
        return state.base() if state.sigma is None else state.expanded(state.sigma, self.rule)


@dataclass(frozen=True)
class TwoPass:
    """The particles most uncertain now see farther, at the price of a second forward pass: what
    the lag of :class:`Adaptive` costs in accuracy."""

    name: ClassVar[PolicyName] = "two-pass"
    needs_sigma: ClassVar[bool] = True
    rule: AdaptiveConfig

    def edges(self, state: State) -> Edges:
        return state.expanded(state.predict_sigma(state.base()), self.rule)


@dataclass(frozen=True)
class Random:
    """As many particles as in :class:`Adaptive` see farther, drawn at every step: the control."""

    name: ClassVar[PolicyName] = "random"
    needs_sigma: ClassVar[bool] = True
    rule: AdaptiveConfig
    rng: np.random.Generator

    def edges(self, state: State) -> Edges:
        if state.sigma is None:
            return state.base()
        return state.expanded(self.rng.random(len(state.positions), dtype=np.float32), self.rule)


@dataclass(frozen=True)
class NearestNeighbours:
    """The k nearest particles of each, at any distance."""

    name: ClassVar[PolicyName] = "knn"
    needs_sigma: ClassVar[bool] = False
    k: int

    def edges(self, state: State) -> Edges:
        return knn_graph(
            state.positions,
            self.k,
            box=state.box,
            self_edges=state.self_edges,
            return_offsets=True,
        )


def make_policy(name: PolicyName, rule: AdaptiveConfig, *, k: int, seed: int) -> Policy:
    """The policy called ``name``; ``seed`` matters for ``random`` alone, ``k`` for ``knn``."""
    match name:
        case "fixed":
            return Fixed()
        case "adaptive":
            return Adaptive(rule)
        case "two-pass":
            return TwoPass(rule)
        case "random":
            return Random(rule, np.random.default_rng(seed))
        case "knn":
            return NearestNeighbours(k)
