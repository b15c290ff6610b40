"""The tab of the compose page on which a grammar is edited and robots are sampled from it."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from pathlib import Path

import viser

from morphgen.errors import GrammarError
from morphgen.grammar.choosers import FirstChooser
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation, outline
from morphgen.grammar.derive import derive
from morphgen.grammar.grammar_file import (
    SUFFIX,
    Grammar,
    grammar_from_text,
    grammar_names,
    grammar_text,
)
from morphgen.grammar.sampling import sample_robot
from morphgen.model.robot import Robot
from morphgen.viewer import markup
from morphgen.viewer.address import Address, AddressError, pack_text, parse_count, unpack_text
from morphgen.viewer.part_choice import first_parts
from morphgen.viewer.robot_uri import DERIVATION, resolve_grammar
from morphgen.viewer.session import Session, set_value

ShowRobot = Callable[[Robot, Derivation, str, str], None]
"""Shows a robot, given its derivation, the command that makes it, and its URI."""


@dataclass(eq=False)
class GrammarTab:
    """Controls of the grammar tab in one browser."""

    session: Session
    show_robot: ShowRobot
    source: str
    """Name or file of the grammar."""
    original: str
    """Text of the grammar before it was edited."""
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

    @property
    def name(self) -> str:
        """Name of the grammar, from which its robots get theirs."""
        return Path(self.source).stem if self.source.endswith(SUFFIX) else self.source

    @property
    def is_edited(self) -> bool:
        """Whether the text differs from the grammar's own."""
        return self.text.value != self.original


def add_grammar_tab(
    session: Session,
    tabs: viser.GuiTabGroupHandle,
    grammar: Grammar,
    source: str,
    show_robot: ShowRobot,
) -> GrammarTab:
    """Add the tab, with the text, seed and number that the page's address gives.

    Args:
        session: The browser.
        tabs: Group to which the tab is added.
        grammar: The grammar.
        source: Name or file of the grammar.
        show_robot: Shows a robot on the page.

    Raises:
        AddressError: If the text in the address is invalid.
    """
    gui, state = session.client.gui, session.address.state
    original = grammar_text(grammar)
    names = tuple(dict.fromkeys((source, *grammar_names())))

    def count(key: str) -> int:
        return parse_count(state.get(key, ""), 0)

    with tabs.add_tab("Grammar", viser.Icon.BINARY_TREE):
        dropdown = gui.add_dropdown("start from", names, initial_value=source)
        text = unpack_text(state["text"]) if "text" in state else original
        text_field = gui.add_text("text", text, multiline=True)
        fault, too_long = gui.add_html(""), gui.add_html("")
        seed = gui.add_number("seed", count("seed"), min=0, step=1)
        number = gui.add_number("robot number", count("number"), min=0, step=1)
        buttons = gui.add_button_group("draw", ("typical", "this", "next"))
        num_parts = gui.add_slider(
            "parts shown", 1, 2, 1, 1, hint="how much of the derivation is shown"
        )
        tree = gui.add_html("")
    tab = GrammarTab(
        session,
        show_robot,
        source,
        original,
        text_field,
        fault,
        too_long,
        seed,
        number,
        num_parts,
        tree,
    )
    session.on_change(dropdown, lambda: _load(tab, dropdown.value))
    session.on_change(text_field, lambda: _check_edited(tab), "grammar")
    session.on_change(buttons, lambda: _draw(tab, buttons.value))
    session.on_change(num_parts, lambda: _show_parts(tab), "parts")
    return tab


def show_grammar(tab: GrammarTab, *, drawn: bool) -> None:
    """Show a robot of the edited grammar: sampled by seed and number, or the typical one."""
    session, library = tab.session, tab.session.files.library
    if not _check_grammar(tab):
        return
    grammar = grammar_from_text(tab.text.value, tab.name)
    name = shlex.quote(f"{tab.name}{SUFFIX}" if tab.is_edited else tab.source)
    note = f"# with the text of the tab Grammar in {name}\n" if tab.is_edited else ""
    command = f"{note}morphgen compose {name}"
    state = {}
    if drawn:
        seed, number = tab.seed.value, tab.number.value
        session.set_status(f"drawing robot {number} of seed {seed}")
        sample = sample_robot(grammar, library, number, seed=seed)
        session.set_status("")
        robot, tab.derivation = sample.robot, sample.derivation
        command = f"{note}morphgen sample {name} -n {number + 1} --seed {seed}"
        state = {"seed": str(seed), "number": str(number)}
    else:
        tab.derivation = derive(grammar, library, FirstChooser())
        robot = compose(tab.derivation, library, tab.name)
    n = sum(1 for _ in tab.derivation.walk())
    tab.num_parts.max = max(n, 2)  # a slider needs a range
    set_value(tab.num_parts, n)
    _update_address(tab, state)
    _show_tree(tab, tab.derivation, n)
    tab.show_robot(robot, tab.derivation, command, f"{DERIVATION}{tab.derivation}")


def _load(tab: GrammarTab, source: str) -> None:
    """Replace the text by that of another grammar, and show its typical robot."""
    tab.source = source
    tab.original = grammar_text(resolve_grammar(source, tab.session.files))
    set_value(tab.text, tab.original)
    show_grammar(tab, drawn=False)


def _check_edited(tab: GrammarTab) -> None:
    """Check the edited text, and keep it in the address."""
    _update_address(tab, {})
    _check_grammar(tab)


def _update_address(tab: GrammarTab, state: dict[str, str]) -> None:
    """Show grammar, state and edited text in the address; say if the text is too long for it."""
    tab.too_long.content = ""
    if tab.is_edited:
        try:
            state = state | {"text": pack_text(tab.text.value)}
        except AddressError as error:
            tab.too_long.content = markup.framed(markup.dim(str(error)))
    tab.session.address = Address("compose", (tab.source,), state)
    tab.session.show_address(f"compose {tab.source}")


def _check_grammar(tab: GrammarTab) -> bool:
    """Return whether the text is a grammar that derives a robot; show the error if not."""
    try:
        grammar = grammar_from_text(tab.text.value, tab.name)
        derive(grammar, tab.session.files.library, FirstChooser())
    except GrammarError as error:
        tab.fault.content = markup.error(tab.session.files.redact(error))
        return False
    tab.fault.content = ""
    return True


def _draw(tab: GrammarTab, action: str) -> None:
    """Show the ``typical`` robot, ``this`` sampled one, or the ``next``."""
    if action == "next":
        set_value(tab.number, tab.number.value + 1)
    show_grammar(tab, drawn=action != "typical")


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
