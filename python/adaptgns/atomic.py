"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A partial name beside ``path`` to write to; it takes the place of ``path`` when the block
    ends, and is removed when the block raises.

    A process that is killed leaves the partial name at most, never a file under ``path`` that is
    not whole. Missing parent folders are made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # The process id keeps two writers of one path apart: the later one to end wins, whole.
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
