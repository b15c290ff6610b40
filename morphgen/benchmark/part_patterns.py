"""Expand patterns such as ``arm={ur5,panda} ee=*`` to the robots that they stand for."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from morphgen.errors import BenchmarkError, CompositionError, nearest
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.library import Library
from morphgen.grammar.request import SLOTS, parse_words

NOTHING = "none"
"""Name of the part for robots without an end-effector."""
_CHOICE = re.compile(r"\{([^{}]*)\}")
_WILDCARD = re.compile(r"[*?[]")


@dataclass(frozen=True)
class PatternRobot:
    """A robot that a pattern stands for."""

    words: tuple[str, ...]
    """Arguments of ``morphgen compose``."""
    derivation: Derivation
    name: str
    """Name that ``morphgen compose`` gives it."""


def pattern_robots(pattern: str, library: Library) -> list[PatternRobot]:
    """Return the robots that a pattern stands for: every choice in braces with every other one.

    A wildcard such as ``ee=*`` stands for all parts that fit; the part ``none`` must be named.

    Args:
        pattern: Arguments of ``morphgen compose`` with braces and wildcards.
        library: The library of parts.

    Raises:
        BenchmarkError: If braces do not match or have an invalid choice, or no part matches.
        MorphgenError: If the pattern names an unknown part, or parts that do not fit.
    """
    robots: list[PatternRobot] = []
    for words in expand(pattern):
        choices = [_matching(word, pattern, library) for word in words]
        misfit: CompositionError | None = None
        fitting: list[PatternRobot] = []
        for concrete in itertools.product(*choices):
            try:
                fitting.append(PatternRobot(concrete, *parse_words(concrete, library)))
            except CompositionError as error:
                if concrete == words:  # named parts must fit; a wildcard means those that do
                    raise
                misfit = error
        if misfit is not None and not fitting:
            raise misfit
        robots += fitting
    return robots


def expand(pattern: str) -> list[tuple[str, ...]]:
    """Expand the choices in braces in arguments of ``morphgen compose``: the product of all.

    Args:
        pattern: A pattern such as ``arm={ur5,panda} ee={plane,stick}``.

    Raises:
        BenchmarkError: If braces do not match, or contain an empty or repeated choice.
    """
    joined = _CHOICE.sub(lambda match: re.sub(r"\s", "", match[0]), pattern)
    if "{" in _CHOICE.sub("", joined) or "}" in _CHOICE.sub("", joined):
        raise BenchmarkError(f"--from {pattern!r}: a brace is not closed, or opened twice")
    words = [_choices(word, pattern) for word in joined.split()]
    if not words:
        raise BenchmarkError("--from is empty; expected such as 'arm={ur5,panda} ee={plane,stick}'")
    return list(itertools.product(*words))


def _choices(word: str, pattern: str) -> list[str]:
    """Return a word once for each choice in its braces."""
    fixed = _CHOICE.split(word)[::2]
    choices = [match.split(",") for match in _CHOICE.findall(word)]
    for options in choices:
        twice = [choice for choice, times in Counter(options).items() if times > 1]
        if "" in options or twice:
            what = f"has {twice[0]!r} twice" if twice and twice[0] else "has an empty choice"
            raise BenchmarkError(f"--from {pattern!r}: {{{','.join(options)}}} {what}")
    return [
        "".join(
            piece for pair in itertools.zip_longest(fixed, chosen, fillvalue="") for piece in pair
        )
        for chosen in itertools.product(*choices)
    ]


def _matching(word: str, pattern: str, library: Library) -> Sequence[str]:
    """Return a word once for each part that its wildcard matches."""
    key, _, value = word.partition("=")
    slot = key.rpartition(".")[2]
    if slot not in SLOTS or not _WILDCARD.search(value):
        return [word]
    names = library.names(slot)
    matching = [name for name in names if name != NOTHING and fnmatchcase(name, value)]
    if not matching:
        raise BenchmarkError(
            f"--from {pattern!r}: no {slot} matches {value!r}{nearest(value, names)}"
        )
    return [f"{key}={name}" for name in matching]
