"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


def publish(partial: Path, final: Path) -> None:
    """Gives a finished file its name, after its bytes have reached the disk.

    Raises:
        OSError: the disk is full or the folder can't be written.
    """
    descriptor = os.open(partial, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    partial.replace(final)
    # The rename itself survives a power cut only once the folder is on disk; not every system
    # lets a folder be opened for that.
    with suppress(OSError):
        folder = os.open(final.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def replace_text(path: Path, text: str) -> None:
    """Writes `text` to `path`, replacing what is there only once all of it is on disk."""
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    partial = path.with_name(os.path.basename(name))
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
        partial.chmod(0o666 & ~_umask())
        publish(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _umask() -> int:
    """mkstemp makes private files; published ones follow the user's umask."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
