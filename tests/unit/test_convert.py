"""Conversions: exact, whole or not at all, and damage told by name, byte and remedy."""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import google_crc32c
import h5py
import numpy as np
import pytest
import torch

from adaptgns import convert
from adaptgns.checkpoint import Checkpoint, build_simulator, with_prefix, write_checkpoint
from adaptgns.config import ModelConfig, TrainConfig
from adaptgns.convert import main
from adaptgns.data import DataError, Metadata, Trajectory, open_split, read_metadata
from adaptgns.data.dataset import write_dataset
from adaptgns.data.npz_writer import write_npz
from adaptgns.data.store import write_split
from adaptgns.data.tfrecord import _sequence_example, masked_crc32c
from adaptgns.geoelements import _difference

METADATA = {
    "dim": 2,
    "dt": 0.01,
    "bounds": [[0, 1], [0, 1]],
    "default_connectivity_radius": 0.1,
    "a key of theirs": "kept",
}


def trajectories(dim: int = 2, properties: int = 0) -> list[Trajectory]:
    rng = np.random.default_rng(dim)
    return [
        Trajectory(
            "",
            rng.random((frames, particles, dim), dtype=np.float32),
            rng.integers(0, 9, particles),
            rng.random((particles, properties), dtype=np.float32) if properties else None,
        )
        for frames, particles in ((9, 4), (12, 7))
    ]


def assert_same(folder: Path, split: str, expected: Sequence[Trajectory]) -> None:
    read = list(open_split(folder, split))
    assert len(read) == len(expected)
    for one, other in zip(read, expected, strict=True):
        assert one.positions.tobytes() == other.positions.tobytes()
        np.testing.assert_array_equal(one.particle_type, other.particle_type)
        assert (one.material_property is None) == (other.material_property is None)
        if other.material_property is not None:
            np.testing.assert_array_equal(one.material_property, other.material_property)


