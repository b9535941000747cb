"""What a measurement was made on, and how much memory this process has."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import torch

from adaptgns.reproduce.runs import processor


def machine() -> dict[str, object]:
    """Processor, threads, versions, and how busy it was."""
    return {
        "processor": processor(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load_before": os.getloadavg()[0],
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def resident(what: str) -> float:
    """A figure of this process's memory, ``VmRSS`` or ``VmHWM`` (the most so far), in MiB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(what + ":"):
            return int(line.split()[1]) / 2**10
    raise RuntimeError(f"{what}: not told by this system")
