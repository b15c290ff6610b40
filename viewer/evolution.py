"""Generations of robots: mutants of one robot or children of two, and the history of choices."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from morphgen.formats.rounding import round_number
from morphgen.grammar.choosers import Choices, FirstChooser, RecordedChooser
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation, difference
from morphgen.grammar.derive import derive
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.sampling import cross, mutate
from morphgen.model.robot import Robot
from morphgen.viewer.address import AddressError, pack_text, unpack_text

NUM_OFFSPRING = 9
"""Robots of a generation."""


@dataclass(frozen=True, eq=False)
class Individual:
    """A robot of a grammar with the choices that gave it."""

    robot: Robot
    derivation: Derivation
    choices: Choices


@dataclass(eq=False)
class History:
    """Individuals that were adopted one after the other; a later one may be undone."""

    individuals: list[Individual] = field(default_factory=list)
    position: int = -1
    """Index of the current individual."""

    def add(self, individual: Individual) -> None:
        """Adopt an individual in place of those that were undone."""
        del self.individuals[self.position + 1 :]
        self.individuals.append(individual)
        self.position += 1

    def go_to(self, position: int) -> Individual | None:
        """Go to an individual; return it, or None if there is no such one."""
        if not 0 <= position < len(self.individuals):
            return None
        self.position = position
        return self.individuals[position]


def make_individual(
    grammar: Grammar, library: Library, choices: Choices, name: str = ""
) -> Individual:
    """Return the robot that choices give; choices that are missing are typical ones.

    Args:
        grammar: The grammar.
        library: Library of the grammar's parts.
        choices: The choices.
        name: Name of the robot; by default that of ``individual_name``.

    Raises:
        GrammarError: If the grammar cannot be derived.
        MorphgenError: If the robot cannot be composed.
    """
    chooser = RecordedChooser(FirstChooser(), choices)
    derivation = derive(grammar, library, chooser)
    robot = compose(derivation, library, name or individual_name(grammar, derivation))
    return Individual(robot, derivation, dict(chooser.choices))


def individual_name(grammar: Grammar, derivation: Derivation) -> str:
    """Return the name of an individual, the same for the same derivation."""
    return f"{grammar.name}-{derivation.digest[:8]}"


def offspring(
    grammar: Grammar, folders: tuple[Path, ...], parents: Sequence[Choices], seed: int
) -> list[Individual]:
    """Return the mutants of one parent, or the children of two. Runs in a worker.

    Raises:
        GrammarError: If the parent has no random choices.
        SamplingError: If no valid robot that differs from the parents is found.
    """
    library = Library(folders)
    if len(parents) == 1:
        samples = mutate(grammar, library, parents[0], NUM_OFFSPRING, seed=seed, name=grammar.name)
    else:
        both = (parents[0], parents[1])
        samples = cross(grammar, library, both, NUM_OFFSPRING, seed=seed, name=grammar.name)
    return [
        Individual(
            replace(sample.robot, name=individual_name(grammar, sample.derivation)),
            sample.derivation,
            sample.choices,
        )
        for sample in samples
    ]


def change_lines(parent: Derivation, child: Derivation) -> list[str]:
    """Return what differs in a child, such as ``claw.size 0.0506 to 0.0393``, one line each."""
    sides: dict[str, dict[str, str]] = {}
    for line in difference(parent, child):
        key, _, value = line[2:].partition(" = ")
        sides.setdefault(key, {})[line[0]] = _short(value)
    lines = []
    for key, values in sides.items():
        if values.keys() == {"-", "+"}:
            lines.append(f"{key} {values['-']} to {values['+']}")
        elif "." not in key:  # the parameters of a part come and go with it
            sign, value = next(iter(values.items()))
            lines.append(f"{sign} {key} ({value})")
    return lines


def _short(value: str) -> str:
    """Return a number with three digits, and other text as it is."""
    try:
        return f"{float(value):.3g}"
    except ValueError:
        return value


def pack_choices(choices: Choices) -> str:
    """Return choices as text for an address.

    Raises:
        AddressError: If they are too long.
    """
    rounded = {key: round_number(value) for key, value in choices.items()}
    return pack_text(json.dumps(rounded, separators=(",", ":")))


def unpack_choices(text: str) -> Choices:
    """Return the choices that ``pack_choices`` has packed.

    Raises:
        AddressError: If the text is invalid.
    """
    try:
        choices = json.loads(unpack_text(text))
    except (ValueError, RecursionError) as error:
        raise AddressError(f"the address has no readable choices: {error}") from error
    if not isinstance(choices, dict) or not all(
        isinstance(value, int | float) and math.isfinite(value) for value in choices.values()
    ):
        raise AddressError("the address has no readable choices: expected a number by each key")
    return choices
