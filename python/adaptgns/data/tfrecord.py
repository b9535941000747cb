"""DeepMind's TFRecord data sets (Sanchez-Gonzalez et al. 2020), read without TensorFlow.

A file is a row of records: length (uint64), its checksum, the bytes, their checksum, all little
endian, checksums being masked CRC32C. The bytes are a `tf.train.SequenceExample` with the context
`key` (int64) and `particle_type` (int64 values as bytes) and, for each frame, `position` (float32
`[N, d]` as bytes) and in some sets `step_context` (float32 `[C]` as bytes). The messages are those
of TensorFlow's `example.proto` and `feature.proto`; a map field is a repeated pair on the wire.
"""

from __future__ import annotations

import struct
from typing import IO, TYPE_CHECKING, Any

import google_crc32c
import numpy as np
import numpy.typing as npt
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from adaptgns.data.errors import DataError
from adaptgns.data.trajectory import (
    Shape,
    Trajectory,
    check_finite,
    check_shape,
    check_type_range,
    particle_types,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_HEADER = struct.Struct("<QI")
_FOOTER = struct.Struct("<I")

_MASK_DELTA = 0xA282EAD8

_AGAIN = "copy or download the file again"

_PACKAGE = "adaptgns.tfrecord"

_MESSAGES = {
    "BytesList": [("value", 1, "repeated", "bytes")],
    "Int64List": [("value", 1, "repeated", "int64")],
    "Feature": [
        ("bytes_list", 1, "optional", "BytesList"),
        ("int64_list", 3, "optional", "Int64List"),
    ],
    "Entry": [("key", 1, "optional", "string"), ("value", 2, "optional", "Feature")],
    "Features": [("feature", 1, "repeated", "Entry")],
    "FeatureList": [("feature", 1, "repeated", "Feature")],
    "ListEntry": [("key", 1, "optional", "string"), ("value", 2, "optional", "FeatureList")],
    "FeatureLists": [("feature_list", 1, "repeated", "ListEntry")],
    "SequenceExample": [
        ("context", 1, "optional", "Features"),
        ("feature_lists", 2, "optional", "FeatureLists"),
    ],
}
"""Name, number, label and type of the fields that are read."""


def _sequence_example() -> Any:
    """The message class `SequenceExample`."""
    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{_PACKAGE}.proto", package=_PACKAGE, syntax="proto3"
    )
    for message, fields in _MESSAGES.items():
        described = file.message_type.add(name=message)
        for name, number, label, kind in fields:
            field = described.field.add(name=name, number=number)
            field.label = getattr(kinds, f"LABEL_{label.upper()}")
            if kind in _MESSAGES:
                field.type = kinds.TYPE_MESSAGE
                field.type_name = f".{_PACKAGE}.{kind}"
            else:
                field.type = getattr(kinds, f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(
        pool.FindMessageTypeByName(f"{_PACKAGE}.SequenceExample")
    )


_SequenceExample = _sequence_example()


class TfrecordFile:
    """The trajectories of one file, in order; one record is in memory at a time.

    Opening walks over the record headers, so that a file that was cut off is refused at once.

    Attributes:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        """Raises `DataError` for a file that isn't whole or holds no record."""
        self.path = path
        self._records: list[tuple[int, int]] = []
        try:
            with path.open("rb") as file:
                size = file.seek(0, 2)
                offset = 0
                while offset < size:
                    length = self._length(file, offset, size)
                    self._records.append((offset + _HEADER.size, length))
                    offset += _HEADER.size + length + _FOOTER.size
        except FileNotFoundError:
            raise DataError(f"{path}: there is no such file") from None
        if not self._records:
            raise DataError(f"{path}: the file is empty; {_AGAIN}")

    def __len__(self) -> int:
        return len(self._records)

    def __iter__(self) -> Iterator[Trajectory]:
        dim = None
        with self.path.open("rb") as file:
            for index, (offset, length) in enumerate(self._records):
                where = f"{self.path}: record {index} at byte {offset - _HEADER.size}"
                trajectory = _trajectory(self._payload(file, offset, length, where), where)
                dim = dim or trajectory.positions.shape[2]
                if trajectory.positions.shape[2] != dim:
                    raise DataError(
                        f"{where}: positions have {trajectory.positions.shape[2]} dimensions, "
                        f"those of record 0 have {dim}"
                    )
                yield trajectory

    def _length(self, file: IO[bytes], offset: int, size: int) -> int:
        """The length of the record at `offset`, all of which is there."""
        where = f"{self.path}: record {len(self._records)} at byte {offset}"
        file.seek(offset)
        header = file.read(_HEADER.size)
        if len(header) < _HEADER.size:
            raise DataError(f"{where}: the file ends in its header, at byte {size}; {_AGAIN}")
        length, checksum = _HEADER.unpack(header)
        if checksum != masked_crc32c(header[:8]):
            raise DataError(
                f"{where}: its length fails its checksum, so the file is damaged or no "
                f"uncompressed TFRecord; {_AGAIN}"
            )
        end = offset + _HEADER.size + length + _FOOTER.size
        if end > size:
            raise DataError(
                f"{where}: it goes on to byte {end}, but the file ends at byte {size}; {_AGAIN}"
            )
        return int(length)

    def _payload(self, file: IO[bytes], offset: int, length: int, where: str) -> bytes:
        file.seek(offset)
        payload = file.read(length)
        footer = file.read(_FOOTER.size)
        if len(payload) < length or footer != _FOOTER.pack(masked_crc32c(payload)):
            raise DataError(f"{where}: its {length} bytes fail their checksum; {_AGAIN}")
        return payload


def masked_crc32c(data: bytes) -> int:
    """The checksum of TFRecord: CRC32C rotated right by 15 bits, plus a constant.

    It is masked since the CRC of bytes that hold their own CRC would be a weak one.
    """
    crc: int = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + _MASK_DELTA) & 0xFFFFFFFF


