"""Errors that users mend are one line, not a traceback."""

from __future__ import annotations

import os
import signal
import warnings
from pathlib import Path

import pytest

from adaptgns.command import plain_errors
from adaptgns.data import DataWarning


@pytest.mark.parametrize(
    ("error", "told", "code"),
    [
        (ValueError("tau: got 200"), "error: tau: got 200\n", 2),
        (MemoryError(), "error: MemoryError\n", 2),
        (KeyboardInterrupt(), "interrupted\n", 130),
        (IndexError("no such trajectory"), "error: no such trajectory\n", 2),
    ],
)
def test_plain_errors(
    error: BaseException, told: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_, plain_errors(IndexError):
        raise error
    assert exit_.value.code == code
    assert capsys.readouterr().err == told


def test_what_is_suspicious_about_data_is_a_line() -> None:
    def shown(category: type[Warning]) -> str:
        return warnings.formatwarning("train.h5: odd", category, "train.py", 129)

    with plain_errors():
        assert shown(DataWarning) == "warning: train.h5: odd\n"
        assert shown(DeprecationWarning).startswith(
            "train.py:129: DeprecationWarning: train.h5: odd"
        )
    assert shown(DataWarning).startswith("train.py:129: DataWarning: train.h5: odd")


def test_bugs_keep_their_traceback() -> None:
    with pytest.raises(IndexError), plain_errors():
        raise IndexError


def test_sigterm_undoes_what_is_half_done(capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    undone = []

    def work() -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            signal.pause()
        finally:
            undone.append(True)

    with pytest.raises(SystemExit) as exit_, plain_errors():
        work()
    assert undone
    assert exit_.value.code == 143
    assert capsys.readouterr().err == "terminated\n"
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_file_in_the_way_of_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(SystemExit), plain_errors():
            folder.mkdir(parents=True, exist_ok=True)
        assert f"error: {folder}: a file is where a folder is needed" in capsys.readouterr().err
