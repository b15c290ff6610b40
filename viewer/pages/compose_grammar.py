"""The tab of the compose page on which a grammar is edited and robots are sampled from it."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, field, replace
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
ShowRobot = Callable[[Robot, Derivation, str, str], None]  # gets command and URI, too


@dataclass(eq=False)
class GrammarTab:
    """Controls of the grammar tab in one browser."""

    session: Session
    show_robot: ShowRobot
    source: str  # name or file of the grammar, or the robot that it is around; see `source_text`
    name: str  # name of the grammar, from which its robots get theirs
    original: str  # text of the grammar before it was edited
    start: viser.GuiDropdownHandle[str]  # grammars to start from
    text: viser.GuiTextHandle
    fault: viser.GuiHtmlHandle
    too_long: viser.GuiHtmlHandle  # says that an address cannot hold the text, or empty
    seed: viser.GuiNumberHandle[int]
    number: viser.GuiNumberHandle[int]
    num_parts: viser.GuiSliderHandle[int] = field(init=False)
    tree: viser.GuiHtmlHandle = field(init=False)
    derivation: Derivation | None = None  # the whole robot's; fewer parts may be shown
    choices: Choices = field(default_factory=dict)  # choices that gave the robot
    mode: Mode = "typical"  # which robot of the grammar is shown
    on_shown: Callable[[Individual], object] | None = None  # called with a whole robot

    @property
    def is_edited(self) -> bool:
        """Whether the text differs from the grammar's own."""
        return self.text.value != self.original


def add_grammar_tab(
    session: Session,
    tabs: viser.GuiTabGroupHandle,
    source: str,
    show_robot: ShowRobot,
) -> GrammarTab:
    """Add the tab, with the text, seed and number that the page's address gives."""
    gui, state = session.client.gui, session.address.state
    name, original = source_text(source, session.files)
    text = unpack_text(state["text"]) if "text" in state else original
    with tabs.add_tab("Grammar", viser.Icon.BINARY_TREE):
        tab = GrammarTab(
            session,
            show_robot,
            source,
            name,
            original,
            gui.add_dropdown("start from", _starts(source), initial_value=source),
            gui.add_text("grammar", text, multiline=True),
            gui.add_html(""),
            gui.add_html(""),
            gui.add_number("seed", parse_count(state.get("seed", ""), 0), min=0, step=1),
            gui.add_number("robot number", parse_count(state.get("number", ""), 0), min=0, step=1),
        )
        buttons = gui.add_button_group("robot", ("typical", "this", "next"))
        hint = "how much of the derivation is shown"
        tab.num_parts = gui.add_slider("parts shown", 1, 2, 1, 1, hint=hint)
        tab.tree = gui.add_html("")
    if "choices" in state:
        tab.choices, tab.mode = unpack_choices(state["choices"]), "chosen"
    elif "number" in state:
        tab.mode = "drawn"
    session.on_change(tab.start, lambda: load_source(tab, tab.start.value))
    session.on_change(tab.text, lambda: show_grammar(tab, tab.mode), "grammar")
    session.on_change(buttons, lambda: _draw(tab, buttons.value))
    session.on_change(tab.num_parts, lambda: _show_parts(tab), "parts")
    return tab


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


def edited_grammar(tab: GrammarTab) -> Grammar:
    """Return the grammar of the text."""
    return grammar_from_text(tab.text.value, tab.name)


def show_grammar(tab: GrammarTab, mode: Mode) -> None:
    """Show a robot of the edited grammar, or what is wrong with the text; then the last stays."""
    session = tab.session
    tab.mode = mode
    try:
        grammar = edited_grammar(tab)
        typical = make_individual(grammar, session.files.library, {}, tab.name)
        individual, command, state = _make_robot(tab, grammar, typical)
    except (MorphgenError, RecursionError) as error:
        _update_address(tab, {})
        _show_fault(tab, error)
        return
    tab.choices, tab.derivation = individual.choices, individual.derivation
    n = sum(1 for _ in tab.derivation.walk())
    tab.num_parts.max = max(n, 2)  # a slider needs a range
    set_value(tab.num_parts, n)
    _update_address(tab, state)
    _show_tree(tab, tab.derivation, n)
    tab.show_robot(individual.robot, tab.derivation, command, f"{DERIVATION}{tab.derivation}")
    _show_fault(tab, None)
    if tab.on_shown is not None:
        tab.on_shown(individual)


