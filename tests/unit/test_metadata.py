"""metadata.json of GNS, LagrangeBench and our own, complete and not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptgns.data import DataError, DataWarning, Metadata, read_metadata, write_metadata
from adaptgns.data import metadata as metadata_module
from adaptgns.data.store import write_split
from adaptgns.data.trajectories import Trajectory

GNS: dict[str, Any] = {
    "bounds": [[0.1, 0.9], [0.1, 0.9]],
    "sequence_length": 320,
    "default_connectivity_radius": 0.015,
    "dim": 2,
    "dt": 0.0025,
    "vel_mean": [1e-4, -1e-3],
    "vel_std": [2e-3, 3e-3],
    "acc_mean": [1e-8, 2e-8],
    "acc_std": [1e-4, 2e-4],
}
STATISTICS = ("vel_mean", "vel_std", "acc_mean", "acc_std")


def without(content: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in content.items() if key not in keys}


def save(folder: Path, content: object) -> Path:
    (folder / "metadata.json").write_text(json.dumps(content))
    return folder


def random_walk(seed: int, frames: int = 9, particles: int = 4, dim: int = 2) -> Trajectory:
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, 1e-3, (frames, particles, dim))
    positions = (0.5 + steps.cumsum(0)).astype(np.float32)
    return Trajectory("", positions, np.full(particles, 5))


def test_gns(tmp_path: Path) -> None:
    metadata = read_metadata(save(tmp_path, GNS))
    assert metadata == Metadata(
        dim=2,
        dt=0.0025,
        bounds=((0.1, 0.9), (0.1, 0.9)),
        periodic=(False, False),
        radius=0.015,
        velocity_mean=(1e-4, -1e-3),
        velocity_std=(2e-3, 3e-3),
        acceleration_mean=(1e-8, 2e-8),
        acceleration_std=(1e-4, 2e-4),
        kinematic_types=(3,),
        material_properties=0,
    )
    assert metadata.box is None


def test_gns_in_sections(tmp_path: Path) -> None:
    rollout = GNS | {"sequence_length": 5}
    assert read_metadata(save(tmp_path, {"train": GNS, "rollout": rollout})).radius == 0.015


def test_lagrangebench(tmp_path: Path) -> None:
    content = GNS | {
        "periodic_boundary_conditions": [True, False, True],
        "write_every": 100,
        "bounds": [[0.0, 1.0], [0.5, 2.5]],
    }
    metadata = read_metadata(save(tmp_path, content))
    assert metadata.kinematic_types == (1, 2)
    assert metadata.periodic == (True, False)
    assert metadata.box is not None
    np.testing.assert_array_equal(metadata.box, [1.0, np.inf])
    assert metadata.dt == pytest.approx(0.25)


def test_stated_kinematic_types_win(tmp_path: Path) -> None:
    content = GNS | {"periodic_boundary_conditions": [False, False], "kinematic_types": [3]}
    assert read_metadata(save(tmp_path, content)).kinematic_types == (3,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dim": 4}, "dim is 4; 2 or 3"),
        ({"dim": "2"}, "dim is '2'"),
        ({"dim": 3}, "bounds has 2 axes; dim is 3"),
        ({"dt": 0}, r"dt is 0\.0"),
        ({"default_connectivity_radius": -1}, "default_connectivity_radius is -1"),
        ({"default_connectivity_radius": None}, "default_connectivity_radius is None"),
        ({"bounds": [[0.9, 0.1], [0.1, 0.9]]}, "low < high"),
        ({"bounds": [[0.1], [0.1, 0.9]]}, "per axis"),
        ({"bounds": 3}, "a list is accepted"),
        ({"vel_std": [0.0, 1e-3]}, "vel_std is.*above 0.*leave the key out"),
        ({"acc_std": [1e-3]}, "acc_std is.*2 numbers.*dim is 2"),
        ({"acc_std": [1e-3, 1e-3, 1e-3]}, "acc_std is.*2 numbers"),
        ({"vel_mean": [float("nan"), 0.0]}, "vel_mean is.*finite"),
        ({"vel_mean": ["0", 0.0]}, "vel_mean is.*finite"),
        ({"periodic_boundary_conditions": [True]}, "2 booleans"),
        ({"periodic_boundary_conditions": [1, 0]}, "2 booleans"),
        ({"kinematic_types": ["wall"]}, "integers"),
        ({"material_properties": -1}, "material_properties is -1"),
    ],
)
def test_wrong_values_are_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=f"metadata.json: .*{message}"):
        read_metadata(save(tmp_path, GNS | change))


@pytest.mark.parametrize("key", ["dim", "dt", "bounds", "default_connectivity_radius"])
def test_missing_keys_are_named(tmp_path: Path, key: str) -> None:
    with pytest.raises(DataError, match=f"metadata.json: no {key}; the keys are"):
        read_metadata(save(tmp_path, without(GNS, key)))


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"metadata.json: there is no such file"):
        read_metadata(tmp_path)
    (tmp_path / "metadata.json").write_text('{"dim": 2,')
    with pytest.raises(DataError, match=r"metadata.json: not readable as JSON"):
        read_metadata(tmp_path)
    with pytest.raises(DataError, match=r"metadata.json: holds a list"):
        read_metadata(save(tmp_path, [GNS]))


@pytest.mark.parametrize("wrapped", [False, True])
def test_missing_statistics_are_computed_and_written(tmp_path: Path, wrapped: bool) -> None:
    write_split(tmp_path / "train.h5", [random_walk(0), random_walk(1)])
    plain = without(GNS, *STATISTICS)
    save(tmp_path, {"train": plain, "rollout": plain} if wrapped else plain)
    metadata = read_metadata(tmp_path)
    assert metadata.velocity_std == pytest.approx((1e-3, 1e-3), rel=0.3)
    (tmp_path / "train.h5").unlink()
    assert read_metadata(tmp_path) == metadata
    content = json.loads((tmp_path / "metadata.json").read_text())
    for section in content.values() if wrapped else [content]:
        assert tuple(section["acc_std"]) == metadata.acceleration_std
        assert without(section, *STATISTICS) == plain


def test_stored_statistics_are_kept_beside_computed_ones(tmp_path: Path) -> None:
    write_split(tmp_path / "train.h5", [random_walk(0)])
    metadata = read_metadata(save(tmp_path, without(GNS, "acc_std")))
    assert metadata.velocity_std == (2e-3, 3e-3)
    assert metadata.acceleration_std != (1e-4, 2e-4)


def test_statistics_of_a_read_only_folder_stay_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, text: str) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(metadata_module, "replace_text", refuse)
    write_split(tmp_path / "train.h5", [random_walk(0)])
    save(tmp_path, without(GNS, *STATISTICS))
    with pytest.warns(DataWarning, match=r"metadata.json: .*kept in memory.*Permission denied"):
        metadata = read_metadata(tmp_path)
    assert metadata.velocity_std[0] > 0
    assert "vel_std" not in json.loads((tmp_path / "metadata.json").read_text())


def test_statistics_need_a_train_split(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none can be computed: .*no train\.h5"):
        read_metadata(save(tmp_path, without(GNS, *STATISTICS)))


def test_a_still_axis_has_no_usable_statistics(tmp_path: Path) -> None:
    still = random_walk(0)
    still.positions[..., 1] = 0.5
    write_split(tmp_path / "train.h5", [still])
    with pytest.raises(DataError, match=r"vel_std of the train split is.*above 0"):
        read_metadata(save(tmp_path, without(GNS, *STATISTICS)))


def test_material_properties_are_counted_in_the_data(tmp_path: Path) -> None:
    plain = random_walk(0)
    write_split(
        tmp_path / "train.h5",
        [Trajectory("", plain.positions, plain.particle_type, np.ones((4, 2), np.float32))],
    )
    assert read_metadata(save(tmp_path, GNS)).material_properties == 2


finite = st.floats(-1e6, 1e6)
positive = st.floats(1e-12, 1e6)


@given(data=st.data(), dim=st.sampled_from([2, 3]))
def test_json_round_trip(data: st.DataObject, dim: int) -> None:
    def axes(values: st.SearchStrategy[Any]) -> tuple[Any, ...]:
        return tuple(data.draw(st.lists(values, min_size=dim, max_size=dim)))

    metadata = Metadata(
        dim=dim,
        dt=data.draw(positive),
        bounds=axes(positive.map(lambda size: (-size, size))),
        periodic=axes(st.booleans()),
        radius=data.draw(positive),
        velocity_mean=axes(finite),
        velocity_std=axes(positive),
        acceleration_mean=axes(finite),
        acceleration_std=axes(positive),
        kinematic_types=tuple(data.draw(st.lists(st.integers(0, 8)))),
        material_properties=data.draw(st.integers(0, 3)),
    )
    text = json.dumps(metadata.to_json(), allow_nan=False)
    assert Metadata.from_json(json.loads(text)) == metadata


def test_json_of_other_versions_is_refused(metadata: Metadata) -> None:
    content = metadata.to_json()
    with pytest.raises(DataError, match="unknown: gravity"):
        Metadata.from_json(content | {"gravity": 9.8})
    with pytest.raises(DataError, match="unknown: dt"):
        Metadata.from_json(without(content, "dt"))


def test_writing_is_all_or_nothing(tmp_path: Path) -> None:
    save(tmp_path, GNS)
    with pytest.raises(ValueError, match="JSON"):
        write_metadata(tmp_path, {"dt": float("inf")})
    assert json.loads((tmp_path / "metadata.json").read_text()) == GNS
    write_metadata(tmp_path, {"dt": 1.0})
    assert [path.name for path in tmp_path.iterdir()] == ["metadata.json"]
