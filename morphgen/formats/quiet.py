"""Keep what C code prints from the terminal."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet() -> Iterator[None]:
    """Keep what C code prints to the process's standard streams from the terminal.

    Other threads are kept from printing, too.
    """
    saved = [os.dup(fd) for fd in (1, 2)]
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in (1, 2):
            os.dup2(sink, fd)
        yield
    finally:
        _flush()
        for fd, original in zip((1, 2), saved, strict=True):
            os.dup2(original, fd)
            os.close(original)
        os.close(sink)


def _flush() -> None:
    """Write what C keeps in its buffers, which it would else print when the process ends."""
    if os.name == "posix":
        ctypes.CDLL(None).fflush(None)
