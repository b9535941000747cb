"""What the processes of one training do together, seen from one of them."""

from __future__ import annotations

from datetime import timedelta

import pytest
import torch
import torch.distributed as dist

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


def test_gradients_of_no_particles_count_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    summed: list[torch.Tensor] = []
    monkeypatch.setattr(dist, "all_reduce", summed.append)
    layer = torch.nn.Linear(2, 1)
    loss = layer(torch.full((1, 2), torch.nan)).mean()
    loss.backward()
    Processes(1, 2).mean_gradients(layer.parameters(), loss, 0)
    assert not summed[0].any()
