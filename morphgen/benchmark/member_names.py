"""Name robots after their parts: ``kinova_gen3+plane``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from morphgen.benchmark.part_patterns import NOTHING
from morphgen.grammar.derivation import Derivation

_UNNAMED = frozenset(("fixed", NOTHING))
"""Parts that a name leaves out: the usual base, and no end-effector."""
_MAX_LENGTH = 150
"""Longest name of parts [characters]; a suffix and a task still fit into a file's name."""


def parts_name(derivation: Derivation) -> str:
    """Return the parts of a robot, from the base outwards.

    Equal parts are counted, ``slides+5xbead+claw``, and those of a limb have its name,
    ``left-ur5+left-plane``. The base ``fixed`` is left out.
    """
    counts: Counter[str] = Counter()
    for node in derivation.walk():
        if node.part not in _UNNAMED:
            limb, _, kind = node.label.rpartition("_")
            counts[f"{limb}-{node.part}" if limb and kind in ("arm", "ee") else node.part] += 1
    words = [f"{n}x{part}" if n > 1 else part for part, n in counts.items()]
    return "+".join(words)[:_MAX_LENGTH] or derivation.part


def unique_names(derivations: Iterable[Derivation]) -> list[str]:
    """Return a name per robot; the second of a name ends in ``-2``, the third in ``-3``."""
    counts: Counter[str] = Counter()
    names: list[str] = []
    for derivation in derivations:
        name = parts_name(derivation)
        counts[name] += 1
        names.append(name if counts[name] == 1 else f"{name}-{counts[name]}")
    return names
