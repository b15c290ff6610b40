"""Errors that morphgen raises for users, hints that list valid names, and checks of arguments."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from inspect import signature
from itertools import takewhile
from numbers import Integral
from operator import eq
from os import PathLike
from pathlib import Path
from types import SimpleNamespace

_MAX_LISTED = 24  # largest number of valid names that a hint lists completely
_MAX_SHOWN = 8  # largest number of valid names that a hint shows of a longer list
_MIN_PART = 3  # least length of a name that is near all that contain it [characters]
_MAX_COMPARED = 200
"""Longest name that is compared with the valid ones [characters]; the time grows quadratically."""
MALFORMED = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    NameError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
)
"""Exceptions that libraries raise on malformed files of strangers, besides their own."""


class MorphgenError(Exception):
    """Base of all errors that a user can cause; its text is one line for the terminal."""


class RobotError(MorphgenError):
    """The structure of a robot is inconsistent."""


class FormatError(MorphgenError):
    """A file cannot be read or written, or its content is invalid."""


class MeshError(FormatError):
    """A mesh file is missing, unreadable, empty or not finite."""


class PartError(MorphgenError):
    """A part, its manifest or one of its parameters is unknown or invalid."""


class FitError(MorphgenError):
    """No primitive can approximate the shapes."""


class BenchmarkError(MorphgenError):
    """Tokens, a similarity or a split cannot be computed as requested."""


class TaskError(MorphgenError):
    """A task cannot be set up for a robot, or an action is invalid."""


class NoGoalsError(TaskError):
    """A robot cannot do a task, or hardly: its seed and constants give too few goals."""


class SimulationError(MorphgenError):
    """A simulator cannot load a scene, or ended."""


class GrammarError(MorphgenError):
    """A grammar, a condition or a derivation is malformed or refers to unknown names."""


class CompositionError(MorphgenError):
    """Parts cannot be joined as requested."""


class MissingDependencyError(MorphgenError):
    """An optional package that the command needs is not installed."""


def one_line(text: str) -> str:
    """Return text, such as a name from a file, as one line, unprintable characters escaped."""
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in words)


def shortened(text: str, most: int = 80) -> str:
    """Return the beginning of a text for a message, at most ``most`` characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def nearest(name: str, valid: Iterable[str], unlisted: Iterable[str] = ()) -> str:
    """Return a hint for an unknown name, such as ``; did you mean 'ur5'? valid: ur3, ur5``.

    It is the closest valid or unlisted name, and the list of valid ones if not too long.
    """
    choices = sorted(valid)
    if len(name) > _MAX_COMPARED:
        return f"; {len(choices)} are valid"
    alike = {each: _likeness(name.lower(), each.lower()) for each in (*choices, *sorted(unlisted))}
    best = max(alike, key=alike.__getitem__, default="")
    guess = f"; did you mean {best!r}?" if alike.get(best) else ";"
    if len(choices) <= _MAX_LISTED:
        return f"{guess} valid: {', '.join(choices) or '(none)'}"
    close = sorted(filter(alike.__getitem__, choices), key=alike.__getitem__, reverse=True)
    if close == [best]:
        return guess
    if close:
        return f"{guess} nearest of {len(choices)}: {', '.join(sorted(close[:_MAX_SHOWN]))}"
    return f"{guess} {len(choices)} are valid, such as {', '.join(choices[:_MAX_SHOWN])}"


def _likeness(name: str, choice: str) -> float:
    """Return how alike two names in small letters are; 0 if they do not resemble each other."""
    if name == choice:
        return 2.0
    if sorted(name) == sorted(choice):  # a more frequent slip than others that match as many
        return 1.0
    ratio = difflib.SequenceMatcher(None, choice, name).ratio()
    num_unmatched = (1.0 - ratio) * (len(name) + len(choice))
    is_part = len(name) >= _MIN_PART and name in choice
    num_equal = len(list(takewhile(bool, map(eq, name, choice))))  # letters at the beginning
    # Short names with few different letters have a low ratio: gltf and glb, but also stl and html.
    is_near = ratio >= 0.6 or (ratio >= 0.5 and num_unmatched < 3.5 and num_equal > 0)
    return ratio + 1e-4 * num_equal if is_near or is_part else 0.0  # which decide between equals


EXTRAS = {
    "coacd": ("convex",),
    "embreex": ("fit",),
    "fast_simplification": ("fit",),
    "gymnasium": ("tasks", "rl"),
    "imageio": ("tasks", "rl"),
    "pyarrow": ("demos",),
    "tensorboard": ("rl",),
    "torch": ("tasks", "rl"),
    "urdf_usd_converter": ("usd",),
    "viser": ("viewer",),
    "websockets": ("viewer",),
}
"""Optional packages by import name, and the extras of morphgen that install each, the smallest
first."""


def missing_extra(error: Exception, wanted: str = "") -> str | None:
    """Return how to install the optional package that an import lacks; None for other errors."""
    if not (isinstance(error, ModuleNotFoundError) and error.name in EXTRAS):
        return None
    extras = EXTRAS[error.name]
    hint = f"pip install 'morphgen[{wanted if wanted in extras else extras[0]}]'"
    if error.name == "torch":
        hint += "; a small build without CUDA: https://pytorch.org/get-started/locally"
    return f"the package {error.name} is not installed: {hint}"


@contextmanager
def explain_missing_extras(wanted: str = "") -> Iterator[None]:
    """Convert the failed import of an optional package to an error with the wanted extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        text = missing_extra(error, wanted)
        if text is None:
            raise
        raise MissingDependencyError(text) from error


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


MAX_WHOLE = 2**63 - 1  # largest whole number that files hold


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
    function: Callable[..., object], given: SimpleNamespace, *texts: str, **least: int
) -> None:
    """Require arguments of a function to be texts, and others whole numbers, made ``int``.

    Those whose default is None may be None.
    """
    defaults = {name: each.default for name, each in signature(function).parameters.items()}
    not_given = {name for name in defaults if defaults[name] is getattr(given, name) is None}
    for name in (each for each in texts if each not in not_given):
        text_argument(name, getattr(given, name), TaskError)
    for name in (each for each in least if each not in not_given):
        setattr(given, name, whole_number(name, getattr(given, name), TaskError, least[name]))
        if getattr(given, name) > MAX_WHOLE:
            raise TaskError(f"{name}: expected at most 2^63 - 1")


def truth(name: str, value: object, error: type[MorphgenError]) -> bool:
    """Return a ``bool``, also for one of NumPy's."""
    import numpy as np  # 0.1 s, which `morphgen --help` does not need

    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise error(f"{name} {value!r}: expected True or False")