def run(*arguments: object) -> None:
    main([str(argument) for argument in arguments])


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What is told when the conversion is refused, after checking that nothing is left."""
    dest = Path(str(arguments[1]))
    with pytest.raises(SystemExit) as exit_:
        run(*arguments)
    assert exit_.value.code == 2
    assert not dest.exists()
    assert not list(dest.parent.glob("*partial*"))
    assert not list(dest.parent.glob(".*partial*"))
    told = capsys.readouterr().err
    assert ".partial" not in told
    return told


# --- TFRecord ----------------------------------------------------------------------------------


def example(one: Trajectory, step_context: np.ndarray | None = None, **changes: Any) -> bytes:
    """The bytes of a SequenceExample, by its published field numbers."""

    def field(number: int, payload: bytes) -> bytes:
        size, varint = len(payload), b""
        while size > 127:
            varint += bytes([size & 127 | 128])
            size >>= 7
        return bytes([number << 3 | 2]) + varint + bytes([size]) + payload

    def strings(*values: bytes) -> bytes:
        return field(1, b"".join(field(1, value) for value in values))

    def entry(key: str, value: bytes) -> bytes:
        return field(1, field(1, key.encode()) + field(2, value))

    context = {
        "key": field(3, field(1, b"\x07")),
        "particle_type": strings(one.particle_type.astype("<i8").tobytes()),
    }
    lists = {"position": [frame.tobytes() for frame in one.positions]}
    if step_context is not None:
        lists["step_context"] = [row.tobytes() for row in step_context]
    context |= changes.get("context", {})
    lists |= changes.get("lists", {})
    frames = {
        key: b"".join(field(1, strings(frame)) for frame in rows) for key, rows in lists.items()
    }
    return field(1, b"".join(entry(k, v) for k, v in context.items() if v)) + field(
        2, b"".join(entry(k, v) for k, v in frames.items() if v)
    )


def record(payload: bytes) -> bytes:
    def checksum(data: bytes) -> bytes:
        crc = google_crc32c.value(data)
        return struct.pack("<I", (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF)

    length = struct.pack("<Q", len(payload))
    return length + checksum(length) + payload + checksum(payload)


def test_checksum_of_the_crc_catalogue() -> None:
    """CRC32C of "123456789" is 0xE3069283."""
    crc = 0xE3069283
    masked = ((crc >> 15 | crc << 17) + 0xA282EAD8) % 2**32
    assert masked_crc32c(b"123456789") == masked


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("to", ["h5", "npz"])
def test_tfrecord(tmp_path: Path, dim: int, to: str) -> None:
    path = tmp_path / "train.tfrecord"
    path.write_bytes(b"".join(record(example(one)) for one in trajectories(dim)))
    run(path, tmp_path / "out" / f"train.{to}")
    assert_same(tmp_path / "out", "train", trajectories(dim))


def test_step_context_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    (source / "metadata.json").write_text(json.dumps(METADATA | {"context_mean": [0.0] * 3}))
    context = np.random.default_rng(0).random((9, 3), dtype=np.float32)
    one = trajectories()[0]
    (source / "train.tfrecord").write_bytes(record(example(one, context)))
    run(source, out)
    assert "step_context is kept, but no model" in capsys.readouterr().out
    with h5py.File(out / "train.h5") as file:
        assert file["00000/step_context"][()].tobytes() == context.tobytes()
    assert_same(out, "train", [one])


def test_damaged_tfrecords_are_told_by_byte(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = (record(example(one)) for one in trajectories())
    path, out = tmp_path / "test.tfrecord", tmp_path / "out.h5"
    whole = first + second
    begin = len(first)

    def told(content: bytes) -> str:
        path.write_bytes(content)
        return refusal(capsys, path, out)

    assert f"record 1 at byte {begin}: the file ends in its header" in told(whole[: begin + 5])
    cut = told(whole[:-3])
    assert f"record 1 at byte {begin}: it goes on to byte {len(whole)}" in cut
    assert f"but the file ends at byte {len(whole) - 3}; copy or download the file again" in cut
    for place, what in ((begin + 2, "its length fails"), (begin + 40, "bytes fail their"),
                        (len(whole) - 1, "bytes fail their")):  # fmt: skip
        flipped = bytearray(whole)
        flipped[place] ^= 1
        message = told(bytes(flipped))
        assert f"test.tfrecord: record 1 at byte {begin}: " in message
        assert what in message
    assert "the file is empty; copy or download" in told(b"")
    assert "no tf.train.SequenceExample" in told(record(b"\xff" * 30))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"context": {"particle_type": b""}}, r"no particle_type; the context holds \['key'\]"),
        ({"lists": {"position": []}}, "no position"),
        ({"lists": {"position": [b"12345678"] * 9}}, "2 numbers per frame in position don't fit 4"),
        ({"lists": {"position": [b"1234567"] * 9}}, "position: entry 0 isn't one string of <f4"),
        ({"lists": {"position": [b"1234", b"12345678"]}}, "entry 1 has 2 numbers, entry 0 has 1"),
        ({"lists": {"step_context": [b"1234"]}}, "step_context has 1 frames, position 9"),
        ({"lists": {"position": [b"12345678" * 4] * 3}}, "3 frames; at least 7"),
        ({"lists": {"position": [b"\xff" * 32] * 9}}, "frame 0: particle 0 is at"),
    ],
)
def test_wrong_examples_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any], message: str
) -> None:
    path = tmp_path / "test.tfrecord"
    path.write_bytes(record(example(trajectories()[0], **changes)))
    told = refusal(capsys, path, tmp_path / "out.h5")
    assert re.search(rf"test\.tfrecord: record 0 at byte 0: .*{message}", told), told


def test_mixed_dimensions_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "test.tfrecord"
    path.write_bytes(b"".join(record(example(trajectories(dim)[0])) for dim in (2, 3)))
    told = refusal(capsys, path, tmp_path / "out.h5")
    assert "positions have 3 dimensions, those of record 0 have 2" in told


def test_messages_are_tensorflow_s() -> None:
    """What is read keeps no unknown field of ours."""
    message = _sequence_example().FromString(example(trajectories()[0]))
    assert [entry.key for entry in message.context.feature] == ["key", "particle_type"]
    assert message.context.feature[0].value.int64_list.value[:] == [7]


# --- npz and HDF5 ------------------------------------------------------------------------------


@pytest.mark.parametrize("properties", [0, 1])
def test_round_trip_of_a_data_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], properties: int
) -> None:
    source = tmp_path / "source"
    source.mkdir()
    (source / "metadata.json").write_text(json.dumps(METADATA))
    for split in ("train", "val"):
        write_npz(source / f"{split}.npz", trajectories(properties=properties))
    before = sorted((path.name, path.read_bytes()) for path in source.iterdir())
    run(source, tmp_path / "h5")
    assert "LagrangeBench takes all trajectories" in capsys.readouterr().out
    run(tmp_path / "h5", tmp_path / "npz", "--to", "npz")
    for folder in ("h5", "npz"):
        for split in ("train", "valid"):
            assert_same(tmp_path / folder, split, trajectories(properties=properties))
        assert read_metadata(tmp_path / folder) == read_metadata(tmp_path / "h5")
        content = json.loads((tmp_path / folder / "metadata.json").read_text())
        assert content["a key of theirs"] == "kept"
        assert len(content["vel_std"]) == 2
    assert before == sorted((path.name, path.read_bytes()) for path in source.iterdir())
    # What LagrangeBench reads of the metadata, and geoelements/gns of the other.
    lagrangebench = json.loads((tmp_path / "h5" / "metadata.json").read_text())
    assert lagrangebench["num_particles_max"] == 7
    assert lagrangebench["periodic_boundary_conditions"] == [False, False]
    assert content["sequence_length"] is None
    assert content.get("nnode_in") == (31 if properties else None)
    # As its loader does.
    with np.load(tmp_path / "npz" / "train.npz", allow_pickle=True) as file:
        for row, one in zip([item for _, item in file.items()], trajectories(), strict=True):
            positions, types, *material = row
            assert positions.shape == one.positions.shape
            np.full(len(types), types, dtype=int)
            assert all(np.full(len(types), m, dtype=float).ndim == 1 for m in material)
            assert len(material) == properties


def test_sections_of_metadata(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    sections = {"train": METADATA, "rollout": METADATA | {"sequence_length": 99}}
    (source / "metadata.json").write_text(json.dumps(sections))
    write_npz(source / "train.npz", trajectories()[:1])
    run(source, tmp_path / "npz", "--to", "npz")
    content = json.loads((tmp_path / "npz" / "metadata.json").read_text())
    assert content["sequence_length"] == 9
    assert content["rollout"]["sequence_length"] == 99


def test_notes_on_lagrangebench_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_dataset(tmp_path / "in", {"train": trajectories()}, dt=1.0, bounds=[(0, 1)] * 2,
                  radius=0.1, periodic=[True, False], kinematic_types=[1, 2])  # fmt: skip
    run(tmp_path / "in", tmp_path / "out", "--to", "npz")
    told = capsys.readouterr().out
    assert "types [1, 2] are kinematic here; geoelements/gns holds only those of type 3" in told
    assert "the data is periodic, which geoelements/gns doesn't know" in told


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.h5"
    good = tmp_path / "good.h5"
    write_split(good, trajectories())
    assert "no/such: there is no such file or folder" in refusal(capsys, "no/such", out)
    (tmp_path / "a.csv").write_text("1,2")
    assert "a.csv: .h5, .npz, .tfrecord, .pt, .safetensors files" in refusal(
        capsys, tmp_path / "a.csv", out
    )
    assert "can become a file that ends in .h5 or .npz" in refusal(capsys, good, tmp_path / "o.pt")
    assert "to is npz, but" in refusal(capsys, good, out, "--to", "npz")
    write_split(tmp_path / "two.h5", trajectories(properties=2))
    told = refusal(capsys, tmp_path / "two.h5", tmp_path / "out.npz")
    assert "2 material properties; geoelements/gns, whose format this is, takes at most 1" in told
    (tmp_path / "set").mkdir()
    write_split(tmp_path / "set" / "train.h5", trajectories())
    told = refusal(capsys, tmp_path / "set", out)
    assert "can become a folder; got the name of a file" in told
    (tmp_path / "empty").mkdir()
    assert "the folder is empty" in refusal(capsys, tmp_path / "empty", tmp_path / "o")
    with pytest.raises(SystemExit):
        run(good, tmp_path / "two.h5")
    assert "two.h5: exists; choose another name or remove it" in capsys.readouterr().err
    chunked = tmp_path / "chunked.h5"
    with h5py.File(good) as file, h5py.File(chunked, "w") as copy:
        for group, members in file.items():
            positions = members["position"][()]
            copy.create_dataset(
                f"{group}/position",
                data=positions,
                chunks=(3, *positions.shape[1:]),
                fletcher32=True,
            )
            copy[f"{group}/particle_type"] = members["particle_type"][()]
        at = copy["00001/position"].id.get_chunk_info(2).byte_offset
        size = copy["00001/position"].id.get_chunk_info(2).size
    content = bytearray(chunked.read_bytes())
    content[at] ^= 1
    chunked.write_bytes(content)
    told = refusal(capsys, chunked, out)
    assert f"chunked.h5: trajectory 00001: position: the chunk at [6, 0, 0], bytes {at} to " in told
    assert f"to {at + size}, can't be read: " in told
    assert told.endswith("; copy or download the file again\n")
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(good.read_bytes()[:-200])
    assert "damaged.h5" in refusal(capsys, damaged, out)


def test_sigterm_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "source"
    source.mkdir()
    write_split(source / "train.h5", trajectories())
    kept = {path.name for path in tmp_path.iterdir()}

    def stopped(path: Path, given: Iterable[Trajectory]) -> None:
        def until_the_second() -> Iterator[Trajectory]:
            yield next(iter(given))
            assert list(tmp_path.glob(".out*.partial/*"))  # something is half done
            os.kill(os.getpid(), signal.SIGTERM)
            signal.pause()

        write_split(path, until_the_second())

    monkeypatch.setattr(convert, "write_split", stopped)
    with pytest.raises(SystemExit) as exit_:
        run(source, tmp_path / "out")
    assert exit_.value.code == 143
    assert capsys.readouterr().err.splitlines()[-1] == "terminated"
    assert {path.name for path in tmp_path.iterdir()} == kept


def test_a_damaged_split_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "source"
    source.mkdir()
    write_split(source / "train.h5", trajectories())
    run(source, tmp_path / "bare")
    assert "write" in capsys.readouterr().out
    for content, message in (
        ("{", "not readable as JSON"),
        ("[]", "holds a list; an object"),
        (json.dumps({**METADATA, "dim": 3}), "metadata.json"),
        (json.dumps({"dim": 2}), f"{source}/metadata.json: "),
    ):
        (source / "metadata.json").write_text(content)
        assert message in refusal(capsys, source, tmp_path / "out")
    (source / "metadata.json").write_text(json.dumps(METADATA))
    assert "to is pt; h5 and npz are accepted" in refusal(
        capsys, source, tmp_path / "o", "--to", "pt"
    )
    write_npz(source / "valid.npz", trajectories())
    whole = (source / "valid.npz").read_bytes()
    (source / "valid.npz").write_bytes(whole[: len(whole) // 2])
    told = refusal(capsys, source, tmp_path / "out")
    assert f"valid.npz: not a readable npz (zip) file of {len(whole) // 2} bytes" in told
    assert "copy or download it again" in told
    broken = bytearray(whole)
    broken[400] ^= 1
    (source / "valid.npz").write_bytes(broken)
    told = refusal(capsys, source, tmp_path / "out")
    assert "simulation_trajectory_0.npy (at byte 0): damaged or truncated" in told


# --- frames ------------------------------------------------------------------------------------


def write_frames(folder: Path, one: Trajectory, suffix: str, shuffled: bool = False) -> None:
    meshio = pytest.importorskip("meshio")
    folder.mkdir(parents=True)
    rng = np.random.default_rng(1)
    for frame, positions in enumerate(one.positions):
        order = rng.permutation(len(positions)) if shuffled else np.arange(len(positions))
        points = np.pad(positions.astype(np.float64), ((0, 0), (0, 3 - positions.shape[1])))
        data = {"particle_type": one.particle_type[order], "Idp": order.astype(np.int64)}
        if one.material_property is not None:
            data["material_property"] = one.material_property[order, 0].astype(np.float64)
        cells = [] if suffix == "ply" else [("vertex", np.arange(len(points))[:, None])]
        meshio.Mesh(points[order], cells, point_data=data).write(folder / f"f_{frame}.{suffix}")


@pytest.mark.parametrize("suffix", ["vtk", "vtu", "ply"])
@pytest.mark.parametrize("dim", [2, 3])
def test_frames(tmp_path: Path, suffix: str, dim: int) -> None:
    """12 frames, so that f_10 comes after f_9, and particles in another order each time."""
    one = trajectories(dim, properties=1)[1]
    write_frames(tmp_path / "frames", one, suffix, shuffled=True)
    run(tmp_path / "frames", tmp_path / "train.h5")
    assert_same(tmp_path, "train", [one])


def test_a_data_set_of_frames(tmp_path: Path) -> None:
    source = tmp_path / "source"
    for split, names in (("train", ("a", "b")), ("test", ("a",))):
        for name in names:
            write_frames(source / split / name, trajectories()[name == "b"], "vtu")
    (source / "metadata.json").write_text(json.dumps(METADATA))
    run(source, tmp_path / "out")
    assert_same(tmp_path / "out", "train", trajectories())
    assert_same(tmp_path / "out", "test", trajectories()[:1])
    assert read_metadata(tmp_path / "out").dim == 2
    run(source / "train", tmp_path / "train.npz")
    assert_same(tmp_path, "train", trajectories())


def test_wrong_frames_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    meshio = pytest.importorskip("meshio")
    folder, out = tmp_path / "frames", tmp_path / "out.h5"
    one = trajectories()[0]
    write_frames(folder, one, "ply")
    path = folder / "f_4.ply"
    whole = path.read_bytes()

    def told(points: np.ndarray, **data: np.ndarray) -> str:
        same = {"particle_type": one.particle_type, "Idp": np.arange(4)}
        meshio.Mesh(points, [], point_data=same | data).write(path)
        return refusal(capsys, folder, out)

    assert "f_4.ply: 5 particles, f_0.ply has 4" in told(
        np.zeros((5, 3)), particle_type=np.zeros(5), Idp=np.arange(5)
    )
    assert "f_4.ply: other particle ids than f_0.ply" in told(np.zeros((4, 3)), Idp=np.arange(1, 5))
    assert "f_4.ply: other particle types than f_0.ply" in told(
        np.zeros((4, 3)), particle_type=one.particle_type + 1
    )
    assert "f_4.ply: z isn't 0, but the data have two dimensions" in told(np.ones((4, 3)))
    assert "frame 4: particle 0 is at [nan, 0.0]" in told(
        np.array([[np.nan, 0, 0]] + [[0.0] * 3] * 3)
    )
    path.write_bytes(whole[:20])
    assert "f_4.ply: no PLY header in its 20 bytes; write or copy it again" in refusal(
        capsys, folder, out
    )
    path.write_bytes(whole[:-3])
    assert f"f_4.ply: damaged, cut off at byte {len(whole) - 3}, or" in refusal(capsys, folder, out)
    meshio.Mesh(np.zeros((0, 3)), []).write(path)
    assert "f_4.ply" in refusal(capsys, folder, out)
    path.write_bytes(whole)
    run(folder, tmp_path / "solid.h5", "--dim", "3")
    assert open_split_dim(tmp_path / "solid.h5") == 3
    run(folder, tmp_path / "flat.h5", "--dim", "2")
    assert open_split_dim(tmp_path / "flat.h5") == 2
    (folder / "f_04.ply").write_bytes(whole)
    assert "the same frame number as" in refusal(capsys, folder, out)
    (folder / "f_04.ply").rename(folder / "last.ply")
    assert "last.ply: no number in its name" in refusal(capsys, folder, out)
    (folder / "last.ply").rename(folder / "f_99.vtk")
    assert "frames in .ply, .vtk; one format is accepted" in refusal(capsys, folder, out)
    (folder / "f_99.vtk").unlink()
    path.unlink()
    assert "frame 5 follows frame 3, elsewhere they are 1 apart" in refusal(capsys, folder, out)
    (tmp_path / "set" / "train").mkdir(parents=True)
    assert "no .vtk, .vtu, .ply files, nor folders" in refusal(
        capsys, tmp_path / "set", tmp_path / "o"
    )


def open_split_dim(path: Path) -> int:
    with h5py.File(path) as file:
        return int(file["00000/position"].shape[2])


def test_without_meshio(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "0.vtu").touch()
    monkeypatch.setitem(sys.modules, "meshio", None)
    told = refusal(capsys, tmp_path / "frames", tmp_path / "out.h5")
    assert "0.vtu: reading it needs meshio; pip install 'adaptgns[formats]'" in told


# --- checkpoints -------------------------------------------------------------------------------


def write_model(path: Path, metadata: Metadata, loss: str = "mse", **model: Any) -> None:
    sizes = {"latent": 8, "hidden_layers": 1, "steps": 2}
    config = TrainConfig(model=ModelConfig(**(sizes | model)), loss=loss)  # type: ignore[arg-type]
    tensors = with_prefix("model", build_simulator(config, metadata).state_dict())
    write_checkpoint(path, Checkpoint(config, metadata, 0, 1.0, tensors))


@pytest.mark.parametrize("edge_update", ["fixed", "legacy"])
@pytest.mark.parametrize("properties", [0, 1])
def test_checkpoints_there_and_back(
    metadata: Metadata, tmp_path: Path, capsys: pytest.CaptureFixture[str], edge_update: str,
    properties: int,
) -> None:  # fmt: skip
    metadata = replace(metadata, material_properties=properties)
    write_model(tmp_path / "best.safetensors", metadata, "nll", edge_update=edge_update)
    run(tmp_path, tmp_path / "model-5.pt")
    told = capsys.readouterr().out
    assert "the variance head is left out" in told
    assert ("before pull request 94" in told) == (edge_update == "legacy")
    assert "its train.py builds latent 128, 2 layers and 10 steps; build 8, 1 and 2" in told
    (tmp_path / "metadata.json").write_text(
        json.dumps(METADATA | {"vel_mean": [0, 0], "vel_std": [1, 1], "acc_mean": [0, 0],
                               "acc_std": [1, 1]})
    )  # fmt: skip
    run(tmp_path / "model-5.pt", tmp_path / "m.safetensors", "--edge-update", edge_update)
    run(tmp_path / "m.safetensors", tmp_path / "again.pt")
    one, other = (
        torch.load(tmp_path / name, weights_only=True) for name in ("model-5.pt", "again.pt")
    )
    assert list(one) == list(other)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_checkpoint_refusals(
    metadata: Metadata, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_model(tmp_path / "a.safetensors", metadata)
    run(tmp_path / "a.safetensors", tmp_path / "model-1.pt")
    out = tmp_path / "out.safetensors"
    told = refusal(capsys, tmp_path / "model-1.pt", out)
    assert "say --edge-update legacy if it was trained before its pull request 94" in told
    told = refusal(capsys, tmp_path / "model-1.pt", out, "--edge-update", "fixed")
    assert "metadata.json: there is no such file" in told
    (tmp_path / "metadata.json").write_text(
        json.dumps(METADATA | {"boundary_augment": 2.0, "vel_mean": [0, 0], "vel_std": [1, 1],
                               "acc_mean": [0, 0], "acc_std": [1, 1]})
    )  # fmt: skip
    told = refusal(capsys, tmp_path / "model-1.pt", out, "--edge-update", "fixed")
    assert "says boundary_augment 2.0; 1 is accepted" in told
    for name, value in (("edges", False), ("self_edges", False), ("relative_motion", True),
                        ("walls", True)):  # fmt: skip
        write_model(tmp_path / f"{name}.safetensors", metadata, **{name: value})
        told = refusal(capsys, tmp_path / f"{name}.safetensors", tmp_path / "no.pt")
        assert f"geoelements/gns has no such model: model.{name} is {value}; " in told


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"periodic": (True, False)}, r"periodic is \[True, False\]"),
        ({"kinematic_types": (1, 2)}, r"kinematic_types are \[1, 2\]; only 3"),
        ({"material_properties": 2}, "material_properties is 2; 0 and 1"),
    ],
)
def test_data_that_geoelements_does_not_know(
    metadata: Metadata, change: dict[str, Any], message: str
) -> None:
    config = TrainConfig(model=ModelConfig(latent=8, steps=1), loss="mse")
    told = _difference(build_simulator(config, replace(metadata, **change)))
    assert told is not None
    assert re.search(message, told)


# --- writing one's own -------------------------------------------------------------------------


def test_write_dataset_refuses(tmp_path: Path) -> None:
    fine: dict[str, Any] = {"dt": 1.0, "bounds": [(0, 1)] * 2, "radius": 0.1}
    for splits, message in (({"test": []}, "splits are test; train is needed"),
                            ({"train": [], "dev": []}, "only train, valid, test are accepted"),
                            ({"train": []}, "holds no trajectory")):  # fmt: skip
        with pytest.raises(DataError, match=message):
            write_dataset(tmp_path / "out", splits, **fine)
    with pytest.raises(DataError, match=r"out/metadata\.json: dt is -1"):
        write_dataset(tmp_path / "out", {"train": trajectories()}, **(fine | {"dt": -1}))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out").mkdir()
    metadata = write_dataset(tmp_path / "out", {"train": trajectories()}, **fine)
    assert metadata == read_metadata(tmp_path / "out")
    with pytest.raises(DataError, match="out: exists; choose another name"):
        write_dataset(tmp_path / "out", {"train": trajectories()}, **fine)


def test_write_dataset_takes_numbers_of_numpy(tmp_path: Path) -> None:
    metadata = write_dataset(
        tmp_path / "out",
        {"train": trajectories()},
        dt=np.float32(0.5),  # type: ignore[arg-type]
        bounds=np.array([[0.0, 1.0]] * 2),  # type: ignore[arg-type]
        radius=np.float32(0.5),  # type: ignore[arg-type]
        periodic=np.array([True, False]),  # type: ignore[arg-type]
        kinematic_types=np.array([3, 4]),  # type: ignore[arg-type]
    )
    assert (metadata.dt, metadata.radius, metadata.periodic) == (0.5, 0.5, (True, False))
    assert metadata.kinematic_types == (3, 4)


def test_splits_have_the_same_material_properties(tmp_path: Path) -> None:
    other = [
        replace(each, material_property=np.ones((each.positions.shape[1], 2), np.float32))
        for each in trajectories()
    ]
    with pytest.raises(DataError, match="material properties: train has 0, test has 2; the same"):
        write_dataset(tmp_path / "out", {"train": trajectories(), "test": other}, dt=1.0,
                      bounds=[(0, 1)] * 2, radius=0.1)  # fmt: skip
    assert list(tmp_path.iterdir()) == []
