"""How many threads the Rust core may use beside torch's."""

from __future__ import annotations

import torch

_count: int | None = None


def divide_threads(count: int) -> None:
    """From now on, ``count`` threads for the Rust core and one for torch.

    Torch's threads go on spinning for a while after each of its operations, on the cores that the
    core's would use; where the core does most of the work, that is slower than doing without.
    """
    global _count  # noqa: PLW0603 (as torch's own number of threads)
    _count = count
    torch.set_num_threads(1)


def thread_count() -> int:
    """Threads for the Rust core: what they were divided into, or as many as torch takes."""
    return _count or torch.get_num_threads()
