"""The tab of the compose page on which a grammar is written, and robots are drawn from it."""

from __future__ import annotations

import shlex
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
from morphgen.viewer import markup
from morphgen.viewer.address import Address, AddressError, whole_number
from morphgen.viewer.choice import first_parts
from morphgen.viewer.composed import Composed, fault, show_robot
from morphgen.viewer.packed_text import packed, unpacked
from morphgen.viewer.robot_uri import DERIVED, resolve_grammar
from morphgen.viewer.session import say, set_value, show_state, when


@dataclass(eq=False)
class GrammarTab:
    """The tab in one browser."""

    composed: Composed
    grammar: str
    """The grammar in the text field, by its name or file."""
    original: str
    """Its text before it was edited."""
    text: viser.GuiTextHandle
    fault: viser.GuiHtmlHandle
    too_long: viser.GuiHtmlHandle
    seed: viser.GuiNumberHandle[int]
    number: viser.GuiNumberHandle[int]
    step: viser.GuiSliderHandle[int]
    tree: viser.GuiHtmlHandle
    derivation: Derivation | None = None
    """Of the whole robot; the one that is shown may have fewer parts."""

    @property
    def name(self) -> str:
        """Of the grammar, which robots get."""
        return Path(self.grammar).stem if self.grammar.endswith(SUFFIX) else self.grammar


def add_grammar_tab(
    composed: Composed, tabs: viser.GuiTabGroupHandle, grammar: Grammar, source: str
) -> GrammarTab:
    """Add the tab with a grammar, edited as the page's address has it; ``show_derived`` shows it.

    Args:
        composed: Where.
        tabs: Where the tab is added.
        grammar: What is written.
        source: The grammar's name or file, as the address has it.

    Raises:
        AddressError: If the address has no text.
    """
    session = composed.session
    gui, state = session.client.gui, session.address.state
    original = grammar_text(grammar)
    names = tuple(dict.fromkeys((source, *grammar_names())))
    with tabs.add_tab("Grammar", viser.Icon.BINARY_TREE):
        chosen = gui.add_dropdown("start from", names, initial_value=source)
        text = unpacked(state["text"]) if "text" in state else original
        written = gui.add_text("text", text, multiline=True)
        why_not, too_long = gui.add_html(""), gui.add_html("")
        seed = gui.add_number("seed", _count(state.get("seed", "")), min=0, step=1)
        number = gui.add_number("robot number", _count(state.get("number", "")), min=0, step=1)
        action = gui.add_button_group("draw", ("typical", "this", "next"))
        step = gui.add_slider("parts shown", 1, 2, 1, 1, hint="how far the derivation is shown")
        tree = gui.add_html("")
    tab = GrammarTab(
        composed,
        source,
        original,
        text=written,
        fault=why_not,
        too_long=too_long,
        seed=seed,
        number=number,
        step=step,
        tree=tree,
    )
    when(chosen, session, lambda: _load(tab, chosen.value))
    when(written, session, lambda: _edited(tab), "grammar")
    when(action, session, lambda: _draw(tab, action.value))
    when(step, session, lambda: _show_step(tab), "step")
    return tab


def show_derived(tab: GrammarTab, *, drawn: bool) -> None:
    """Show a robot of the grammar in the text field: a drawn one, or the typical one."""
    session, library = tab.composed.session, tab.composed.session.places.library
    if not _read_grammar(tab):
        return
    grammar = grammar_from_text(tab.text.value, tab.name)
    name = shlex.quote(f"{tab.name}{SUFFIX}" if _is_edited(tab) else tab.grammar)
    note = f"# with the text of the tab Grammar in {name}\n" if _is_edited(tab) else ""
    command = f"{note}morphgen compose {name}"
    if drawn:
        seed, number = tab.seed.value, tab.number.value
        say(session, f"drawing robot {number} of seed {seed}")
        sample = sample_robot(grammar, library, number, seed=seed)
        say(session, "")
        robot, tab.derivation = sample.robot, sample.derivation
        command = f"{note}morphgen sample {name} -n {number + 1} --seed {seed}"
    else:
        tab.derivation = derive(grammar, library, FirstChooser())
        robot = compose(tab.derivation, library, tab.name)
    n = sum(1 for _ in tab.derivation.walk())
    tab.step.max = max(n, 2)
    set_value(tab.step, n)
    state = {"seed": str(tab.seed.value), "number": str(tab.number.value)} if drawn else {}
    _show_address(tab, state)
    _show_tree(tab, tab.derivation, n)
    show_robot(tab.composed, robot, tab.derivation, command, f"{DERIVED}{tab.derivation}")


def _load(tab: GrammarTab, name: str) -> None:
    tab.grammar = name
    tab.original = grammar_text(resolve_grammar(name, tab.composed.session.places))
    set_value(tab.text, tab.original)
    show_derived(tab, drawn=False)


def _edited(tab: GrammarTab) -> None:
    """Check the text, and keep it in the address."""
    _show_address(tab, {})
    _read_grammar(tab)


def _show_address(tab: GrammarTab, state: dict[str, str]) -> None:
    session = tab.composed.session
    session.address = Address("compose", (tab.grammar,), state | _text_state(tab))
    show_state(session, f"compose {tab.grammar}")


def _text_state(tab: GrammarTab) -> dict[str, str]:
    """The text as the address keeps it, if it was edited and is not too long; else it is said."""
    tab.too_long.content = ""
    if not _is_edited(tab):
        return {}
    try:
        return {"text": packed(tab.text.value)}
    except AddressError as error:
        tab.too_long.content = markup.framed(f'<div class="dim">{error}</div>')
        return {}


def _is_edited(tab: GrammarTab) -> bool:
    return tab.text.value != tab.original


def _read_grammar(tab: GrammarTab) -> bool:
    """Say whether the text is a grammar that can be derived; if not, where it fails."""
    try:
        grammar = grammar_from_text(tab.text.value, tab.name)
        derive(grammar, tab.composed.session.places.library, FirstChooser())
    except GrammarError as error:
        tab.fault.content = fault(error, tab.composed.session.places)
        return False
    tab.fault.content = ""
    return True


def _draw(tab: GrammarTab, what: str) -> None:
    if what == "next":
        set_value(tab.number, tab.number.value + 1)
    show_derived(tab, drawn=what != "typical")


def _show_step(tab: GrammarTab) -> None:
    """Show the robot as it was after some of its parts."""
    if tab.derivation is None:
        return
    n = tab.step.value
    partial = first_parts(tab.derivation, n)
    _show_tree(tab, tab.derivation, n)
    robot = compose(partial, tab.composed.session.places.library, tab.name)
    show_robot(tab.composed, robot, partial, f"# {partial}", f"{DERIVED}{partial}")


def _show_tree(tab: GrammarTab, derivation: Derivation, n: int) -> None:
    lines = [escape(line) for line in outline(derivation).splitlines()]
    shown = [line if i < n else f'<span class="dim">{line}</span>' for i, line in enumerate(lines)]
    tab.tree.content = markup.framed(f"<h3>Derivation</h3><pre>{'<br>'.join(shown)}</pre>")


def _count(text: str) -> int:
    return whole_number(text, 0)
