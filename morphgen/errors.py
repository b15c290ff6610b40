"""Every error that morphgen raises on purpose, and the hint that lists valid choices."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping

_LISTED = 24
_LONGEST = 200
"""Characters of the longest name that is compared with others, which takes their square."""


class MorphgenError(Exception):
    """Root of the errors a user can cause; its text is one line fit for a terminal."""


class RobotError(MorphgenError):
    """A robot's structure contradicts itself."""


class FormatError(MorphgenError):
    """A file cannot be read or written as what it claims to be."""


class MeshError(FormatError):
    """A mesh file is missing, unreadable, empty or not finite."""


class PartError(MorphgenError):
    """A part, its manifest or one of its parameters is unknown or wrong."""


class FitError(MorphgenError):
    """Shapes that no primitive can stand for."""


class BenchmarkError(MorphgenError):
    """Tokens, a similarity or a split that cannot be made as asked."""


class TaskError(MorphgenError):
    """A task that cannot be set up for a robot, or an action that is none."""


class SimulationError(MorphgenError):
    """A simulator that cannot hold a scene, became unstable or died."""


class DivergedError(SimulationError):
    """Environments whose numbers mean nothing any more, until they are reset; all others are well.

    Its text is the reason of the first.
    """

    def __init__(self, reasons: Mapping[int, str]) -> None:
        """Name them, at least one, each by its number and with what is wrong."""
        super().__init__(dict(sorted(reasons.items())))

    @property
    def reasons(self) -> dict[int, str]:
        """What is wrong, by environment."""
        found: dict[int, str] = self.args[0]
        return found

    def __str__(self) -> str:
        """One line."""
        return next(iter(self.reasons.values()))


class GrammarError(MorphgenError):
    """A grammar, a condition or a derivation is malformed or means nothing."""


class CompositionError(MorphgenError):
    """Parts cannot be joined as asked."""


class MissingDependencyError(MorphgenError):
    """An optional package that the command needs is not installed."""


def one_line(text: str) -> str:
    """Return text as one line of a terminal: white space made single, what cannot be shown escaped.

    A name from a file can hold line breaks, or characters that move a terminal's cursor.
    """
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in words)


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return a hint for an unknown name: the closest valid one and the list, if not too long.

    Args:
        name: What the user wrote.
        valid: Every name that would have been accepted.

    Returns:
        Text to append to an error, such as ``; did you mean 'ur5'? valid: ur3, ur5``.
    """
    choices = sorted(valid)
    if len(name) > _LONGEST:
        return f"; {len(choices)} are valid"
    close = difflib.get_close_matches(name, choices, n=1, cutoff=0.5)
    guess = f"; did you mean {close[0]!r}?" if close else ";"
    if len(choices) > _LISTED:
        listed = sorted(difflib.get_close_matches(name, choices, n=8, cutoff=0.0))
        return f"{guess} nearest of {len(choices)}: {', '.join(listed)}"
    return f"{guess} valid: {', '.join(choices) or '(none)'}"
