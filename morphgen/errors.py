"""The errors that morphgen raises for users, and the hint that lists valid names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_MAX_LISTED = 24
"""Largest number of valid names that a hint lists completely."""
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


class SignatureError(MorphgenError, TypeError):
    """A public function was called with arguments that it does not have."""


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
    """Return text as one line: single spaces, unprintable characters escaped.

    Names from files can contain line breaks or characters that control the terminal.
    """
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in words)


def shortened(text: str, most: int = 80) -> str:
    """Return the beginning of a text for a message, at most ``most`` characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def nearest(name: str, valid: Iterable[str], unlisted: Iterable[str] = ()) -> str:
    """Return a hint for an unknown name: the closest valid one and the list, if not too long.

    Args:
        name: The unknown name.
        valid: Valid names.
        unlisted: Further valid names, which may be the closest one but are too many for the list.

    Returns:
        Text to append to an error, such as ``; did you mean 'ur5'? valid: ur3, ur5``.
    """
    choices = sorted(valid)
    if len(name) > _MAX_COMPARED:
        return f"; {len(choices)} are valid"
    every = [*choices, *sorted(unlisted)]
    close = [choice for choice in every if choice.lower() == name.lower()]
    # Letters in another order are a more frequent slip than others that match as many.
    close = close or [choice for choice in every if sorted(choice) == sorted(name)]
    close = close or difflib.get_close_matches(name, every, n=1, cutoff=0.5)
    guess = f"; did you mean {close[0]!r}?" if close else ";"
    if len(choices) > _MAX_LISTED:
        listed = sorted(difflib.get_close_matches(name, choices, n=8, cutoff=0.0))  # however unlike
        return f"{guess} nearest of {len(choices)}: {', '.join(listed)}"
    return f"{guess} valid: {', '.join(choices) or '(none)'}"
