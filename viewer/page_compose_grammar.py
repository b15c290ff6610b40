"""The tab of the compose page on which a grammar is edited and robots are sampled from it."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Literal

import viser

from morphgen.errors import MorphgenError
from morphgen.grammar.choosers import Choices
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation, outline, parse_derivation
from morphgen.grammar.grammar_file import (
    SUFFIX,
    Grammar,
    grammar_from_text,
    grammar_names,
    grammar_text,
)
from morphgen.grammar.request import default_name
from morphgen.grammar.sampling import sample_robot
from morphgen.model.robot import Robot
from morphgen.viewer import markup
from morphgen.viewer.address import Address, AddressError, pack_text, parse_count, unpack_text
from morphgen.viewer.derivation_grammar import grammar_around
from morphgen.viewer.evolution import Individual, make_individual, pack_choices, unpack_choices
from morphgen.viewer.frame import call
from morphgen.viewer.part_choice import first_parts
from morphgen.viewer.robot_uri import DERIVATION, FileAccess, resolve_grammar, resolve_words
from morphgen.viewer.session import Session, set_value

Mode = Literal["typical", "drawn", "chosen"]
"""The typical robot, one that is drawn by seed and number, or the one that choices give."""
_PLACE = re.compile(r"(?P<origin>[^\s:]+):(?P<line>\d+):(?P<column>\d+): ")
"""Beginning of an error that names a place in a grammar."""
ShowRobot = Callable[[Robot, Derivation, str, str], None]
"""Shows a robot, given its derivation, the command that makes it, and its URI."""


@dataclass(eq=False)
class GrammarTab:
    """Controls of the grammar tab in one browser."""

    session: Session
    show_robot: ShowRobot
    source: str
    """Name or file of the grammar, or the robot that it is around; see ``source_text``."""
    name: str
    """Name of the grammar, from which its robots get theirs."""
    original: str
    """Text of the grammar before it was edited."""
    start: viser.GuiDropdownHandle[str]
    """Grammars to start from."""
    text: viser.GuiTextHandle
    fault: viser.GuiHtmlHandle
    too_long: viser.GuiHtmlHandle
    """Message that the edited text does not fit into the address; else empty."""
    seed: viser.GuiNumberHandle[int]
    number: viser.GuiNumberHandle[int]
    num_parts: viser.GuiSliderHandle[int]
    tree: viser.GuiHtmlHandle
    derivation: Derivation | None = None
    """Derivation of the whole robot; fewer of its parts may be shown."""
    choices: Choices = field(default_factory=dict)
    """Choices that gave the robot."""
    mode: Mode = "typical"
    """Which robot of the grammar is shown."""
    on_shown: Callable[[Individual], object] | None = None
    """Called after a whole robot of the grammar was shown."""

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
    """Add the tab, with the text, seed and number that the page's address gives.

    Args:
        session: The browser.
        tabs: Group to which the tab is added.
        source: Source of the grammar; see ``source_text``.
        show_robot: Shows a robot on the page.

    Raises:
        AddressError: If the text in the address is invalid.
        MorphgenError: If there is no such grammar or robot.
    """
    gui, state = session.client.gui, session.address.state
    name, original = source_text(source, session.files)
    names = _starts(source)

    def count(key: str) -> int:
        return parse_count(state.get(key, ""), 0)

    with tabs.add_tab("Grammar", viser.Icon.BINARY_TREE):
        dropdown = gui.add_dropdown("start from", names, initial_value=source)
        text = unpack_text(state["text"]) if "text" in state else original
        text_field = gui.add_text("grammar", text, multiline=True)
        fault, too_long = gui.add_html(""), gui.add_html("")
        seed = gui.add_number("seed", count("seed"), min=0, step=1)
        number = gui.add_number("robot number", count("number"), min=0, step=1)
        buttons = gui.add_button_group("robot", ("typical", "this", "next"))
        num_parts = gui.add_slider(
            "parts shown", 1, 2, 1, 1, hint="how much of the derivation is shown"
        )
        tree = gui.add_html("")
    tab = GrammarTab(
        session,
        show_robot,
        source,
        name,
        original,
        dropdown,
        text_field,
        fault,
        too_long,
        seed,
        number,
        num_parts,
        tree,
    )
    if "choices" in state:
        tab.choices, tab.mode = unpack_choices(state["choices"]), "chosen"
    elif "number" in state:
        tab.mode = "drawn"
    session.on_change(dropdown, lambda: load_source(tab, dropdown.value))
    session.on_change(text_field, lambda: show_grammar(tab, tab.mode), "grammar")
    session.on_change(buttons, lambda: _draw(tab, buttons.value))
    session.on_change(num_parts, lambda: _show_parts(tab), "parts")
    return tab


def source_text(source: str, files: FileAccess) -> tuple[str, str]:
    """Return the name and the text of a grammar.

    Args:
        source: Name or file of a grammar, or words or a URI of a robot for ``grammar_around``.
        files: Files that the page may read.

    Raises:
        MorphgenError: If there is no such grammar or robot.
    """
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
    """Return the grammar of the text.

    Raises:
        GrammarError: If it is invalid.
    """
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
        session.set_status("")
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
    """Return the robot of the tab's mode, the command that makes it, and its address's state.

    Raises:
        MorphgenError: If the grammar gives no such robot.
    """
    session, library = tab.session, tab.session.files.library
    is_text = tab.is_edited or is_robot(tab.source)
    name = shlex.quote(f"{tab.name}{SUFFIX}" if is_text else tab.source)
    note = f"# with the text of the tab Grammar in {name}\n" if is_text else ""
    if tab.mode == "drawn":
        seed, number = tab.seed.value, tab.number.value
        session.set_status(f"drawing robot {number} of seed {seed}")
        sample = sample_robot(grammar, library, number, seed=seed)
        session.set_status("")
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
    """Replace the text by that of another grammar, and show its typical robot.

    Raises:
        MorphgenError: If there is no such grammar or robot; see ``source_text``.
    """
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
