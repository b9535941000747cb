"""Signals that ask a long job to end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class Terminated(KeyboardInterrupt):
    """SIGTERM, treated as Ctrl-C is."""


@contextmanager
def termination() -> Iterator[None]:
    """SIGTERM raises :class:`Terminated`, so that what is half done is undone, as on Ctrl-C.

    Threads other than the main one get no signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def terminate(_: int, __: FrameType | None) -> None:
        raise Terminated

    previous = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


@contextmanager
def interruption(*, insistent: bool = True) -> Iterator[list[str]]:
    """A list that stays empty until SIGINT or SIGTERM arrives, which then names the signal.

    The work looks at it where it can stop: an exception out of a signal handler can surface
    anywhere, and is lost where it does so in a destructor or a callback of a C library. A second
    signal acts as it would have without this, unless not ``insistent``: a launcher of several
    processes hands on what the terminal has sent them already. Threads other than the main one get
    no signals, and here an empty list.
    """
    received: list[str] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    previous: dict[int, Any] = {}

    def note(number: int, _: FrameType | None) -> None:
        received.append(signal.Signals(number).name)
        if insistent:
            signal.signal(number, previous[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, note)
    try:
        yield received
    finally:
        for caught, handler in previous.items():
            signal.signal(caught, handler)
