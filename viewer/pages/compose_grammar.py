"""The tab of the compose page on which a grammar is edited and robots are sampled from it."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Literal

import viser

from morphgen.errors import MorphgenError
from morphgen.formats.rounding import format_number, round_number
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation, difference, outline, parse_derivation
from morphgen.grammar.derive import DEFAULT_PORTS, Choices, FirstChooser, RecordedChooser, derive
from morphgen.grammar.grammar_file import (
    SUFFIX,
    Grammar,
    grammar_from_text,
    grammar_names,
    grammar_text,
)
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import MOUNT_YAW, Manifest, Parameter
from morphgen.grammar.part import load_part
from morphgen.grammar.request import default_name
from morphgen.grammar.sampling import mutate, sample_robot
from morphgen.model.robot import Robot
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address, AddressError, pack_text, parse_count, unpack_text
from morphgen.viewer.app.frame import call
from morphgen.viewer.app.session import Session, set_value
from morphgen.viewer.pages.compose_parts import Shown, ShowRobot
from morphgen.viewer.robot_uri import DERIVATION, FileAccess, resolve_grammar, resolve_words

_SHARE_OF_RANGE, _SHARE_OF_VALUE = 0.15, 0.3  # deviation: the smaller one; tuned by eye
_REPLACED = ("arm", "ee")  # kinds of parts that may be replaced by others with the same ports
_NO_PART = "none"


def grammar_around(derivation: Derivation, library: Library) -> str:
    """Return the text of a grammar whose typical robot is that of a derivation.

    Parameters have normal distributions about their values within their limits. Arms and
    end-effectors have those of the library with the same ports as alternatives.
    """
    productions = {"robot": ""}

    def add(name: str, right: str) -> str:
        """Add a production; return its symbol: the name, or a similar one if it is taken."""
        symbol, k = name, 1
        while productions.get(symbol, right) != right or symbol in library.names():
            k += 1
            symbol = f"{name}{k}"
        productions[symbol] = right
        return symbol

    def sequence(node: Derivation, prefix: str) -> list[str]:
        """Return the items that stand for a part and everything attached to it."""
        alternatives = _alternatives(node, library, is_root=node is derivation)
        items, trunk = [add(node.label.removeprefix(prefix), "\n  | ".join(alternatives))], []
        ports = library.manifest(node.part).ports
        main = next((port for port in DEFAULT_PORTS if port in ports), "")
        for port, child in node.children:
            if port == main:
                trunk = sequence(child, prefix)
                continue
            limb = sequence(child, f"{prefix}{port}_")
            item = limb[0] if len(limb) == 1 else add(f"{port}_limb", " ".join(limb))
            items.append(f"{port}:{item}")
        return items + trunk

    productions["robot"] = " ".join(sequence(derivation, ""))
    return "".join(f"{symbol} -> {right}\n" for symbol, right in productions.items())


def _alternatives(node: Derivation, library: Library, *, is_root: bool) -> list[str]:
    """Return a part with distributions about its parameters, and the parts that may replace it."""
    manifest, values = library.manifest(node.part), dict(node.parameters)
    arguments = {
        name: _distribution(values[name], parameter)
        for name, parameter in manifest.parameters.items()
        # Parameters of a base often concern only ports that are free, such as their distance.
        if not is_root or _has_effect(node, manifest, name, parameter)
    }
    arguments |= {
        name: format_number(value)
        for name, value in values.items()
        if name not in arguments and (name == MOUNT_YAW or name in manifest.parameters)
    }
    items = [_item(node.part, arguments)]
    if not is_root and manifest.kind in _REPLACED and node.part != _NO_PART:
        for other in library.manifests(manifest.kind):
            if {*other.ports} == {*manifest.ports} and other.name not in (node.part, _NO_PART):
                typical = {
                    name: _distribution(p.default, p) for name, p in other.parameters.items()
                }
                items.append(_item(other.name, typical))
    return items


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


NUM_OFFSPRING = 9  # mutants of a generation


@dataclass(frozen=True, eq=False)
class Individual:
    """A robot of a grammar with the choices that gave it."""

    robot: Robot
    derivation: Derivation
    choices: Choices


def make_individual(
    grammar: Grammar, library: Library, choices: Choices, name: str = ""
) -> Individual:
    """Return the robot that choices give; choices that are missing are typical ones."""
    chooser = RecordedChooser(FirstChooser(), choices)
    derivation = derive(grammar, library, chooser)
    robot = compose(derivation, library, name or individual_name(grammar, derivation))
    return Individual(robot, derivation, dict(chooser.choices))


def individual_name(grammar: Grammar, derivation: Derivation) -> str:
    """Return the name of an individual, the same for the same derivation."""
    return f"{grammar.name}-{derivation.digest[:8]}"


def mutants(
    grammar: Grammar, folders: tuple[Path, ...], parent: Choices, seed: int
) -> list[Individual]:
    """Return robots that differ from the parent in one choice. Runs in a worker."""
    samples = mutate(grammar, Library(folders), parent, NUM_OFFSPRING, seed=seed, name=grammar.name)
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
    """Return choices as text for an address."""
    rounded = {key: round_number(value) for key, value in choices.items()}
    return pack_text(json.dumps(rounded, separators=(",", ":")))


def unpack_choices(text: str) -> Choices:
    """Return the choices that ``pack_choices`` has packed."""
    try:
        choices = json.loads(unpack_text(text))
    except (ValueError, RecursionError) as error:
        raise AddressError(f"the address has no readable choices: {error}") from error
    if not isinstance(choices, dict) or not all(
        isinstance(value, int | float) and math.isfinite(value) for value in choices.values()
    ):
        raise AddressError("the address has no readable choices: expected a number by each key")
    return choices


Mode = Literal["typical", "drawn", "chosen"]
"""The typical robot, one that is drawn by seed and number, or the one that choices give."""
_PLACE = re.compile(r"(?P<origin>[^\s:]+):(?P<line>\d+):(?P<column>\d+): ")
"""Beginning of an error that names a place in a grammar."""


class GrammarTab:
    """The tab of a grammar's text, from which robots are drawn."""

    def __init__(
        self, session: Session, tabs: viser.GuiTabGroupHandle, source: str, show_robot: ShowRobot
    ) -> None:
        """Add the tab, with the text, seed and number that the page's address gives.

        source: Name or file of the grammar, or the robot that it is around; see ``source_text``.
        """
        gui, state = session.client.gui, session.address.state
        self._session, self._show_robot, self._source = session, show_robot, source
        self._name, self._original = source_text(source, session.files)
        self._derivation: Derivation | None = None  # the whole robot's; fewer parts may be shown
        self._state: Mapping[str, str] = {}  # state of the address
        self.choices: Choices = {}  # choices that gave the robot
        self.mode: Mode = "typical"
        if "choices" in state:
            self.choices, self.mode = unpack_choices(state["choices"]), "chosen"
        elif "number" in state:
            self.mode = "drawn"
        seed, number = (parse_count(state.get(key, ""), 0) for key in ("seed", "number"))
        text = unpack_text(state["text"]) if "text" in state else self._original
        with tabs.add_tab("Grammar", viser.Icon.BINARY_TREE):
            self._start = gui.add_dropdown("start from", _starts(source), initial_value=source)
            self._text = gui.add_text("grammar", text, multiline=True)
            save = gui.add_button("Save the grammar", icon=viser.Icon.DOWNLOAD)
            self._fault = gui.add_html("")
            self._too_long = gui.add_html("")
            self._seed = gui.add_number("seed", seed, min=0, step=1)
            self._number = gui.add_number("robot number", number, min=0, step=1)
            buttons = gui.add_button_group("robot", ("typical", "this", "next"))
            hint = "how much of the derivation is shown"
            self._num_parts = gui.add_slider("parts shown", 1, 2, 1, 1, hint=hint)
            self._tree = gui.add_html("")
        session.on_change(self._start, lambda: self.load(self._start.value))
        session.on_change(self._text, self.show, "grammar")
        session.on_change(buttons, lambda: self._draw(buttons.value))
        session.on_change(save, self._send)
        for field in (self._seed, self._number):
            session.on_change(field, lambda: self.show("drawn"), "number")
        session.on_change(self._num_parts, self._show_parts, "parts")

    @property
    def grammar(self) -> Grammar:
        """The grammar of the text."""
        return grammar_from_text(self._text.value, self._name)

    def load(self, source: str) -> None:
        """Replace the text by that of another grammar, and show its typical robot."""
        self._name, self._original = source_text(source, self._session.files)
        self._source = source
        self._start.options = _starts(source)
        set_value(self._start, source)
        set_value(self._text, self._original)
        self.show("typical")

    def show(self, mode: Mode | None = None) -> None:
        """Show a robot of the text, or what is wrong with the text; then the last robot stays.

        mode: Which robot; by default the present mode.
        """
        self.mode, self._too_long.content = mode or self.mode, ""
        text: dict[str, str] = {}
        if self._text.value != self._original:
            try:
                text["text"] = pack_text(self._text.value)
            except AddressError as error:
                self._too_long.content = markup.framed(markup.dim(str(error)))
        try:
            individual, command, state = self._make_robot()
        except (MorphgenError, RecursionError) as error:
            self._session.address = Address("compose", (self._source,), text)
            self._session.show_address(f"compose {self._source}")
            self._show_fault(error)
            return
        # Without a text that is too long for it, the address would name another robot.
        self._state = {} if self._too_long.content else state | text
        self.choices, self._derivation = individual.choices, individual.derivation
        n = sum(1 for _ in individual.derivation.walk())
        self._num_parts.max = max(n, 2)  # a slider needs a range
        set_value(self._num_parts, n)
        self._show_tree(individual.derivation, n)
        self._show(individual.robot, individual.derivation, command, individual.choices)
        self._show_fault(None)

    def _show(
        self, robot: Robot, derivation: Derivation, command: str, choices: Choices | None
    ) -> None:
        uri = f"{DERIVATION}{derivation}"
        self._show_robot(Shown(robot, derivation, command, uri, self._source, self._state, choices))

    def _make_robot(self) -> tuple[Individual, str, dict[str, str]]:
        """Return the robot of the mode, the command that makes it, and its address's state."""
        session, library, grammar = self._session, self._session.files.library, self.grammar
        typical = make_individual(grammar, library, {}, self._name)  # also checks the grammar
        is_text = self._text.value != self._original or is_robot(self._source)
        name = shlex.quote(f"{self._name}{SUFFIX}" if is_text else self._source)
        note = f"# with the text of the tab Grammar in {name}\n" if is_text else ""
        if self.mode == "drawn":
            seed, number = self._seed.value, self._number.value
            with session.activity(f"drawing robot {number} of seed {seed}"):
                sample = sample_robot(grammar, library, number, seed=seed)
            command = f"{note}morphgen sample {name} -n {number + 1} --seed {seed}"
            individual = Individual(sample.robot, sample.derivation, sample.choices)
            return individual, command, {"seed": str(seed), "number": str(number)}
        if self.mode == "typical":
            return typical, f"{note}morphgen compose {name}", {}
        individual = make_individual(grammar, library, self.choices)
        state = {"choices": pack_choices(individual.choices)}
        return individual, f"# {individual.derivation}", state

    def _show_fault(self, error: Exception | None) -> None:
        """Show what is wrong with the grammar, below the text and at its place in the text."""
        text = "" if error is None else self._session.files.redact(error)
        self._fault.content = markup.error(text) if text else ""
        place = _PLACE.match(text)
        is_here = place is not None and place["origin"] == self._name
        line, column = (int(place["line"]), int(place["column"])) if place and is_here else (0, 0)
        self._session.run_script(call("mark", line, column))

    def _send(self) -> None:
        """Let the browser save the text as a file."""
        self._session.send_file(f"{self._name}{SUFFIX}", self._text.value.encode())

    def _draw(self, action: str) -> None:
        """Show the ``typical`` robot, ``this`` sampled one, or the ``next``."""
        if action == "next":
            set_value(self._number, self._number.value + 1)
        self.show("typical" if action == "typical" else "drawn")

    def _show_parts(self) -> None:
        """Show the robot with the number of parts that the slider gives."""
        if self._derivation is None:
            return
        partial = first_parts(self._derivation, self._num_parts.value)
        self._show_tree(self._derivation, self._num_parts.value)
        robot = compose(partial, self._session.files.library, self._name)
        self._show(robot, partial, f"# {partial}", None)

    def _show_tree(self, derivation: Derivation, n: int) -> None:
        """Show the derivation as a tree; parts beyond the first ``n`` are grey."""
        lines = [escape(line) for line in outline(derivation).splitlines()]
        lines[n:] = [f'<span class="dim">{line}</span>' for line in lines[n:]]
        self._tree.content = markup.framed(f"<h3>Derivation</h3><pre>{'<br>'.join(lines)}</pre>")


