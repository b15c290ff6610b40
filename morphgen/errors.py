"""The errors that morphgen raises for users, and the hint that lists valid names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from itertools import takewhile
from operator import eq

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
    # Short names that differ in a few letters, such as gltf and glb, have a low ratio.
    is_near = ratio >= 0.6 or (ratio >= 0.5 and num_unmatched < 3.5)
    num_equal = len(list(takewhile(bool, map(eq, name, choice))))  # letters at the beginning
    return ratio + 1e-4 * num_equal if is_near or is_part else 0.0  # which decide between equals
