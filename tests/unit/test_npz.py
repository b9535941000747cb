"""GNS npz files in all their variants, damaged ones, and ones that would run code."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptgns.data import DataError, open_split
from adaptgns.data import npz as npz_module
from adaptgns.data.trajectories import Trajectories

Record = tuple[Any, ...]


def record(frames: int = 8, particles: int = 3, *, material: bool = False) -> Record:
    rng = np.random.default_rng(frames * 1000 + particles)
    positions = rng.random((frames, particles, 2), dtype=np.float32)
    types = rng.integers(0, 9, particles)
    return (positions, types, rng.random(particles)) if material else (positions, types)


def objects(values: Record) -> np.ndarray:
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array


def per_trajectory(path: Path, records: list[Record]) -> None:
    members = {f"simulation_trajectory_{i}": objects(r) for i, r in enumerate(records)}
    np.savez_compressed(path, **members)


def uncompressed(path: Path, records: list[Record]) -> None:
    np.savez(path, **{f"simulation_trajectory_{i}": objects(r) for i, r in enumerate(records)})


def tuples(path: Path, records: list[Record]) -> None:
    bundle = np.empty(len(records), dtype=object)
    for index, one in enumerate(records):
        bundle[index] = one
    np.savez_compressed(path, gns_data=bundle)


def rows(path: Path, records: list[Record]) -> None:
    np.savez_compressed(path, gns_data=np.stack([objects(one) for one in records]))


def scalar_tuple(path: Path, records: list[Record]) -> None:
    members = {}
    for index, one in enumerate(records):
        members[f"t{index}"] = np.empty((), dtype=object)
        members[f"t{index}"][()] = one
    np.savez(path, **members)


def pickled(protocol: int) -> Callable[[Path, list[Record]], None]:
    """As older numpys (protocols 2 and 3) and plain pickle (5) write the arrays."""

    def write(path: Path, records: list[Record]) -> None:
        with zipfile.ZipFile(path, "w") as archive:
            for index, one in enumerate(records):
                write_member(archive, f"t{index}.npy", pickle.dumps(objects(one), protocol))

    return write


def write_member(archive: zipfile.ZipFile, name: str, payload: bytes) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "|O", "fortran_order": False, "shape": (2,)}
    )
    archive.writestr(name, header.getvalue() + payload)


WRITERS = {
    "per trajectory": per_trajectory,
    "uncompressed": uncompressed,
    "tuples": tuples,
    "rows": rows,
    "scalar tuple": scalar_tuple,
} | {f"protocol {p}": pickled(p) for p in range(6)}


def opened(folder: Path, *records: Record, write: str = "per trajectory") -> Trajectories:
    WRITERS[write](folder / "train.npz", list(records))
    return open_split(folder, "train")


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("material", [False, True])
def test_all_variants_read_the_same(tmp_path: Path, write: str, material: bool) -> None:
    records = [record(8, 3, material=material), record(300, 70, material=material)]
    split = opened(tmp_path, *records, write=write)
    assert split.lengths.tolist() == [8, 300]
    assert split.particle_counts.tolist() == [3, 70]
    assert split.material_properties == int(material)
    for trajectory, (positions, types, *rest) in zip(split, records, strict=True):
        assert trajectory.positions.dtype == np.float32
        assert trajectory.particle_type.dtype == np.int64
        np.testing.assert_array_equal(trajectory.positions, positions)
        np.testing.assert_array_equal(trajectory.particle_type, types)
        if material:
            assert trajectory.material_property is not None
            assert trajectory.material_property.shape == (len(types), 1)
            np.testing.assert_allclose(trajectory.material_property[:, 0], rest[0], rtol=1e-6)
    np.testing.assert_array_equal(split.window(1, 5, 12).positions, records[1][0][5:12])


@pytest.mark.parametrize("types", [6, np.int64(6), np.array(6, dtype=np.int32)])
def test_one_type_for_all_particles(tmp_path: Path, types: Any) -> None:
    split = opened(tmp_path, (record()[0], types))
    assert split[0].particle_type.tolist() == [6, 6, 6]


@pytest.mark.parametrize(
    "convert",
    [
        lambda p: p.astype(np.float64),
        lambda p: p.astype(">f4"),
        np.asfortranarray,
        lambda p: p[:, ::-1],
    ],
    ids=["float64", "big endian", "Fortran order", "strided"],
)
def test_any_layout_of_positions(
    tmp_path: Path, convert: Callable[[np.ndarray], np.ndarray]
) -> None:
    positions, types = record()
    np.testing.assert_array_equal(
        opened(tmp_path, (convert(positions), types))[0].positions, convert(positions)
    )


def test_opening_reads_no_positions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    WRITERS["per trajectory"](tmp_path / "train.npz", [record(), record(9)])

    def refuse(stream: object) -> None:
        raise AssertionError("read")

    monkeypatch.setattr(npz_module.restricted_pickle, "load", refuse)
    assert open_split(tmp_path, "train").lengths.tolist() == [8, 9]


def test_names_keep_the_order_of_the_file(tmp_path: Path) -> None:
    split = opened(tmp_path, *(record(7 + i) for i in range(11)))
    assert split.names == tuple(f"simulation_trajectory_{i}" for i in range(11))
    assert split.lengths.tolist() == list(range(7, 18))


def test_returned_arrays_belong_to_the_caller(tmp_path: Path) -> None:
    split = opened(tmp_path, record())
    split[0].positions[:] = 0
    np.testing.assert_array_equal(split[0].positions, record()[0])


class RunsCode:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("write", [w for w in WRITERS if w != "protocol 0"])
def test_pickles_that_would_run_code_are_refused(tmp_path: Path, write: str) -> None:
    evil = (record()[0], RunsCode(tmp_path / "ran"))
    with pytest.raises(DataError, match=r"train\.npz: .*npy: refused.*global (posix|nt)\.mkdir"):
        opened(tmp_path, evil, evil, write=write)[0]
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.ma.masked_array([1, 2]), r"numpy\.ma"),
        (np.array(["a"]), "dtype 'U1'"),
        (np.array(["2020"], dtype="M8[D]"), "dtype 'M8'"),
        ("text", "type str"),
        ({"types": 3}, "type dict"),
        (np.memmap, "numpy.memmap"),
    ],
)
def test_other_values_are_refused(tmp_path: Path, value: Any, message: str) -> None:
    with pytest.raises(DataError, match=rf"train\.npz: .*refused.*{message}"):
        opened(tmp_path, (record()[0], value))[0]


def test_object_arrays_cannot_be_forged_from_bytes(tmp_path: Path) -> None:
    """numpy's own reader would take these bytes for pointers, if the dtype's flags said so."""

    class Forged:
        def __reduce__(self) -> tuple[Any, ...]:
            reconstruct, arguments, _ = np.empty(1, dtype=object).__reduce__()
            return reconstruct, arguments, (1, (1,), np.dtype("O"), False, b"\x01" * 8)

    with pytest.raises(DataError, match=r"refused.*list doesn't fit"):
        opened(tmp_path, (record()[0], Forged()))[0]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((record()[0],), "1 entries"),
        ((*record(), 1.0, 2.0), "4 entries"),
        ((record()[0][0], record()[1]), r"positions have shape \[3, 2\]"),
        ((record()[0].astype(int), record()[1]), "dtype int64"),
        ((record()[0], record()[1][:2]), r"particle_type has shape \[2\].*3 particles"),
        ((record()[0], record()[1] + 0.5), "particle_type is of dtype float64"),
        ((record()[0], np.array([0, 9, 1])), r"particle types \[9\]; 0 to 8"),
        ((record()[0], np.array([0, -1, 1])), r"particle types \[-1\]"),
        ((*record(), np.ones(2)), r"material_property has shape \[2"),
        ((*record(), np.array([True] * 3)), "material_property is of dtype bool"),
        ((record(6)[0], 5), "6 frames; at least 7"),
        ((np.zeros((8, 3, 4), np.float32), 5), "4 dimensions"),
        ((np.zeros((8, 0, 2), np.float32), 5), "no particles"),
    ],
)
def test_wrong_trajectories_are_named(tmp_path: Path, values: Record, message: str) -> None:
    with pytest.raises(DataError, match=rf"train\.npz.*simulation_trajectory_1.*{message}"):
        list(opened(tmp_path, record(), values))


def test_not_finite_frames_are_named(tmp_path: Path) -> None:
    positions, types = record()
    positions[5, 1, 0] = np.nan
    split = opened(tmp_path, (positions, types))
    split.window(0, 0, 5)
    with pytest.raises(DataError, match=r"train\.npz: trajectory \S+_0: frame 5: particle 1"):
        split.window(0, 4, 8)


def test_dimensions_that_differ(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"3 dimensions, those of .*_0 have 2"):
        opened(tmp_path, record(), (np.zeros((8, 3, 3), np.float32), 5))


def test_material_properties_that_differ(tmp_path: Path) -> None:
    split = opened(tmp_path, record(material=True), record())
    with pytest.raises(DataError, match=r"_1: 0 material properties, .*_0 has 1"):
        split[1]


def test_a_numeric_member_is_no_trajectory(tmp_path: Path) -> None:
    np.savez(tmp_path / "train.npz", positions=np.zeros((8, 3, 2)))
    with pytest.raises(DataError, match=r"positions\.npy: an array of dtype float64"):
        open_split(tmp_path, "train")


@pytest.mark.parametrize("write", ["per trajectory", "uncompressed", "tuples"])
def test_truncated_and_damaged_files(tmp_path: Path, write: str) -> None:
    whole = opened(tmp_path, record(50, 20), record(60, 20), write=write)
    reference = list(whole)
    content = (tmp_path / "train.npz").read_bytes()
    for cut in np.linspace(0, len(content) - 1, 25).astype(int):
        (tmp_path / "train.npz").write_bytes(content[:cut])
        with pytest.raises(DataError, match=r"train\.npz"):
            list(open_split(tmp_path, "train"))
    rng = np.random.default_rng(0)
    for _ in range(60):
        damaged = bytearray(content)
        damaged[rng.integers(len(content))] ^= 1 << rng.integers(8)
        (tmp_path / "train.npz").write_bytes(damaged)
        try:
            read = list(open_split(tmp_path, "train"))
        except DataError:
            continue
        # Some bytes of a zip carry nothing (times, attributes); all that carry data are checked.
        for one, other in zip(read, reference, strict=True):
            np.testing.assert_array_equal(one.positions, other.positions)
            np.testing.assert_array_equal(one.particle_type, other.particle_type)


def test_a_file_replaced_after_opening(tmp_path: Path) -> None:
    split = opened(tmp_path, record(9))
    per_trajectory(tmp_path / "train.npz", [record(8)])
    with pytest.raises(DataError, match=r"train\.npz: .*changed since the file was opened"):
        split.window(0, 0, 7)


def test_empty_archive(tmp_path: Path) -> None:
    np.savez(tmp_path / "train.npz")
    with pytest.raises(DataError, match=r"train\.npz: .*no trajectory"):
        open_split(tmp_path, "train")
