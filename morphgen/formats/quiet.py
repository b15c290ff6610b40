"""Keep messages of C libraries out of the terminal and out of the current folder."""

from __future__ import annotations

import ctypes
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet() -> Iterator[None]:
    """Discard what C code of any thread prints to stdout and stderr in this block."""
    saved = [os.dup(fd) for fd in (1, 2)]
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in (1, 2):
            os.dup2(sink, fd)
        yield
    finally:
        if os.name == "posix":
            # C buffers output and would print it after the block. Python cannot flush C's buffers.
            ctypes.CDLL(None).fflush(None)
        for fd, original in zip((1, 2), saved, strict=True):
            os.dup2(original, fd)
            os.close(original)
        os.close(sink)


def log_mujoco_warnings() -> None:
    """Send MuJoCo's warnings to the logger ``morphgen.mujoco``.

    Without a callback MuJoCo writes them to ``MUJOCO_LOG.TXT`` in the current folder and to stdout.
    A callback that somebody else has set stays.
    """
    import mujoco

    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(logging.getLogger("morphgen.mujoco").warning)


class MujocoWarnings:
    """Collects MuJoCo's warnings, of all threads, instead of writing them to ``MUJOCO_LOG.TXT``.

    A class, because simulations enter the same one in every step: a generator takes twice as long.
    """

    def __init__(self) -> None:
        """Find MuJoCo's functions."""
        import mujoco

        self._get, self._set = mujoco.get_mju_user_warning, mujoco.set_mju_user_warning

    def __enter__(self) -> list[str]:
        """Begin; return the list that receives the warnings."""
        warnings: list[str] = []
        self._previous = self._get()
        self._set(warnings.append)
        return warnings

    def __exit__(self, *error: object) -> None:
        """Restore what was done with warnings before."""
        self._set(self._previous)
