"""Checks of arguments of public functions, whose types callers may get wrong."""

from __future__ import annotations

from numbers import Integral
from os import PathLike
from pathlib import Path
from types import SimpleNamespace

from morphgen.errors import MorphgenError


def path_argument(name: str, value: object, error: type[MorphgenError]) -> Path:
    """Return the path that a text or another path names."""
    if isinstance(value, str | PathLike):
        path = Path(value)
        if "\0" not in str(path):  # the system's calls raise ValueError, not OSError, for it
            return path
    raise error(f"{name} {value!r}: expected a path")


def text_argument(name: str, value: object, error: type[MorphgenError]) -> str:
    """Return a text."""
    if isinstance(value, str):
        return value
    raise error(f"{name} {value!r}: expected a text")


def whole_number(
    name: str, value: object, error: type[MorphgenError], least: int | None = None
) -> int:
    """Return a whole number, such as one of NumPy's, as an ``int``."""
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)  # True is an Integral
    if not is_whole or (least is not None and int(value) < least):  # type: ignore[call-overload]
        valid = "a whole number" if least is None else f"a whole number, {least} or more"
        raise error(f"{name} {value!r}: expected {valid}")
    return int(value)  # type: ignore[call-overload,no-any-return]


def require_types(
    given: SimpleNamespace, error: type[MorphgenError], *texts: str, **least: int
) -> None:
    """Require texts by name, and others None or whole numbers of a least value, made ``int``."""
    for name in (each for each in texts if getattr(given, each) is not None):
        text_argument(name, getattr(given, name), error)
    for name in (each for each in least if getattr(given, each) is not None):
        setattr(given, name, whole_number(name, getattr(given, name), error, least[name]))


def truth(name: str, value: object, error: type[MorphgenError]) -> bool:
    """Return a ``bool``, also for one of NumPy's."""
    import numpy as np  # 0.1 s, which `morphgen --help` does not need

    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise error(f"{name} {value!r}: expected True or False")
