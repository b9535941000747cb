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
from adaptgns.periodic import minimum_image
from adaptgns.threads import thread_count

Edges = tuple[NDArray[np.int64], NDArray[np.int64]]
"""``[2, E]`` senders and receivers, and the receivers' row offsets ``[N + 1]``"""


@dataclass(frozen=True)
class State:
    """What a policy may look at before a step."""

    history: NDArray[np.float32]
    """``[N, H, d]`` positions, the current ones last"""
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

    @property
    def positions(self) -> NDArray[np.float32]:
        """``[N, d]``, the current ones"""
        return np.ascontiguousarray(self.history[:, -1])

    def base(self, radius: float | NDArray[np.float64] | None = None) -> Edges:
        """The radius graph, of the base radius or another, or of one ``[N]`` for each particle."""
        return radius_graph(
            self.positions,
            self.radius if radius is None else radius,
            box=self.box,
            self_edges=self.self_edges,
            threads=thread_count(),
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
            threads=thread_count(),
            eligible=self.mobile,
            return_offsets=True,
        )


class Policy(Protocol):
    """Chooses the graph of every step."""

    name: ClassVar[PolicyName]
    needs_sigma: ClassVar[bool]
    """Whether it takes a model with a variance head"""
    looks_back: ClassVar[bool]
    """Whether its edges depend on what the step before was predicted with"""

    def edges(self, state: State) -> Edges:
        """The edges of the step that starts in ``state``."""


@dataclass(frozen=True)
class Fixed:
    """All pairs within the base radius."""

    name: ClassVar[PolicyName] = "fixed"
    needs_sigma: ClassVar[bool] = False
    looks_back: ClassVar[bool] = False

    def edges(self, state: State) -> Edges:
        return state.base()


@dataclass(frozen=True)
class Adaptive:
    """The particles most uncertain one step ago see farther; the first step has the base graph."""

    name: ClassVar[PolicyName] = "adaptive"
    needs_sigma: ClassVar[bool] = True
    looks_back: ClassVar[bool] = True
    rule: AdaptiveConfig

    def edges(self, state: State) -> Edges:
        return state.base() if state.sigma is None else state.expanded(state.sigma, self.rule)


@dataclass(frozen=True)
class TwoSided:
    """As :class:`Adaptive`, and the particles least uncertain see less far: an edge is as long as
    the farther-seeing end allows."""

    name: ClassVar[PolicyName] = "two-sided"
    needs_sigma: ClassVar[bool] = True
    looks_back: ClassVar[bool] = True
    rule: AdaptiveConfig

    def __post_init__(self) -> None:
        self.rule.require_two_sides()

    def edges(self, state: State) -> Edges:
        if state.sigma is None:
            return state.base()
        return state.base(state.radius * two_sided(state.sigma, self.rule, state.mobile))


@dataclass(frozen=True)
class Acceleration:
    """The particles that were accelerated most see farther, whatever the model says."""

    name: ClassVar[PolicyName] = "acceleration"
    needs_sigma: ClassVar[bool] = False
    looks_back: ClassVar[bool] = False
    rule: AdaptiveConfig

    def edges(self, state: State) -> Edges:
        velocity = minimum_image(np.diff(state.history[:, -3:], axis=1), state.box)
        change = np.linalg.norm(np.diff(velocity, axis=1)[:, 0], axis=1)
        return state.expanded(change.astype(np.float32), self.rule)


@dataclass(frozen=True)
class Divergence:
    """The particles whose neighbours close in or part fastest see farther, whatever the model says.

    The divergence of the velocity at particle i is estimated from its n neighbours j within the
    base radius as |(d / n) Σ_j (v_j - v_i)·(x_j - x_i) / |x_j - x_i|²|, 0 without any."""

    name: ClassVar[PolicyName] = "divergence"
    needs_sigma: ClassVar[bool] = False
    looks_back: ClassVar[bool] = False
    rule: AdaptiveConfig

    def edges(self, state: State) -> Edges:
        positions, (particles, dim) = state.positions, state.positions.shape
        senders, receivers = radius_graph(
            positions, state.radius, box=state.box, threads=thread_count()
        )
        velocity = minimum_image(positions - state.history[:, -2], state.box)
        apart = minimum_image(positions[senders] - positions[receivers], state.box)
        distance = np.maximum(np.square(apart).sum(1), np.finfo(np.float32).tiny)
        rate = ((velocity[senders] - velocity[receivers]) * apart).sum(1) / distance
        total = np.bincount(receivers, rate, particles)
        degree = np.maximum(np.bincount(receivers, minlength=particles), 1)
        return state.expanded(np.abs(dim * total / degree).astype(np.float32), self.rule)


@dataclass(frozen=True)
class TwoPass:
    """The particles most uncertain now on the base graph see farther, at the price of a second
    forward pass: :class:`BaseSigma` without the lag."""

    name: ClassVar[PolicyName] = "two-pass"
    needs_sigma: ClassVar[bool] = True
    looks_back: ClassVar[bool] = False
    rule: AdaptiveConfig

    def edges(self, state: State) -> Edges:
        return state.expanded(state.predict_sigma(state.base()), self.rule)


@dataclass
class BaseSigma:
    """The particles that were most uncertain one step ago with the base graph see farther, at the
    price of a second forward pass: :class:`Adaptive` without what longer edges do to the sigma that
    the next ones are chosen by."""

    name: ClassVar[PolicyName] = "base-sigma"
    needs_sigma: ClassVar[bool] = True
    looks_back: ClassVar[bool] = True
    rule: AdaptiveConfig
    before: NDArray[np.float32] | None = None
    """``[N]``, sigma of the last step on the base graph; None before any"""

    def edges(self, state: State) -> Edges:
        base = state.base()
        sigma, self.before = self.before, state.predict_sigma(base)
        if state.sigma is None or sigma is None:  # the first step of a rollout
            return base
        return state.expanded(sigma, self.rule)


@dataclass(frozen=True)
class Random:
    """As many particles as in :class:`Adaptive` see farther, drawn at every step: the control."""

    name: ClassVar[PolicyName] = "random"
    needs_sigma: ClassVar[bool] = True
    looks_back: ClassVar[bool] = True  # goes on drawing
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
    looks_back: ClassVar[bool] = False
    k: int

    def edges(self, state: State) -> Edges:
        return knn_graph(
            state.positions,
            self.k,
            box=state.box,
            self_edges=state.self_edges,
            threads=thread_count(),
            return_offsets=True,
        )


def two_sided(
    sigma: NDArray[np.float32], rule: AdaptiveConfig, eligible: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """``[N]`` how many times the base radius each particle of one graph sees, by its ``sigma``
    ``[N]``; 1 for those that are not ``eligible`` ``[N]``, whom the percentiles do not count."""
    factors = np.ones(len(sigma))
    if eligible.any():
        low, high = np.percentile(sigma[eligible], (rule.low_tau, rule.tau))
        factors[eligible & (sigma < low)] = rule.low_factor
        factors[eligible & (sigma > high)] = rule.factor
    return factors


def make_policy(name: PolicyName, rule: AdaptiveConfig, *, k: int, seed: int) -> Policy:
    """The policy called ``name``; ``seed`` matters for ``random`` alone, ``k`` for ``knn``."""
    ruled = (Adaptive, TwoSided, TwoPass, BaseSigma, Acceleration, Divergence)
    for policy in ruled:
        if policy.name == name:
            return policy(rule)
    match name:
        case "random":
            return Random(rule, np.random.default_rng(seed))
        case "knn":
            return NearestNeighbours(k)
        case _:
            return Fixed()