def _make_robot(
    tab: GrammarTab, grammar: Grammar, typical: Individual
) -> tuple[Individual, str, dict[str, str]]:
    """Return the robot of the tab's mode, the command that makes it, and its address's state."""
    session, library = tab.session, tab.session.files.library
    is_text = tab.is_edited or is_robot(tab.source)
    name = shlex.quote(f"{tab.name}{SUFFIX}" if is_text else tab.source)
    note = f"# with the text of the tab Grammar in {name}\n" if is_text else ""
    if tab.mode == "drawn":
        seed, number = tab.seed.value, tab.number.value
        with session.activity(f"drawing robot {number} of seed {seed}"):
            sample = sample_robot(grammar, library, number, seed=seed)
        command = f"{note}morphgen sample {name} -n {number + 1} --seed {seed}"
        individual = Individual(sample.robot, sample.derivation, sample.choices)
        return individual, command, {"seed": str(seed), "number": str(number)}
    if tab.mode == "typical":
        return typical, f"{note}morphgen compose {name}", {}
    individual = make_individual(grammar, library, tab.choices)
    state = {"choices": pack_choices(individual.choices)}
    return individual, f"# {individual.derivation}", state


def _starts(source: str) -> tuple[str, ...]:
    """Return the grammars to start from: the present one, and all that have a name."""
    return tuple(dict.fromkeys((source, *grammar_names())))


def load_source(tab: GrammarTab, source: str) -> None:
    """Replace the text by that of another grammar, and show its typical robot."""
    tab.name, tab.original = source_text(source, tab.session.files)
    tab.source = source
    tab.start.options = _starts(source)
    set_value(tab.start, source)
    set_value(tab.text, tab.original)
    show_grammar(tab, "typical")


def _update_address(tab: GrammarTab, state: dict[str, str]) -> None:
    """Show grammar, state and edited text in the address; say if the text is too long for it."""
    tab.too_long.content = ""
    if tab.is_edited:
        try:
            state = state | {"text": pack_text(tab.text.value)}
        except AddressError as error:
            tab.too_long.content = markup.framed(markup.dim(str(error)))
            state = {}  # without the text it would name another robot
    tab.session.address = Address("compose", (tab.source,), state)
    tab.session.show_address(f"compose {tab.source}")


def _show_fault(tab: GrammarTab, error: Exception | None) -> None:
    """Show what is wrong with the grammar, below the text and at its place in the text."""
    text = "" if error is None else tab.session.files.redact(error)
    tab.fault.content = markup.error(text) if text else ""
    place = _PLACE.match(text)
    is_here = place is not None and place["origin"] == tab.name
    line, column = (int(place["line"]), int(place["column"])) if place and is_here else (0, 0)
    tab.session.run_script(call("mark", line, column))


def _draw(tab: GrammarTab, action: str) -> None:
    """Show the ``typical`` robot, ``this`` sampled one, or the ``next``."""
    if action == "next":
        set_value(tab.number, tab.number.value + 1)
    show_grammar(tab, "typical" if action == "typical" else "drawn")


def first_parts(derivation: Derivation, n: int) -> Derivation:
    """Return a derivation of only the first ``n`` parts (at least 1), in order of attachment."""
    kept_ids = {id(node) for node in list(derivation.walk())[: max(n, 1)]}

    def prune(node: Derivation) -> Derivation:
        children = ((port, prune(child)) for port, child in node.children if id(child) in kept_ids)
        return replace(node, children=tuple(children))

    return prune(derivation)


def _show_parts(tab: GrammarTab) -> None:
    """Show the robot with the number of parts that the slider gives."""
    if tab.derivation is None:
        return
    n = tab.num_parts.value
    partial = first_parts(tab.derivation, n)
    _show_tree(tab, tab.derivation, n)
    robot = compose(partial, tab.session.files.library, tab.name)
    tab.show_robot(robot, partial, f"# {partial}", f"{DERIVATION}{partial}")


def _show_tree(tab: GrammarTab, derivation: Derivation, n: int) -> None:
    """Show the derivation as a tree; parts beyond the first ``n`` are grey."""
    lines = [escape(line) for line in outline(derivation).splitlines()]
    lines[n:] = [f'<span class="dim">{line}</span>' for line in lines[n:]]
    tab.tree.content = markup.framed(f"<h3>Derivation</h3><pre>{'<br>'.join(lines)}</pre>")
