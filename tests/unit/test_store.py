"""The HDF5 store: what is written is read, wrong files are told, and no half file has a name."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from adaptgns.data import DataError, Trajectory, open_split
from adaptgns.data.store import StoreWriter, partial_path, read_origin, write_split


def trajectory(frames: int = 10, particles: int = 4) -> Trajectory:
    rng = np.random.default_rng([frames, particles])
    positions = rng.random((frames, particles, 2), dtype=np.float32)
    return Trajectory("", positions, rng.integers(0, 9, particles))


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_round_trip(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    dim = data.draw(st.sampled_from([2, 3]))
    properties = data.draw(st.integers(0, 3))
    written = []
    for _ in range(data.draw(st.integers(1, 3))):
        frames, particles = data.draw(st.integers(7, 9)), data.draw(st.integers(1, 5))
        numbers = st.floats(width=32, allow_nan=False, allow_infinity=False)
        positions = data.draw(hnp.arrays(np.float32, (frames, particles, dim), elements=numbers))
        types = data.draw(hnp.arrays(np.int64, particles, elements=st.integers(0, 8)))
        material = np.ones((particles, properties), np.float32) if properties else None
        written.append(Trajectory("", positions, types, material))
    folder = tmp_path_factory.mktemp("store")
    write_split(folder / "test.h5", written)
    read = open_split(folder, "test")
    assert read.names == tuple(f"{i:05d}" for i in range(len(written)))
    assert read.material_properties == properties
    for one, other in zip(read, written, strict=True):
        np.testing.assert_array_equal(one.positions, other.positions)
        np.testing.assert_array_equal(one.particle_type, other.particle_type)
        assert (one.material_property is None) == (properties == 0)


def test_layout_is_lagrangebench_s(tmp_path: Path) -> None:
    write_split(tmp_path / "train.h5", [trajectory(), trajectory(7)])
    with h5py.File(tmp_path / "train.h5") as file:
        assert list(file) == ["00000", "00001"]
        assert file["00000/position"].dtype == np.float32
        assert file["00000/position"].shape == (10, 4, 2)
        assert file["00000/particle_type"].shape == (4,)


def save(path: Path, **members: Any) -> None:
    """One good trajectory, then one with these members."""
    good = {"position": np.zeros((9, 3, 2), np.float32), "particle_type": np.zeros(3, np.int64)}
    if "material_property" in members:
        good["material_property"] = np.zeros(3)
    with h5py.File(path, "w") as file:
        for name, value in good.items():
            file[f"00000/{name}"] = value
        for name, value in (good | members).items():
            if value is not None:
                file[f"00001/{name}"] = value


def test_padding_is_dropped(tmp_path: Path) -> None:
    positions = np.arange(9 * 3 * 2, dtype=np.float32).reshape(9, 3, 2)
    positions[:, 1] = np.nan
    save(
        tmp_path / "train.h5",
        position=positions,
        particle_type=np.array([0, -1, 2]),
        material_property=np.array([1.0, np.nan, 3.0]),
    )
    split = open_split(tmp_path, "train")
    assert split.particle_counts.tolist() == [3, 2]
    read = split.window(1, 2, 4)
    np.testing.assert_array_equal(read.positions, positions[2:4, [0, 2]])
    assert read.particle_type.tolist() == [0, 2]
    assert read.material_property is not None
    assert read.material_property.tolist() == [[1.0], [3.0]]


def test_double_precision_is_narrowed(tmp_path: Path) -> None:
    save(tmp_path / "train.h5", position=np.full((9, 3, 2), 0.1))
    assert open_split(tmp_path, "train")[1].positions[0, 0, 0] == np.float32(0.1)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"position": None}, r"no position; the group holds \['particle_type'\]"),
        ({"particle_type": None}, "no particle_type"),
        ({"position": np.zeros((9, 3))}, r"position has shape \[9, 3\]"),
        ({"position": np.zeros((9, 3, 2), int)}, "dtype int64"),
        ({"position": np.zeros((9, 3, 5))}, "5 dimensions; 2 or 3"),
        ({"position": np.zeros((9, 3, 3))}, "3 dimensions, those of trajectory 00000 have 2"),
        ({"position": np.zeros((6, 3, 2))}, "6 frames; at least 7"),
        ({"particle_type": np.zeros(4, int)}, r"shape \[4\], positions have 3 particles"),
        ({"particle_type": np.zeros(3)}, "particle_type is of dtype float64"),
        ({"particle_type": np.array([0, 9, 0])}, r"types \[9\]; 0 to 8"),
        ({"particle_type": np.full(3, -1)}, "no particles"),
        ({"material_property": np.zeros(2)}, r"material_property has shape \[2, 1\]"),
        ({"material_property": b"steel"}, "material_property is of dtype"),
    ],
)
def test_wrong_trajectories_are_named(
    tmp_path: Path, members: dict[str, Any], message: str
) -> None:
    save(tmp_path / "train.h5", **members)
    with pytest.raises(DataError, match=rf"train\.h5: trajectory 00001: .*{message}"):
        open_split(tmp_path, "train")


def test_wrong_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "train.h5").write_bytes(b"not HDF5 at all")
    with pytest.raises(DataError, match=r"train\.h5: damaged, truncated or not HDF5"):
        open_split(tmp_path, "train")
    with h5py.File(tmp_path / "train.h5", "w"):
        pass
    with pytest.raises(DataError, match=r"train\.h5: holds no trajectory"):
        open_split(tmp_path, "train")
    with h5py.File(tmp_path / "train.h5", "w") as file:
        file["positions"] = np.zeros(3)
    with pytest.raises(DataError, match=r"trajectory positions: a data set; a group"):
        open_split(tmp_path, "train")


@pytest.mark.parametrize("compression", [None, "gzip"])
def test_truncated_files(tmp_path: Path, compression: str | None) -> None:
    path = tmp_path / "train.h5"
    with h5py.File(path, "w") as file:
        for group in ("00000", "00001"):
            positions = np.random.default_rng(0).random((40, 30, 2), dtype=np.float32)
            file.create_dataset(f"{group}/position", data=positions, compression=compression)
            file[f"{group}/particle_type"] = np.zeros(30, int)
    content = path.read_bytes()
    for cut in np.linspace(0, len(content) - 1, 25).astype(int):
        path.write_bytes(content[:cut])
        with pytest.raises(DataError, match=r"train\.h5"):
            list(open_split(tmp_path, "train"))


def test_damaged_bytes_are_told(tmp_path: Path) -> None:
    path = tmp_path / "train.h5"
    with h5py.File(path, "w") as file:
        positions = np.random.default_rng(0).random((12, 9, 2), dtype=np.float32)
        file.create_dataset("00000/position", data=positions, compression="gzip", chunks=(5, 9, 2))
        file["00000/particle_type"] = np.zeros(9, int)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    told = set()
    for _ in range(300):
        damaged = bytearray(content)
        damaged[rng.integers(len(content))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:  # the file has bytes that mean nothing
            list(open_split(tmp_path, "train"))
        except DataError as error:
            told.add(str(error))
    assert len(told) > 10
    assert all(message.startswith(f"{path}: ") for message in told)
    assert any("position: the chunk at [5, 0, 0], bytes" in message for message in told)


def test_truncation_after_opening(tmp_path: Path) -> None:
    write_split(tmp_path / "train.h5", [trajectory(100)])
    split = open_split(tmp_path, "train")
    split.window(0, 90, 100)
    with (tmp_path / "train.h5").open("r+b") as file:
        file.truncate(file.seek(0, os.SEEK_END) // 2)
    with pytest.raises(
        DataError, match=r"train\.h5: trajectory 00000: frame 9\d: .*at byte \d+; it is trunc"
    ):
        split.window(0, 90, 100)


def nan(one: Trajectory) -> None:
    one.positions[3, 1] = np.nan


def negative(one: Trajectory) -> None:
    one.particle_type[0] = -1


@pytest.mark.parametrize(
    ("spoil", "message"), [(nan, "frame 3: particle 1"), (negative, r"types \[-1\]")]
)
def test_nothing_unreadable_is_written(
    tmp_path: Path, spoil: Callable[[Trajectory], None], message: str
) -> None:
    bad = trajectory()
    spoil(bad)
    with pytest.raises(DataError, match=rf"test\.h5: trajectory 00001: .*{message}"):
        write_split(tmp_path / "test.h5", [trajectory(), bad])
    with pytest.raises(DataError, match="trajectory 00000: 3 frames"):
        write_split(tmp_path / "test.h5", [trajectory(3)])
    frame = replace(trajectory(), positions=trajectory().positions[0])
    with pytest.raises(DataError, match=r"positions have the shape \[\d+, 2\]; \[T, N, d\]"):
        write_split(tmp_path / "test.h5", [frame])
    assert list(tmp_path.iterdir()) == []


def test_an_exception_leaves_the_earlier_file(tmp_path: Path) -> None:
    write_split(tmp_path / "test.h5", [trajectory()])
    before = (tmp_path / "test.h5").read_bytes()

    def interrupted() -> Iterator[Trajectory]:
        yield trajectory(50)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_split(tmp_path / "test.h5", interrupted())
    assert [path.name for path in tmp_path.iterdir()] == ["test.h5"]
    assert (tmp_path / "test.h5").read_bytes() == before


def test_a_killed_writer_leaves_no_readable_name(tmp_path: Path) -> None:
    program = (
        "import os, signal, sys; from pathlib import Path; import numpy as np\n"
        "from adaptgns.data.store import StoreWriter\n"
        "from adaptgns.data.trajectories import Trajectory\n"
        "writer = StoreWriter(Path(sys.argv[1]))\n"
        "writer.append(Trajectory('', np.zeros((9, 9, 2), np.float32), np.zeros(9, int)))\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    path = tmp_path / "test.h5"
    ended = subprocess.run([sys.executable, "-c", program, str(path)], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert [entry.name for entry in tmp_path.iterdir()] == ["test.h5.partial"]
    write_split(path, [trajectory()])
    assert [entry.name for entry in tmp_path.iterdir()] == ["test.h5"]


def test_two_processes_writing_one_file(tmp_path: Path) -> None:
    path = tmp_path / "test.h5"
    program = (
        "import sys; from pathlib import Path; from adaptgns.data.store import StoreWriter\n"
        "StoreWriter(Path(sys.argv[1]))\n"
    )
    with StoreWriter(path) as writer:
        writer.append(trajectory())
        other = subprocess.run(
            [sys.executable, "-c", program, str(path)], check=False, capture_output=True, text=True
        )
        assert "test.h5.partial: another process is writing it" in other.stderr
    np.testing.assert_array_equal(open_split(tmp_path, "test")[0].positions, trajectory().positions)


def write_with_little_room(path: Path, room: int) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
    try:
        write_split(path, (trajectory(100, 100) for _ in range(5)))
    except OSError:
        return
    raise AssertionError("all of it was written")


@pytest.mark.parametrize("room", [0, 1000, 100_000, 400_000])
def test_a_full_disk_leaves_nothing(tmp_path: Path, room: int) -> None:
    process = multiprocessing.get_context("spawn").Process(
        target=write_with_little_room, args=(tmp_path / "test.h5", room)
    )
    process.start()
    process.join()
    assert process.exitcode == 0
    assert list(tmp_path.iterdir()) == []


def test_origin(tmp_path: Path) -> None:
    path = tmp_path / "test.h5"
    with StoreWriter(path, origin="here") as writer:
        writer.append(trajectory())
    assert read_origin(path) == "here"
    write_split(path, [trajectory()])
    assert read_origin(path) is None
    path.write_bytes(b"")
    assert read_origin(path) is None
    assert read_origin(partial_path(path)) is None
