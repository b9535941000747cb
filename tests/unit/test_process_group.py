"""What the processes of one training do together, seen from one of them."""

from __future__ import annotations

from contextlib import nullcontext
from datetime import timedelta
from pathlib import Path

import pytest
import torch
import torch.distributed as dist

from adaptgns import train
from adaptgns.fit import TrainingStopped
from adaptgns.processes import OtherEndedError, Processes, processes


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> None:
    """The only process of a launcher."""
    settings = {
        **{"TORCHELASTIC_RUN_ID": "test", "MASTER_ADDR": "localhost", "MASTER_PORT": "0"},
        **{"RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1"},
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)


@pytest.mark.usefixtures("launched")
def test_the_others_wait_for_hours_where_the_first_may_validate() -> None:
    with processes("cpu") as group:
        assert (group.rank, group.count) == (0, 1)
        backend = (group.patient or dist.group.WORLD)._get_backend(torch.device("cpu"))
        assert backend.options._timeout >= timedelta(hours=12)
    assert not dist.is_initialized()


def lost(*_: object, **__: object) -> None:
    raise RuntimeError("Connection closed by peer. This is typical.\nSo it goes.")


def test_a_process_that_is_gone_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("all_reduce", "broadcast_object_list", "barrier"):
        monkeypatch.setattr(dist, name, lost)
    group, layer = Processes(0, 2), torch.nn.Linear(2, 1)
    for together in (
        group.wait,
        lambda: group.any(mine=True),
        lambda: group.same(lambda: 1),
        lambda: group.mean_gradients(layer.parameters(), torch.zeros(()), 1),
    ):
        with pytest.raises(OtherEndedError, match=r"another .* \(Connection closed by peer\)$"):
            together()


def test_the_first_goes_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    monkeypatch.setattr(dist, "barrier", lambda **_: done.append("all there"))
    for rank in (0, 1):
        with Processes(rank, 2).first_ahead():
            done.append("work")
    assert done == ["work", "all there", "all there", "work"]


@pytest.mark.parametrize(("rank", "alone", "told"), [(0, False, 1), (1, False, 0), (1, True, 1)])
def test_what_all_have_met_the_first_tells(
    rank: int,
    alone: bool,
    told: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def stop(*_: object) -> None:
        raise TrainingStopped("it ended", alone=alone)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(dist, "broadcast_object_list", lambda *_, **__: None)
    monkeypatch.setattr(train, "processes", lambda _: nullcontext(Processes(rank, 2)))
    monkeypatch.setattr(train, "train", stop)
    with pytest.raises(SystemExit):
        train.main(["--preset", "smoke"])
    assert "".join(capsys.readouterr()).count("it ended") == told


def test_gradients_of_no_particles_count_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    summed: list[torch.Tensor] = []
    monkeypatch.setattr(dist, "all_reduce", summed.append)
    layer = torch.nn.Linear(2, 1)
    loss = layer(torch.full((1, 2), torch.nan)).mean()
    loss.backward()
    Processes(1, 2).mean_gradients(layer.parameters(), loss, 0)
    assert not summed[0].any()


@pytest.mark.usefixtures("launched")
def test_every_process_needs_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "3")
    with (
        pytest.raises(ValueError, match="LOCAL_WORLD_SIZE: got 3 processes for 2 GPUs"),
        processes("cuda"),
    ):
        pass


@pytest.mark.usefixtures("launched")
def test_a_process_names_its_gpu_and_leaves_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """NCCL wants to know the GPU beforehand, and waits for all where a group of its ends."""
    calls: list[object] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "set_device", calls.append)
    monkeypatch.setattr(dist, "init_process_group", lambda *a, **k: calls.append((a, k)))
    monkeypatch.setattr(dist, "new_group", lambda **_: "patient")
    monkeypatch.setattr(dist, "get_rank", lambda: 0)
    monkeypatch.setattr(dist, "get_world_size", lambda: 1)
    monkeypatch.setattr(dist, "destroy_process_group", lambda *a: calls.append(a))
    gpu = torch.device("cuda", 0)
    begun = [gpu, (("nccl",), {"device_id": gpu})]

    with processes("cuda") as group:
        assert group.patient == "patient"
    assert calls == [*begun, ()]

    calls.clear()
    with pytest.raises(MemoryError), processes("cuda"):
        raise MemoryError
    assert calls == [*begun, ("patient",)]
