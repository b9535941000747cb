"""Training samples: windows of a trajectory, noised, batched, with their graph.

A window is H input positions and the K positions that follow them, K = ``unroll``. Everything
random in a sample (order, noise, reflection) follows from the seed, the epoch and the sample's
number, so a run depends neither on the number of loading workers nor on where it was interrupted.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count, islice
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from adaptgns._core import radius_graph
from adaptgns.config import HISTORY, TrainConfig
from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectories import Trajectories
from adaptgns.noise import compression, drift_noise, random_walk_noise
from adaptgns.segment import Graph, Parcel
from adaptgns.threads import divide_threads, thread_count

Key = tuple[int, int]
"""(epoch, number of the window in the data set)"""


@dataclass(frozen=True)
class Sample:
    """One window. ``positions`` float32 ``[F, N, d]``: noisy inputs, then the following positions;
    F is H + K, or H + K + 1 with the extra frame in front that a lagged variance needs."""

    positions: NDArray[np.float32]
    particle_type: NDArray[np.int64]
    material: NDArray[np.float32] | None


@dataclass(frozen=True)
class Batch(Parcel):
    """Several samples as one graph of N particles with no edges between samples."""

    frames: Tensor
    """float32 ``[N, F, d]``, the samples' positions"""
    ahead: int
    """K, the number of positions that follow the inputs"""
    particle_type: Tensor
    """int64 ``[N]``"""
    material: Tensor | None
    """float32 ``[N, P]``"""
    mobile: Tensor
    """bool ``[N]``, the non-kinematic particles"""
    ptr: Tensor
    """int64 ``[B + 1]``, offsets of the samples; on the CPU always, where graphs are built"""
    graph: Graph | None
    """The base graph of the last input positions, or of those one frame before where training
    sees adaptive graphs and needs a variance from there; None for a model without edges"""

    @property
    def window(self) -> Tensor:
        """The H input positions ``[N, H, d]``."""
        return self.frames[:, -HISTORY - self.ahead : -self.ahead]

    @property
    def earlier_window(self) -> Tensor:
        """The window one frame before, ``[N, H, d]``."""
        return self.frames[:, -HISTORY - self.ahead - 1 : -self.ahead - 1]

    @property
    def following(self) -> Tensor:
        """The positions ``[N, K, d]`` to be predicted."""
        return self.frames[:, -self.ahead :]

    def to(self, device: torch.device) -> Batch:
        """The same batch on another device."""
        moved = self._with(lambda part: part.to(device, non_blocking=True))
        return replace(moved, ptr=self.ptr)

    def pin_memory(self) -> Batch:
        """The same batch in page-locked memory; torch's DataLoader calls this."""
        return self._with(lambda part: part.pin_memory())

    def _with(self, change: Callable[[Any], Any]) -> Batch:
        parts = {
            name: part for name, part in vars(self).items() if isinstance(part, Tensor | Graph)
        }
        return replace(self, **{name: change(part) for name, part in parts.items()})


