"""Splits: finding them, windows, other processes."""

from __future__ import annotations

import json
import multiprocessing
import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.data import DataLoader, Dataset

from adaptgns.data import DataError, Trajectories, Trajectory, open_split
from adaptgns.data import cache as cache_module
from adaptgns.data.store import write_split


def trajectory(frames: int = 10, particles: int = 4, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng([seed, frames, particles])
    positions = rng.random((frames, particles, 2), dtype=np.float32)
    return Trajectory("", positions, rng.integers(0, 9, particles))


def write_npz(path: Path, trajectories: list[Trajectory]) -> None:
    members = {}
    for index, one in enumerate(trajectories):
        members[f"t{index}"] = np.empty(2, dtype=object)
        members[f"t{index}"][:] = one.positions, one.particle_type
    np.savez(path, **members)


def write_compressed(path: Path, trajectories: list[Trajectory]) -> None:
    with h5py.File(path, "w") as file:
        for index, one in enumerate(trajectories):
            group = file.create_group(f"{index:05d}")
            group.create_dataset("position", data=one.positions, compression="gzip")
            group["particle_type"] = one.particle_type.astype(np.int32)


FORMATS = {
    "native": (write_split, ".h5"),
    "compressed": (write_compressed, ".h5"),
    "npz": (write_npz, ".npz"),
}
TRAJECTORIES = [trajectory(10, 4), trajectory(7, 2), trajectory(25, 9)]


@pytest.fixture(params=FORMATS)
def split(request: pytest.FixtureRequest, tmp_path: Path) -> Trajectories:
    write, suffix = FORMATS[request.param]
    write(tmp_path / f"train{suffix}", TRAJECTORIES)
    return open_split(tmp_path, "train")


def test_a_split_is_a_sequence(split: Trajectories) -> None:
    assert len(split) == 3
    assert split.dim == 2
    assert split.lengths.tolist() == [10, 7, 25]
    assert split.particle_counts.tolist() == [4, 2, 9]
    for read, written in zip(split, TRAJECTORIES, strict=True):
        np.testing.assert_array_equal(read.positions, written.positions)
        np.testing.assert_array_equal(read.particle_type, written.particle_type)
        assert read.material_property is None
    np.testing.assert_array_equal(split[-1].positions, TRAJECTORIES[2].positions)
    for index in (3, -4):
        with pytest.raises(IndexError, match=f"trajectory {index} of 3"):
            split[index]


def test_windows(split: Trajectories) -> None:
    @given(data=st.data())
    def check(data: st.DataObject) -> None:
        index = data.draw(st.integers(0, 2))
        start = data.draw(st.integers(0, int(split.lengths[index]) - 1))
        stop = data.draw(st.integers(start + 1, int(split.lengths[index])))
        window = split.window(index, start, stop)
        np.testing.assert_array_equal(window.positions, TRAJECTORIES[index].positions[start:stop])
        assert window.positions.flags.writeable
        assert window.positions.flags.c_contiguous

    check()


@pytest.mark.parametrize(("start", "stop"), [(-1, 3), (3, 3), (4, 3), (0, 8)])
def test_frames_that_are_not_there(split: Trajectories, start: int, stop: int) -> None:
    with pytest.raises(IndexError, match=f"frames {start} to {stop} of trajectory .* has 7"):
        split.window(1, start, stop)


def test_a_small_cache_changes_nothing(
    split: Trajectories, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache_module, "CACHE_BYTES", 100)
    tight: Trajectories = pickle.loads(pickle.dumps(split))
    for index in (0, 2, 0, 1, 2, 0):
        np.testing.assert_array_equal(tight[index].positions, TRAJECTORIES[index].positions)


class FirstFrames(Dataset[np.ndarray]):
    def __init__(self, split: Trajectories) -> None:
        self.split = split

    def __len__(self) -> int:
        return 3

    def __getitem__(self, index: int) -> np.ndarray:
        return self.split.window(index, 0, 7).positions


def read_in_worker(split: Trajectories, method: str) -> list[np.ndarray]:
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system doesn't {method}")
    split[0]  # whatever a process keeps is there before the worker starts
    loader = DataLoader(
        FirstFrames(split), batch_size=None, num_workers=1, multiprocessing_context=method
    )
    return [np.asarray(window) for window in loader]


def test_reading_in_forked_workers(split: Trajectories) -> None:
    for window, written in zip(read_in_worker(split, "fork"), TRAJECTORIES, strict=True):
        np.testing.assert_array_equal(window, written.positions[:7])


def test_reading_in_a_spawned_worker(tmp_path: Path) -> None:
    write_npz(tmp_path / "train.npz", TRAJECTORIES)
    split = open_split(tmp_path, "train")
    for window, written in zip(read_in_worker(split, "spawn"), TRAJECTORIES, strict=True):
        np.testing.assert_array_equal(window, written.positions[:7])


def test_pickled_splits_read_on(split: Trajectories) -> None:
    split[0]
    copy: Trajectories = pickle.loads(pickle.dumps(split))
    assert len(pickle.dumps(split)) < 5000  # the data stays behind
    np.testing.assert_array_equal(copy[2].positions, TRAJECTORIES[2].positions)


def test_valid_may_be_called_val_on_disk(tmp_path: Path) -> None:
    write_split(tmp_path / "val.h5", TRAJECTORIES)
    assert open_split(tmp_path, "valid").path.name == "val.h5"


def test_missing_splits(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no test\.h5 or test\.npz; the folder is empty"):
        open_split(tmp_path, "test")
    write_split(tmp_path / "train.h5", TRAJECTORIES)
    with pytest.raises(DataError, match=r"no test\.h5 or test\.npz; the folder holds train\.h5"):
        open_split(tmp_path, "test")
    with pytest.raises(DataError, match="there is no such folder"):
        open_split(tmp_path / "elsewhere", "test")
    with pytest.raises(DataError, match="it isn't a folder"):
        open_split(tmp_path / "train.h5", "test")
    with pytest.raises(DataError, match=r"split is 'val'; train, valid, test are accepted"):
        open_split(tmp_path, "val")


def test_dimensions_that_metadata_contradicts(tmp_path: Path) -> None:
    write_split(tmp_path / "train.h5", TRAJECTORIES)
    (tmp_path / "metadata.json").write_text(json.dumps({"dim": 3}))
    with pytest.raises(DataError, match=r"train\.h5: .*2 dimensions, metadata\.json says dim 3"):
        open_split(tmp_path, "train")


def test_not_finite_frames_are_named(split: Trajectories, tmp_path: Path) -> None:
    broken = [trajectory(10), trajectory(12)]
    broken[1].positions[8, 3, 1] = np.inf
    if split.path.suffix == ".npz":
        write_npz(split.path, broken)
    else:
        write_compressed(split.path, broken)
    reopened = open_split(tmp_path, "train")
    reopened.window(1, 0, 8)
    with pytest.raises(DataError, match=r"train.*: trajectory \w*1: frame 8: particle 3 is at"):
        reopened.window(1, 3, 10)