def _trajectory(payload: bytes, where: str) -> Trajectory:
    try:
        example = _SequenceExample.FromString(payload)
    except DecodeError as error:
        raise DataError(f"{where}: no tf.train.SequenceExample: {error}") from error
    context = {entry.key: entry.value for entry in example.context.feature}
    frames = {entry.key: entry.value.feature for entry in example.feature_lists.feature_list}
    for name, among in (("particle_type", context), ("position", frames)):
        if name not in among:
            raise DataError(
                f"{where}: no {name}; the context holds {sorted(context)}, the feature lists "
                f"{sorted(frames)}"
            )
    types = _numbers([context["particle_type"]], "<i8", f"{where}: particle_type")[0]
    flat = _numbers(frames["position"], "<f4", f"{where}: position")
    count = len(types)
    if count == 0 or flat.shape[1] % count:
        raise DataError(
            f"{where}: {flat.shape[1]} numbers per frame in position don't fit {count} particles"
        )
    positions = flat.reshape(len(flat), count, -1)
    step_context = None
    if "step_context" in frames:
        step_context = _numbers(frames["step_context"], "<f4", f"{where}: step_context")
        if len(step_context) != len(positions):
            raise DataError(
                f"{where}: step_context has {len(step_context)} frames, position {len(positions)}"
            )
    check_shape(Shape("", *positions.shape), where)
    types = particle_types(types, count, where)
    check_type_range(types, where)
    keys = context["key"].int64_list.value if "key" in context else ()
    trajectory = Trajectory(str(keys[0]) if keys else "", positions, types, None, step_context)
    check_finite(trajectory, 0, where)
    return trajectory


def _numbers(features: Any, dtype: str, where: str) -> npt.NDArray[Any]:
    """One row for each feature, all of a length."""
    rows = []
    for row, feature in enumerate(features):
        values = feature.bytes_list.value
        if len(values) != 1 or len(values[0]) % np.dtype(dtype).itemsize:
            raise DataError(f"{where}: entry {row} isn't one string of {dtype} numbers")
        rows.append(np.frombuffer(values[0], dtype=dtype))
        if len(rows[-1]) != len(rows[0]):
            raise DataError(
                f"{where}: entry {row} has {len(rows[-1])} numbers, entry 0 has {len(rows[0])}"
            )
    if not rows:
        raise DataError(f"{where}: no entries")
    return np.stack(rows).astype(np.dtype(dtype).newbyteorder("="), copy=False)
