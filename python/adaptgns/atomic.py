"""Files that appear whole or not at all."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np


def publish(partial: Path, final: Path) -> None:
    """Give a finished file its name, after its bytes have reached the disk.

    Raises OSError where the disk is full or the folder cannot be written.
    """
    with partial.open("rb+") as file:
        os.fsync(file.fileno())
    partial.replace(final)
    # The rename itself survives a power cut only once the folder is on disk; not every system
    # lets a folder be opened for that.
    with suppress(OSError):
        folder = os.open(final.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


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
        publish(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def folder_written_whole(path: Path) -> Iterator[Path]:
    """A partial folder beside ``path`` to write to, renamed to ``path`` when the block ends and
    removed when it raises. ``path`` must not exist, or be an empty folder.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.mkdir()
    try:
        yield partial
        partial.replace(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def replace_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path``, replacing what is there only once all of it is on disk."""
    with written_whole(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, content: dict[str, Any] | list[Any]) -> None:
    """Write ``content`` with six significant digits, whole or not at all."""
    replace_text(path, json.dumps(json_types(content, digits=6), allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """What a file holds as JSON; ValueError, with its name, where it is none."""
    try:
        return json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not readable as JSON: {error}") from None


def six_digits(value: float) -> float:
    """``value`` as :func:`write_json` writes it."""
    return float(f"{value:.6g}")


def json_types(value: Any, *, digits: int | None = None) -> Any:
    """``value`` as JSON types, numbers with so many significant ``digits``, and null for those that
    JSON does not know."""
    match value:
        case dict():
            return {key: json_types(item, digits=digits) for key, item in value.items()}
        case list() | tuple():
            return [json_types(item, digits=digits) for item in value]
        case np.ndarray() | np.generic():
            return json_types(value.tolist(), digits=digits)
        case float() if not math.isfinite(value):
            return None
        case float() if digits is not None:
            return float(f"{value:.{digits}g}")
        case _:
            return value
