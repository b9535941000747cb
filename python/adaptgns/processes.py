"""The processes of one training run, as ``torchrun`` starts them; alone without it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from adaptgns.config import Device, torch_device

T = TypeVar("T")

PATIENCE = timedelta(days=1)
"""How long the others wait for the first, which makes the data, validates and writes."""


class OtherEndedError(RuntimeError):
    """Another process is gone, and what all were to do together cannot be done."""


@dataclass(frozen=True)
class Processes:
    """``count`` processes that take each step together; this one is number ``rank``.

    Each works on its share of the samples, holds the same weights, and makes the same update. The
    first one alone writes. What they do together raises :class:`OtherEndedError` where one is gone.
    """

    rank: int = 0
    count: int = 1
    patient: Any = None
    """Torch's group of all that is used where one may be long in coming; None for its default."""

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
        if not weight:
            flat.zero_()  # the mean of nothing may be NaN
        with _together():
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
        answer = torch.tensor(int(mine))
        with _together():
            dist.all_reduce(answer, dist.ReduceOp.MAX, group=self.patient)
        return bool(answer)

    def same(self, ask: Callable[[], T]) -> T:
        """What ``ask`` gives the first process, which alone calls it; all must come here."""
        if self.count == 1:
            return ask()
        said: list[Any] = [ask() if self.first else None]
        with _together():
            dist.broadcast_object_list(said, group=self.patient)
        answer: T = said[0]
        return answer

    def wait(self) -> None:
        """Until all are here."""
        if self.count > 1:
            with _together():
                dist.barrier(group=self.patient)

    @contextmanager
    def first_ahead(self) -> Iterator[None]:
        """What the first process does before the others begin; if it fails, they do not."""
        if not self.first:
            self.wait()
        yield
        if self.first:
            self.wait()


@contextmanager
def _together() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        reason = str(error).partition("\n")[0].partition(". ")[0]
        raise OtherEndedError(
            f"another process ended, and its own message says why ({reason})"
        ) from error


ALONE = Processes()


@contextmanager
def processes(device: Device) -> Iterator[Processes]:
    """Those that ``torchrun`` has started: by NCCL with a GPU each, by gloo on CPUs."""
    if not dist.is_torchelastic_launched():
        yield ALONE
        return
    patient = None
    if torch_device(device).type == "cuda":
        here, gpus = int(os.environ["LOCAL_WORLD_SIZE"]), torch.cuda.device_count()
        if here > gpus:
            raise ValueError(
                f"LOCAL_WORLD_SIZE: got {here} processes for {gpus} GPUs; accepted is at most one "
                "each (torchrun's --nproc-per-node)"
            )
        gpu = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(gpu)
        dist.init_process_group("nccl", device_id=gpu)
        patient = dist.new_group(backend="gloo", timeout=PATIENCE)
    else:
        dist.init_process_group("gloo", timeout=PATIENCE)
    try:
        yield Processes(dist.get_rank(), dist.get_world_size(), patient)
    except BaseException:
        # Not NCCL's, which would wait for the others: they may not have met the exception.
        dist.destroy_process_group(patient)
        raise
    dist.destroy_process_group()
