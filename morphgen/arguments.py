"""Checks of arguments of public functions, whose types callers may get wrong."""

from __future__ import annotations

from numbers import Integral

import numpy as np

from morphgen.errors import MorphgenError


def whole_number(
    name: str, value: object, error: type[MorphgenError], least: int | None = None
) -> int:
    """Return a whole number, such as one of NumPy's, as an ``int``.

    Args:
        name: Name of the argument, for the message.
        value: Its value.
        error: Class of the error.
        least: Smallest valid value.

    Raises:
        MorphgenError: Of that class, if it is no whole number, or smaller.
    """
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not is_whole or (least is not None and int(value) < least):  # type: ignore[call-overload]
        valid = "a whole number" if least is None else f"a whole number, {least} or more"
        raise error(f"{name} {value!r}: expected {valid}")
    return int(value)  # type: ignore[call-overload,no-any-return]


def truth(name: str, value: object, error: type[MorphgenError]) -> bool:
    """Return a ``bool``, also for one of NumPy's.

    Args:
        name: Name of the argument, for the message.
        value: Its value.
        error: Class of the error.

    Raises:
        MorphgenError: Of that class, if it is anything else, such as the text ``no``.
    """
    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise error(f"{name} {value!r}: expected True or False")
