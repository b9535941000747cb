"""The embedded data sets' cache."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from adaptgns import _core
from adaptgns.data import DataError, open_split
from adaptgns.data import default as default_module
from adaptgns.data.default import (
    DEFAULT_SETS,
    EMBEDDED,
    cache_folder,
    dataset_folder,
    default_dataset,
)
from adaptgns.data.generation import SplitPlan

TINY = {
    split: SplitPlan("waterdrop", 2, frames=7, particles=(20, 30))
    for split in ("train", "valid", "test")
}


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ADAPTGNS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setitem(default_module.DEFAULT_SETS, "waterdrop", TINY)
    return tmp_path / "cache"


def test_made_once(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = default_dataset("waterdrop")
    assert folder.parent == cache
    assert [path.name for path in cache.iterdir()] == [folder.name]
    assert len(open_split(folder, "test")) == 2

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("made again")

    monkeypatch.setattr(default_module, "generate_dataset", refuse)
    assert default_dataset("waterdrop") == folder
    assert dataset_folder("waterdrop") == folder


def flip(folder: Path) -> None:
    content = bytearray((folder / "train.h5").read_bytes())
    content[len(content) // 2] ^= 1
    (folder / "train.h5").write_bytes(content)


def remove(folder: Path) -> None:
    (folder / "valid.h5").unlink()


def empty(folder: Path) -> None:
    (folder / "manifest.json").write_text("")


def mistype(folder: Path) -> None:
    (folder / "manifest.json").write_text("[]")


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (flip, "train.h5 doesn't match its checksum"),
        (remove, "valid.h5 is missing"),
        (empty, "manifest.json can't be read"),
        (mistype, "manifest.json can't be read"),
    ],
)
@pytest.mark.usefixtures("cache")
def test_damage_is_told_and_mended(
    damage: object, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = default_dataset("waterdrop")
    whole = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert callable(damage)
    damage(folder)
    capsys.readouterr()
    assert default_dataset("waterdrop") == folder
    assert f"{told}" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == whole
    assert len(list(folder.parent.iterdir())) == 1


def test_another_plan_or_solver_is_another_set(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = default_dataset("waterdrop")
    longer = TINY | {"train": SplitPlan("waterdrop", 3, frames=7, particles=(20, 30))}
    monkeypatch.setitem(default_module.DEFAULT_SETS, "waterdrop", longer)
    second = default_dataset("waterdrop")
    simulate = _core.simulate

    def changed(scene: str, **options: object) -> tuple[object, object]:
        positions, types = simulate(scene, **options)  # type: ignore[arg-type]
        return positions + 1e-4, types

    monkeypatch.setattr(_core, "simulate", changed)
    assert len({first, second, default_dataset("waterdrop")}) == 3
    assert len(list(cache.iterdir())) == 3


def test_an_interrupted_making_leaves_nothing(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(default_module, "replace_text", interrupt)
    with pytest.raises(KeyboardInterrupt):
        default_dataset("waterdrop")
    assert list(cache.iterdir()) == []


def test_remains_of_killed_processes_are_swept(cache: Path) -> None:
    for name, age in (("old", 2 * 86400), ("young", 60)):
        (cache / f".making-{name}").mkdir(parents=True)
        then = time.time() - age
        os.utime(cache / f".making-{name}", (then, then))
    default_dataset("waterdrop")
    assert {path.name for path in cache.glob(".making-*")} == {".making-young"}


def test_where_the_cache_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("ADAPTGNS_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert cache_folder() == Path.home() / ".cache" / "adaptgns"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folder() == Path.home() / ".cache" / "adaptgns"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "adaptgns"
    monkeypatch.setenv("ADAPTGNS_CACHE", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"


def test_names_and_folders(tmp_path: Path) -> None:
    assert set(EMBEDDED) == set(DEFAULT_SETS) == {"waterdrop", "sand"}
    assert dataset_folder(str(tmp_path)) == tmp_path
    with pytest.raises(DataError, match=r"data is 'watrdrop'; .*waterdrop, sand"):
        dataset_folder("watrdrop")
    with pytest.raises(DataError, match=r"scene is 'goop'; waterdrop, sand"):
        default_dataset("goop")  # type: ignore[arg-type]


def test_a_folder_comes_before_the_embedded_set_of_its_name(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("waterdrop").mkdir()
    assert dataset_folder("waterdrop").parent == cache  # what holds no data set is not meant
    (tmp_path / "waterdrop" / "metadata.json").touch()
    assert dataset_folder("waterdrop") == Path("waterdrop")
