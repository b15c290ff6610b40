"""A grammar around one robot: distributions about its parameters, and other parts for its own."""

from __future__ import annotations

from dataclasses import dataclass, field

from morphgen.formats.rounding import format_number
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import DEFAULT_PORTS
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Manifest
from morphgen.grammar.parameters import MOUNT_YAW, Parameter
from morphgen.grammar.part import load_part

_SHARE_OF_RANGE, _SHARE_OF_VALUE = 0.15, 0.3
"""Standard deviation of a parameter: the smaller of these shares; tuned by eye."""
_REPLACED = ("arm", "ee")
"""Kinds of parts that may be replaced by others of the same kind and ports."""
_NO_PART = "none"


@dataclass(eq=False)
class _Writer:
    """Productions of the grammar that is being written."""

    library: Library
    productions: dict[str, str] = field(default_factory=dict)
    """Right sides by symbol."""

    def add(self, name: str, right: str) -> str:
        """Add a production; return its symbol, which is the name or, if taken, a similar one."""
        symbol, k = name, 1
        while self.productions.get(symbol, right) != right or symbol in self.library.names():
            k += 1
            symbol = f"{name}{k}"
        self.productions[symbol] = right
        return symbol


def grammar_around(derivation: Derivation, library: Library) -> str:
    """Return the text of a grammar whose typical robot is that of a derivation.

    Parameters have normal distributions about their values within their limits. Arms and
    end-effectors have those of the library with the same ports as alternatives.
    """
    writer = _Writer(library, {"robot": ""})
    writer.productions["robot"] = " ".join(_sequence(writer, derivation, "", is_root=True))
    return "".join(f"{symbol} -> {right}\n" for symbol, right in writer.productions.items())


def _sequence(
    writer: _Writer, node: Derivation, prefix: str, *, is_root: bool = False
) -> list[str]:
    """Return the items that stand for a part and everything attached to it.

    Args:
        writer: Gets the productions of the symbols.
        node: The part.
        prefix: Beginning of its label that the grammar adds for its port.
        is_root: Whether it is attached to no other part.
    """
    manifest = writer.library.manifest(node.part)
    alternatives = _alternatives(node, manifest, writer.library, is_root=is_root)
    items = [writer.add(node.label.removeprefix(prefix), "\n  | ".join(alternatives))]
    main = next((port for port in DEFAULT_PORTS if port in manifest.ports), "")
    trunk: list[str] = []
    for port, child in node.children:
        if port == main:
            trunk = _sequence(writer, child, prefix)
            continue
        limb = _sequence(writer, child, f"{prefix}{port}_")
        item = limb[0] if len(limb) == 1 else writer.add(f"{port}_limb", " ".join(limb))
        items.append(f"{port}:{item}")
    return items + trunk


def _alternatives(
    node: Derivation, manifest: Manifest, library: Library, *, is_root: bool
) -> list[str]:
    """Return a part with distributions about its parameters, and the parts that may replace it."""
    values = dict(node.parameters)
    parameters = {
        name: parameter
        for name, parameter in manifest.parameters.items()
        if not is_root or _has_effect(node, manifest, name, parameter)
    }
    arguments = {name: _distribution(values[name], p) for name, p in parameters.items()}
    arguments |= {
        name: format_number(value)
        for name, value in values.items()
        if name not in arguments and (name == MOUNT_YAW or name in manifest.parameters)
    }
    alternatives = [_item(node.part, arguments)]
    if is_root or manifest.kind not in _REPLACED or node.part == _NO_PART:
        return alternatives
    for other in library.manifests():
        is_fitting = other.kind == manifest.kind and {*other.ports} == {*manifest.ports}
        if is_fitting and other.name not in (node.part, _NO_PART):
            alternatives.append(
                _item(
                    other.name,
                    {name: _distribution(p.default, p) for name, p in other.parameters.items()},
                )
            )
    return alternatives


def _has_effect(node: Derivation, manifest: Manifest, name: str, parameter: Parameter) -> bool:
    """Return whether a parameter changes the part, or a port to which something is attached."""
    values = dict(node.parameters)
    low, high = (
        load_part(manifest, {**values, name: value})
        for value in (parameter.minimum, parameter.maximum)
    )
    shapes = [(part.fragment.links, part.fragment.joints) for part in (low, high)]
    used = [port for port, _ in node.children]
    return shapes[0] != shapes[1] or any(low.ports[port] != high.ports[port] for port in used)


def _distribution(value: float, parameter: Parameter) -> str:
    """Return a distribution about a value, or the value if the parameter has no other one."""
    low, high = parameter.minimum, parameter.maximum
    if low == high:
        return format_number(value)
    if parameter.integer:
        others = [n for n in range(round(low), round(high) + 1) if abs(n - value) in (1, 2)]
        return f"choice({', '.join(map(format_number, (value, *others)))})"
    deviation = _SHARE_OF_RANGE * (high - low)
    if value:
        deviation = min(deviation, _SHARE_OF_VALUE * abs(value))
    numbers = (value, float(f"{deviation:.3g}"), low, high)
    return f"normal({', '.join(map(format_number, numbers))})"


def _item(part: str, arguments: dict[str, str]) -> str:
    texts = ", ".join(f"{name}={text}" for name, text in arguments.items())
    return f"{part}({texts})" if texts else part
