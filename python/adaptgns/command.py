"""What commands do about errors that are their user's to mend."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def plain_errors(*also: type[Exception]) -> Iterator[None]:
    """Tell wrong input, a failing disk, exhausted memory, Ctrl-C, and what is in ``also``, in one
    line on standard error instead of a traceback, and exit: with 2, or 130 after Ctrl-C."""
    told: tuple[type[Exception], ...] = (ValueError, OSError, MemoryError, *also)
    try:
        yield
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except told as error:
        print(f"error: {str(error) or type(error).__name__}", file=sys.stderr)
        raise SystemExit(2) from None
