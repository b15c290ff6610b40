"""Derivations: which parts a body is made of, with which parameters, attached where."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

from morphgen.formats.urdf_text import number


@dataclass(frozen=True)
class Derivation:
    """A part with its parameters, and what is attached to its ports."""

    label: str
    """Scope of the part's names, unique in the tree, such as ``arm`` or ``left_ee``."""
    part: str
    parameters: tuple[tuple[str, float], ...] = ()
    """Every parameter of the part, SI units."""
    children: tuple[tuple[str, Derivation], ...] = ()
    """(port, what is attached to it)."""

    def __str__(self) -> str:
        values = ", ".join(f"{name}={number(value)}" for name, value in self.parameters)
        ports = ", ".join(f"{port}: {child}" for port, child in self.children)
        return (
            f"{self.label}={self.part}"
            + (f"({values})" if values else "")
            + (f"[{ports}]" if ports else "")
        )

    def walk(self) -> Iterator[Derivation]:
        """The node and all below it, parents first."""
        yield self
        for _, child in self.children:
            yield from child.walk()

    @property
    def digest(self) -> str:
        """SHA-256 of the text, hexadecimal."""
        return hashlib.sha256(str(self).encode()).hexdigest()
