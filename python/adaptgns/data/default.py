"""The embedded default data sets: made once, kept in the user's cache, verified on every use."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from adaptgns import _core
from adaptgns.atomic import replace_text
from adaptgns.data.errors import DataError
from adaptgns.data.generation import SplitPlan, generate_dataset
from adaptgns.data.metadata import FILE_NAME
from adaptgns.data.scenes import SceneName

if TYPE_CHECKING:
    from collections.abc import Mapping

DEFAULT_SETS: dict[SceneName, dict[str, SplitPlan]] = {
    # Training on small drops fits more steps into the time; what is measured is full size.
    "waterdrop": {
        "train": SplitPlan("waterdrop", 400, frames=300, seed=0, particles=(40, 200)),
        "valid": SplitPlan("waterdrop", 10, frames=400, seed=0),
        "test": SplitPlan("waterdrop", 30, frames=400, seed=0),
    },
    "sand": {
        "train": SplitPlan("sand", 400, frames=320, seed=0, particles=(40, 200)),
        "valid": SplitPlan("sand", 10, frames=320, seed=0),
        "test": SplitPlan("sand", 30, frames=320, seed=0),
    },
}

EMBEDDED: tuple[SceneName, ...] = tuple(DEFAULT_SETS)
"""Names that stand for a default data set wherever a folder is accepted."""

_MANIFEST = "manifest.json"
_ABANDONED_AFTER = 24 * 3600.0
"""Seconds after which a half-made set in the cache is taken to be nobody's."""


def dataset_folder(data: str | Path) -> Path:
    """The folder of a data set named on a command line: a folder, or the name of an embedded one.

    A data set that lies in a folder of such a name is meant, not the embedded one.

    Raises:
        DataError: neither.
    """
    folder = Path(data)
    if data in EMBEDDED and not (folder / FILE_NAME).exists():
        return default_dataset(data)
    if not folder.is_dir():
        raise DataError(
            f"data is {str(data)!r}; a folder with metadata.json and train, valid and test files, "
            f"or one of {', '.join(EMBEDDED)}, is accepted"
        )
    return folder


def default_dataset(scene: SceneName, *, console: Console | None = None) -> Path:
    """The folder of a scene's default data set, made on first use.

    It lies in `$ADAPTGNS_CACHE`, else in `adaptgns` under `$XDG_CACHE_HOME` or `~/.cache`. Its
    files' checksums are verified; a damaged set is made again, and said to be.

    Args:
        scene: `waterdrop` or `sand`.
        console: where progress is shown; standard error by default.

    Raises:
        DataError: no such scene.
        OSError: the cache can't be written.
    """
    if scene not in EMBEDDED:
        raise DataError(f"scene is {scene!r}; {', '.join(EMBEDDED)} are accepted")
    console = console or Console(stderr=True)
    plans = DEFAULT_SETS[scene]
    folder = cache_folder() / f"{scene}-{_key(plans)}"
    if folder.exists():
        damage = _damage(folder)
        if damage is None:
            return folder
        console.print(f"{folder}: {damage}; making it again", highlight=False, soft_wrap=True)
    else:
        console.print(
            f"making the default {scene} data set in {folder}", highlight=False, soft_wrap=True
        )
    _make(folder, plans, console)
    return folder


def cache_folder() -> Path:
    """Where default data sets are kept."""
    if chosen := os.environ.get("ADAPTGNS_CACHE"):
        return Path(chosen)
    # The XDG specification has relative paths ignored.
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".cache") / "adaptgns"


def _key(plans: Mapping[str, SplitPlan]) -> str:
    """Names the content: the plans, and the solver by what it does.

    A version number would have to be raised by hand with each change of the solver's results. A
    small trajectory that falls and splashes takes a fraction of a second and can't be forgotten.
    """
    train = plans["train"]
    positions, _ = _core.simulate(
        train.scene, seed=0, frames=200, dim=train.dim, particles=(50, 100)
    )
    plan = json.dumps({split: asdict(plan) for split, plan in plans.items()}, sort_keys=True)
    return hashlib.sha256(plan.encode() + positions.tobytes()).hexdigest()[:12]


def _make(folder: Path, plans: Mapping[str, SplitPlan], console: Console) -> None:
    """Makes the set beside its place, then moves it there, so that others see it whole."""
    cache = folder.parent
    cache.mkdir(parents=True, exist_ok=True)
    _sweep(cache)
    with tempfile.TemporaryDirectory(prefix=".making-", dir=cache) as made:
        generate_dataset(Path(made) / "set", plans, console=console)
        checksums = {path.name: _sha256(path) for path in sorted((Path(made) / "set").iterdir())}
        replace_text(Path(made) / "set" / _MANIFEST, json.dumps(checksums, indent=2) + "\n")
        if folder.exists():
            folder.replace(Path(made) / "damaged")
        try:
            (Path(made) / "set").replace(folder)
        except OSError:
            # Another process may have made the same set in the meantime.
            if not folder.exists() or _damage(folder) is not None:
                raise


def _sweep(cache: Path) -> None:
    """Removes what killed processes left half made."""
    for leftover in cache.glob(".making-*"):
        with suppress(OSError):
            if time.time() - leftover.stat().st_mtime > _ABANDONED_AFTER:
                shutil.rmtree(leftover, ignore_errors=True)


def _damage(folder: Path) -> str | None:
    """What is wrong with a cached set; None when every file is as it was made."""
    try:
        checksums = json.loads((folder / _MANIFEST).read_bytes())
        for name, expected in checksums.items():
            if _sha256(folder / name) != expected:
                return f"{name} doesn't match its checksum"
    except FileNotFoundError as error:
        return f"{Path(error.filename).name} is missing"
    except (OSError, ValueError, AttributeError) as error:
        return f"{_MANIFEST} can't be read ({error})"
    return None


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
