"""MuJoCo without the clock of its profiler."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def unclocked() -> Iterator[None]:
    """Steps within leave ``MjData.timer`` as it is; nothing else differs.

    MuJoCo times the parts of every step if the callback ``mjcb_time`` is there, and its Python
    package installs one at import: two thirds of a microsecond a step, where that of an arm takes
    six to twelve. ``mujoco.set_mjcb_time(None)`` puts that very one back, so this sets the variable
    of MuJoCo's C interface. It is one for all threads. Where the loader does not find it, as on
    Windows, steps are timed.
    """
    if _CLOCK is None:
        yield
        return
    before = _CLOCK.value or _INSTALLED
    _CLOCK.value = None
    try:
        yield
    finally:
        _CLOCK.value = before


def _variable() -> ctypes.c_void_p | None:
    """``mjcb_time`` of the library that the package has loaded."""
    bindings = ctypes.CDLL(mujoco._functions.__file__)
    try:
        return ctypes.c_void_p.in_dll(bindings, "mjcb_time")
    except ValueError:
        return None


_CLOCK = _variable()
_INSTALLED = _CLOCK.value if _CLOCK is not None else None
