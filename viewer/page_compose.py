"""The page on which robots are composed: of parts, or after a grammar."""

from __future__ import annotations

from morphgen.viewer import markup
from morphgen.viewer.choice import parse_choice
from morphgen.viewer.compose_parts import add_parts_tab, show_choice
from morphgen.viewer.composed import Composed, add_check_tab, add_get_tab
from morphgen.viewer.page_compose_grammar import add_grammar_tab, show_derived
from morphgen.viewer.page_robot import SIDE, add_floor
from morphgen.viewer.robot_uri import resolve_grammar
from morphgen.viewer.session import Session


def show(session: Session) -> None:
    """Build the page.

    Raises:
        MorphgenError: If the address names words or a grammar that mean nothing.
    """
    words = session.address.subject.split()
    library = session.places.library
    is_grammar = bool(words) and "=" not in words[0]
    choice = parse_choice(["arm=ur5", "ee=plane"] if is_grammar or not words else words, library)
    name = words[0] if is_grammar else "arm3"
    grammar = resolve_grammar(name, session.places)
    gui = session.client.gui
    gui.set_panel_label("morphgen")
    gui.main_panel.dock_right()
    gui.main_panel.set_width(SIDE + 30)
    gui.add_html(markup.STYLE + markup.crumbs(("compose", None)))
    session.status = gui.add_html("")
    composed = Composed(session, gui.add_html(""))
    add_floor(session.client.scene, 2.0)
    tabs = gui.add_tab_group()
    if is_grammar:
        written = add_grammar_tab(composed, tabs, grammar, name)
        add_parts_tab(composed, tabs, choice)
    else:
        chosen = add_parts_tab(composed, tabs, choice)
        add_grammar_tab(composed, tabs, grammar, name)
    add_check_tab(composed, tabs)
    add_get_tab(composed, tabs)
    if is_grammar:
        show_derived(written, drawn="number" in session.address.state)
    else:
        show_choice(chosen)
