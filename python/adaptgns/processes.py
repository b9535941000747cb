"""The processes of one training run, as ``torchrun`` starts them; alone without it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from adaptgns.config import Device, torch_device

T = TypeVar("T")


@dataclass(frozen=True)
class Processes:
    """``count`` processes that take each step together; this one is number ``rank``.

    Each works on its share of the samples, holds the same weights, and makes the same update. The
    first one alone writes.
    """

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the process that writes."""
        return self.rank == 0

    def mean_gradients(
        self, parameters: Iterable[nn.Parameter], loss: Tensor | None, weight: int
    ) -> Tensor:
        """The mean loss of all processes, weighted; the parameters' gradients become its own.

        ``loss`` is the scalar whose gradients the parameters hold, ``weight`` the number of
        particles that it is the mean of; None and 0 where this process had no samples.
        """
        own = list(parameters)
        device = own[0].device
        share = torch.zeros(()) if loss is None else loss.detach()
        parts = [torch.tensor([weight], device=device), (share.to(device) * weight).view(1)]
        for parameter in own:
            gradient = parameter.grad
            if gradient is None:
                gradient = torch.zeros_like(parameter)
            parts.append(gradient.flatten() * weight)
        flat = torch.cat([part.float() for part in parts])
        dist.all_reduce(flat)
        flat = flat / flat[0]
        gradients = flat[2:].split([parameter.numel() for parameter in own])  # type: ignore[no-untyped-call]
        for parameter, gradient in zip(own, gradients, strict=True):
            parameter.grad = gradient.view_as(parameter)
        return flat[1]

    def any(self, mine: bool) -> bool:
        """Whether it is so in any process; all must ask."""
        if self.count == 1:
            return mine
        answers: list[bool] = [False] * self.count
        dist.all_gather_object(answers, mine)
        return any(answers)

    def same(self, mine: T) -> T:
        """What the first process says; all must ask."""
        if self.count == 1:
            return mine
        said = [mine]
        dist.broadcast_object_list(said)
        return said[0]

    def wait(self) -> None:
        """Until all are here."""
        if self.count > 1:
            dist.barrier()


ALONE = Processes()


@contextmanager
def processes(device: Device) -> Iterator[Processes]:
    """Those that ``torchrun`` has started: by NCCL with a GPU each, by gloo on CPUs."""
    if not dist.is_torchelastic_launched():
        yield ALONE
        return
    on_gpu = torch_device(device).type == "cuda"
    if on_gpu:
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("nccl" if on_gpu else "gloo")
    try:
        yield Processes(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()