def source_text(source: str, files: FileAccess) -> tuple[str, str]:
    """Return the name and the text of a grammar."""
    if not is_robot(source):
        name = Path(source).stem if source.endswith(SUFFIX) else source
        return name, grammar_text(resolve_grammar(source, files))
    if source.startswith(DERIVATION):
        derivation = parse_derivation(source.removeprefix(DERIVATION))
        name = default_name(derivation, files.library)
    else:
        derivation, name = resolve_words(source, files)
    return name, grammar_around(derivation, files.library)


def is_robot(source: str) -> bool:
    """Return whether the source of a grammar is a robot."""
    return source.startswith(DERIVATION) or "=" in source.split()[0]


def _starts(source: str) -> tuple[str, ...]:
    """Return the grammars to start from: the present one, and all that have a name."""
    return tuple(dict.fromkeys((source, *grammar_names())))


def first_parts(derivation: Derivation, n: int) -> Derivation:
    """Return a derivation of only the first ``n`` parts (at least 1), in order of attachment."""
    kept_ids = {id(node) for node in list(derivation.walk())[: max(n, 1)]}

    def prune(node: Derivation) -> Derivation:
        children = ((port, prune(child)) for port, child in node.children if id(child) in kept_ids)
        return replace(node, children=tuple(children))

    return prune(derivation)