class Windows(Dataset[Sample]):
    """All windows of a split; indexed by :data:`Key`."""

    def __init__(
        self, trajectories: Trajectories, metadata: Metadata, config: TrainConfig, *, noise: float
    ) -> None:
        self.trajectories = trajectories
        self.metadata = metadata
        self.config = config
        self.noise = noise
        self.radius = config.model.radius_or(metadata.radius)
        self.frames = HISTORY + config.unroll + (config.graph != "base")
        counts = np.maximum(trajectories.lengths - self.frames + 1, 0)
        self.starts = np.concatenate([[0], np.cumsum(counts)])
        self.particles = np.repeat(trajectories.particle_counts, counts)

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, key: Key) -> Sample:
        epoch, number = key
        rng = np.random.default_rng([self.config.seed, epoch, number])
        trajectory = int(np.searchsorted(self.starts, number, side="right")) - 1
        start = int(number - self.starts[trajectory])
        window = self.trajectories.window(trajectory, start, start + self.frames)
        positions = window.positions
        mobile = self.metadata.mobile(window.particle_type)
        if self.config.mirror and rng.random() < 0.5:
            positions[..., 0] = np.float32(sum(self.metadata.bounds[0])) - positions[..., 0]
        self._add_noise(rng, positions, mobile)
        return Sample(positions, window.particle_type, window.material_property)

    def _add_noise(
        self,
        rng: np.random.Generator,
        positions: NDArray[np.float32],
        mobile: NDArray[np.bool_],
    ) -> None:
        """Add noise to the inputs among ``positions`` ``[F, N, d]``, and to the positions that
        follow what the targets are to answer it with."""
        config = self.config
        first = len(positions) - config.unroll  # that follows
        inputs, following = positions[first - HISTORY : first], positions[first:]
        _, particles, dim = positions.shape
        if self.noise > 0:
            walk = random_walk_noise(rng, HISTORY, particles, dim, self.noise)
            walk *= mobile[:, None]
            inputs += walk
            # What follows moves along, so that each target undoes no more of the noise of the
            # velocity and the position before it than the shares asked for.
            before, offset = walk[-2], walk[-1]
            for frame in range(config.unroll):
                velocity = offset - before
                before = offset
                offset = np.float32(1 - config.position_correction) * offset
                offset += np.float32(1 - config.velocity_correction) * velocity
                following[frame] += offset
        if config.drift > 0:
            drift = drift_noise(rng, first, dim, config.drift)
            positions[:first] += drift[:, None] * mobile[:, None]
        # Where solid bodies move or stand, the fluid around them cannot go just anywhere.
        if config.compression > 0 and mobile.all():
            displacement, answers = compression(
                rng,
                inputs[-1],
                np.array(self.metadata.bounds),
                self.metadata.periodic,
                strain=config.compression,
                radius=self.radius,
                frames=config.unroll,
            )
            positions += displacement
            following += answers

    def collate_share(self, samples: Sequence[Sample]) -> Batch | None:
        """:meth:`collate` of what may be no samples, which give None."""
        return self.collate(samples) if samples else None

    def collate(self, samples: Sequence[Sample]) -> Batch:
        """One batch with its base graph, built on the noisy positions."""
        frames = np.concatenate([s.positions for s in samples], axis=1)
        particle_type = np.concatenate([s.particle_type for s in samples])
        ptr = np.cumsum([0, *(s.positions.shape[1] for s in samples)], dtype=np.int64)
        materials = [s.material for s in samples if s.material is not None]
        model = self.config.model
        graph = None
        if model.edges:
            edges = radius_graph(
                frames[HISTORY - 1],  # the last input, or the one before where one is in front
                self.radius,
                ptr=ptr,
                box=self.metadata.box,
                self_edges=model.self_edges,
                threads=thread_count(),
                return_offsets=True,
            )
            graph = Graph.from_numpy(*edges)
        return Batch(
            frames=torch.from_numpy(np.ascontiguousarray(frames.transpose(1, 0, 2))),
            ahead=self.config.unroll,
            particle_type=torch.from_numpy(particle_type),
            material=torch.from_numpy(np.concatenate(materials)) if materials else None,
            mobile=torch.from_numpy(self.metadata.mobile(particle_type)),
            ptr=torch.from_numpy(ptr),
            graph=graph,
        )


class ShuffledKeys(Sampler[list[Key]]):
    """The keys of each batch from step ``first`` to step ``last``.

    Windows come epoch after epoch, each a permutation drawn from (seed, epoch); none is left out,
    and a batch may straddle two epochs. A batch takes ``batch`` windows, or fewer where the next
    one would exceed ``most`` particles. ``particles`` ``[n]`` counts those of each window. Of every
    batch's keys this process takes number ``rank`` and every ``processes``-th after it.
    """

    def __init__(
        self,
        particles: NDArray[np.int64],
        *,
        batch: int,
        most: int | None,
        seed: int,
        first: int,
        last: int,
        rank: int = 0,
        processes: int = 1,
    ) -> None:
        self.particles, self.batch, self.seed = particles, batch, seed
        self.most = np.inf if most is None else most
        self.first, self.last = first, last
        self.share = slice(rank, None, processes)

    def __len__(self) -> int:
        return self.last - self.first

    def __iter__(self) -> Iterator[list[Key]]:
        return (keys[self.share] for keys in islice(self._batches(), self.first, self.last))

    def _batches(self) -> Iterator[list[Key]]:
        keys: list[Key] = []
        total = 0
        for epoch in count():
            order = np.random.default_rng([self.seed, epoch]).permutation(len(self.particles))
            for number in order.tolist():
                size = int(self.particles[number])
                if keys and (len(keys) == self.batch or total + size > self.most):
                    yield keys
                    keys, total = [], 0
                keys.append((epoch, number))
                total += size


def training_batches(
    windows: Windows,
    config: TrainConfig,
    first: int,
    *,
    pin: bool,
    rank: int = 0,
    processes: int = 1,
) -> DataLoader[Sample]:
    """The batches of steps ``first`` to ``config.steps``, of each this process's share, as
    :class:`Batch`, None where that is empty."""
    keys = ShuffledKeys(
        windows.particles,
        batch=config.batch,
        most=config.batch_particles,
        seed=config.seed,
        first=first,
        last=config.steps,
        rank=rank,
        processes=processes,
    )
    return DataLoader(
        windows,
        batch_sampler=keys,
        num_workers=config.workers,
        collate_fn=windows.collate_share,
        pin_memory=pin,
        worker_init_fn=_begin_worker,
    )


def _begin_worker(_: int) -> None:
    """A worker is one thread, and leaves signals that reach the whole group of processes, Ctrl-C
    and a scheduler's SIGTERM, to its parent, who saves and ends its workers."""
    divide_threads(1)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
