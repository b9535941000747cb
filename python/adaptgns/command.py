"""What commands do about errors that are their user's to mend."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from adaptgns.data.errors import DataWarning
from adaptgns.interruption import Terminated, termination

_formatwarning = warnings.formatwarning


@contextmanager
def plain_errors(*also: type[Exception]) -> Iterator[None]:
    """Tell wrong input, a failing disk, exhausted memory, Ctrl-C, SIGTERM, and what is in ``also``,
    in one line on standard error instead of a traceback, and exit: with 2, after Ctrl-C with 130,
    after SIGTERM with 143."""
    told: tuple[type[Exception], ...] = (ValueError, OSError, MemoryError, *also)
    formatted = warnings.formatwarning
    warnings.formatwarning = _formatted
    try:
        with termination():
            yield
    except Terminated:
        print("terminated", file=sys.stderr)
        raise SystemExit(143) from None
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except told as error:
        print(f"error: {_described(error)}", file=sys.stderr)
        raise SystemExit(2) from None
    finally:
        warnings.formatwarning = formatted


def _formatted(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """What is wrong with data in a line, whoever found it; other warnings as ever."""
    if issubclass(category, DataWarning):
        return f"warning: {message}\n"
    return _formatwarning(message, category, filename, lineno, line)


def _described(error: Exception) -> str:
    if isinstance(error, (FileExistsError, NotADirectoryError)) and error.filename is not None:
        return f"{error.filename}: a file is where a folder is needed"
    return str(error) or type(error).__name__
