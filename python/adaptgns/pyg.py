"""PyTorch Geometric: our radius graph under its name, and frames with their graphs as `Data`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from adaptgns import _core
from adaptgns.config import HISTORY
from adaptgns.data.trajectory import Trajectory
from adaptgns.periodic import minimum_image

if TYPE_CHECKING:
    from adaptgns.data.metadata import Metadata


def radius_graph(
    x: Tensor,
    r: float,
    batch: Tensor | None = None,
    loop: bool = False,
    max_num_neighbors: int | None = None,
    flow: Literal["source_to_target", "target_to_source"] = "source_to_target",
    num_workers: int | None = None,
    batch_size: int | None = None,
) -> Tensor:
    """`torch_geometric.nn.radius_graph` without its silent truncation; built on the CPU.

    Needs no PyTorch Geometric. Pairs at a distance of exactly `r` count, too. Edges are sorted by
    their target, then their source.

    Args:
        x: positions `[N, d]`, d 2 or 3.
        r: radius, in the unit of `x`.
        batch: int64 `[N]`, the example of each point, sorted; None: one example.
        loop: whether points are joined with themselves.
        max_num_neighbors: edges into a point at most. Where PyTorch Geometric drops those beyond
            it, this raises; None, the default, is no limit.
        flow: which row holds the targets: 1 for source_to_target, else 0.
        num_workers: threads; None: one per core. The result doesn't depend on it.
        batch_size: number of examples; only checked, since edges don't depend on it.

    Returns:
        int64 `[2, E]` on the device of `x`.

    Raises:
        ValueError: an argument can't be, or a point has more neighbours than `max_num_neighbors`.
    """
    if flow not in {"source_to_target", "target_to_source"}:
        raise ValueError(f"flow is {flow!r}; source_to_target and target_to_source are accepted")
    ptr = None if batch is None else _offsets(batch, len(x), batch_size)
    edges, offsets = _core.radius_graph(
        x.detach().cpu().numpy(),
        r,
        ptr=ptr,
        self_edges=loop,
        threads=num_workers,
        return_offsets=True,
    )
    if max_num_neighbors is not None and len(x):
        degrees = offsets[1:] - offsets[:-1]
        if degrees.max() > max_num_neighbors:
            raise ValueError(
                f"max_num_neighbors is {max_num_neighbors}, but point {degrees.argmax()} has "
                f"{degrees.max()} within r = {r}; none is dropped here: raise the limit or pass "
                "None"
            )
    edge_index = torch.from_numpy(edges)
    return (edge_index if flow == "source_to_target" else edge_index.flip(0)).to(x.device)


def frame_data(
    trajectory: Trajectory,
    frame: int,
    metadata: Metadata,
    *,
    radius: float | None = None,
    self_edges: bool = False,
) -> Any:
    """A frame with its graph as a `torch_geometric.data.Data` object.

    Tensors (N particles, E edges, d dimensions), in the data's length unit and per frame:
    `pos` `[N, d]`; `velocity` `[N, 5, d]`, the last five displacements, oldest first;
    `particle_type` int64 `[N]`; `material_property` `[N, P]` where there is one; `edge_index` int64
    `[2, E]`, senders first; `edge_attr` `[E, d + 1]`, (sender - receiver) / radius and its norm;
    `y` `[N, d]`, the acceleration per frame² to the next frame, absent at the last. Displacements
    are to the nearest image along periodic axes.

    Args:
        trajectory: where the frame is from.
        frame: its number, from 5, since five velocities come before it.
        metadata: of the data set.
        radius: of the graph, in the data's length unit; None: that of the metadata.
        self_edges: whether particles are joined with themselves.

    Raises:
        ImportError: PyTorch Geometric isn't installed.
        ValueError: there is no such frame, or the radius can't be.
    """
    try:
        from torch_geometric.data import Data  # noqa: PLC0415 - an optional dependency
    except ImportError as error:
        raise ImportError(
            "frame_data needs PyTorch Geometric; pip install torch_geometric"
        ) from error
    last = len(trajectory.positions) - 1
    if not HISTORY - 1 <= frame <= last:
        raise ValueError(f"frame is {frame}; {HISTORY - 1} to {last} are accepted")
    radius = metadata.radius if radius is None else radius
    box = metadata.box
    frames = trajectory.positions[frame + 1 - HISTORY : frame + 2]
    displacement = minimum_image(frames[1:] - frames[:-1], box)  # [5 or 6, N, d]
    positions = frames[HISTORY - 1]
    edges = _core.radius_graph(positions, radius, box=box, self_edges=self_edges)
    apart = minimum_image(positions[edges[0]] - positions[edges[1]], box)  # [E, d]
    relative = torch.as_tensor(apart / radius, dtype=torch.float32)
    data = Data(
        pos=torch.from_numpy(positions.copy()),
        velocity=torch.as_tensor(displacement[: HISTORY - 1], dtype=torch.float32).transpose(0, 1),
        particle_type=torch.from_numpy(trajectory.particle_type),
        edge_index=torch.from_numpy(edges),
        edge_attr=torch.cat([relative, relative.norm(dim=1, keepdim=True)], dim=1),
    )
    if trajectory.material_property is not None:
        data.material_property = torch.from_numpy(trajectory.material_property)
    if frame < last:
        data.y = torch.as_tensor(displacement[-1] - displacement[-2], dtype=torch.float32)
    return data


def _offsets(batch: Tensor, points: int, batch_size: int | None) -> Any:
    """Offsets `[B + 1]` of the examples."""
    if batch.shape != (points,):
        raise ValueError(f"batch has shape {list(batch.shape)}; [{points}] is accepted")
    if (batch.diff() < 0).any() or (points and batch[0] < 0):
        raise ValueError(
            "batch isn't sorted; examples from 0 on, one after the other, are accepted"
        )
    examples = int(batch[-1]) + 1 if points else 0
    if batch_size is not None and batch_size < examples:
        raise ValueError(f"batch_size is {batch_size}, but batch goes to {examples - 1}")
    lengths = torch.bincount(batch.cpu(), minlength=examples)
    return torch.cat([lengths.new_zeros(1), lengths.cumsum(0)]).numpy()
