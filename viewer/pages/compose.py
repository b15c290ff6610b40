"""The page that composes robots: from chosen parts, or from a grammar."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from html import escape

import viser

from morphgen.checks import check
from morphgen.errors import CompositionError
from morphgen.grammar.derivation import Derivation, parse_derivation
from morphgen.grammar.derive import Choices
from morphgen.grammar.grammar_file import SUFFIX, grammar_names, grammar_text
from morphgen.grammar.request import known_grammars
from morphgen.grammar.robot_set import GRAMMAR, INDEX, read_index, read_settings
from morphgen.model.robot import Robot
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.pages import compose_evolve as compose_view
from morphgen.viewer.pages import part_choice
from morphgen.viewer.pages.compose_evolve import (
    ROBOTS,
    EvolveTab,
    add_evolve_tab,
    leave_parent,
    send_robot,
    set_parent,
    write_robot,
)
from morphgen.viewer.pages.compose_grammar import (
    Individual,
    add_grammar_tab,
    is_robot,
    show_grammar,
)
from morphgen.viewer.pages.compose_parts import add_parameters_tab, add_parts_tab
from morphgen.viewer.pages.part_choice import choice_of
from morphgen.viewer.pages.robot import PANEL_WIDTH, summary
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.robot_uri import (
    DEFAULT_WORDS,
    DERIVATION,
    MEMBER,
    UPLOAD,
    WORDS,
    FileAccess,
    UriError,
    parent_folder,
    read_robot_uri,
    resolve_derivation,
    resolve_grammar,
    shorten,
    uri_name,
)

DEFAULT_GRAMMAR = "arm3"
_OF_GRAMMARS = ("choices", "evolve", "number", "text")
"""Keys of the address that only robots of grammars have."""


@dataclass(eq=False)
class ComposePage:
    """The composed robot in one browser, and the texts about it."""

    session: Session
    view: compose_view.ComposeView
    summary: viser.GuiHtmlHandle
    findings: viser.GuiHtmlHandle | None = None
    command: viser.GuiHtmlHandle | None = None
    robot: Robot | None = None
    evolve: EvolveTab | None = None


def show(session: Session) -> None:
    """Build the page."""
    files, subject = session.files, session.address.subject.strip() or DEFAULT_WORDS
    derivation = subject_derivation(subject, files)
    words = DEFAULT_WORDS if derivation else subject
    grammar_name = DEFAULT_GRAMMAR
    # A robot with choices is one of the grammar around it.
    is_around = is_robot(subject) and not session.address.state.keys().isdisjoint(_OF_GRAMMARS)
    if is_around:
        grammar_name, is_grammar = subject, True
    elif is_grammar := not derivation and "=" not in subject.split()[0]:
        grammar_name, words = subject.split()[0], DEFAULT_WORDS
    drawn = drawn_in_set(subject, files) if derivation else None
    if drawn is not None:
        grammar_name = drawn[0]
    choice = choice_of(derivation, files.library) if derivation else None
    is_tree = derivation is not None and choice is None
    choice = choice or part_choice.parse_choice(words.split(), files.library)
    session.open_panel(PANEL_WIDTH + 30, markup.breadcrumbs(("compose", None)))
    gui = session.client.gui
    page = ComposePage(session, compose_view.ComposeView(session), gui.add_html(""))
    tabs = gui.add_tab_group()
    show_in_page = functools.partial(show_robot, page)
    start: Callable[[], None]
    # The tab that the address asks for comes first.
    if is_grammar:
        grammar_tab = add_grammar_tab(session, tabs, grammar_name, show_in_page)
        add_parts_tab(session, tabs, choice, show_in_page)
        start = functools.partial(show_grammar, grammar_tab, grammar_tab.mode)
    else:
        if derivation and is_tree:
            start = add_parameters_tab(session, tabs, derivation, show_in_page)
        else:
            start = add_parts_tab(session, tabs, choice, show_in_page)
        grammar_tab = add_grammar_tab(session, tabs, grammar_name, show_in_page)
    page.evolve = add_evolve_tab(session, tabs, grammar_tab)
    with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
        page.findings = gui.add_html("")
    with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
        _add_downloads_tab(page)
    start()
    if derivation and drawn is not None and page.robot is not None:
        grammar_tab.choices, grammar_tab.mode = drawn[1], "chosen"
        set_parent(page.evolve, Individual(page.robot, derivation, drawn[1]))


def drawn_in_set(subject: str, files: FileAccess) -> tuple[str, Choices] | None:
    """Return the grammar and the choices that gave a robot of a set; None for other robots."""
    folder = parent_folder(subject)
    if not folder or not (path := files.path(folder)).joinpath(INDEX).is_file():
        return None
    records = {record["name"]: record["choices"] for record in read_index(path)}
    choices = records.get(uri_name(subject))
    if choices is None or not (path / GRAMMAR).is_file():
        return None
    name = str(read_settings(path)["grammar"])
    text = (path / GRAMMAR).read_text(encoding="utf-8")
    if name in grammar_names() and grammar_text(resolve_grammar(name, files)) == text:
        return name, choices
    return f"{folder}/{GRAMMAR}", choices


def subject_derivation(subject: str, files: FileAccess) -> Derivation | None:
    """Return the derivation of the robot that an address names by its URI; None for words."""
    if subject.startswith((DERIVATION, MEMBER)):
        return resolve_derivation(subject, files)
    first = subject.split()[0]
    is_path = subject.startswith(UPLOAD) or ("=" not in first and not first.endswith(SUFFIX))
    if not is_path or first in known_grammars(files.library):
        return None
    if not subject.startswith(UPLOAD) and "/" not in subject and not _exists(subject, files):
        return None  # the name of a grammar that does not exist
    text = read_robot_uri(subject, files).provenance.get("derivation")
    if not text:
        raise UriError(f"{shorten(subject)} was imported: only composed robots can be edited")
    return parse_derivation(str(text))


def _exists(subject: str, files: FileAccess) -> bool:
    try:
        files.path(subject)
    except UriError:
        return False
    return True


def show_robot(
    page: ComposePage, robot: Robot, derivation: Derivation, command: str, uri: str
) -> None:
    """Show a robot in place of the previous one, and check it in the background."""
    change = compose_view.show(page.view, robot)
    page.robot = robot
    page.summary.content = summary(
        robot,
        f" · {markup.link(Address('robot', (uri,)), 'open its page')} · "
        + markup.choose_box(uri, "choose")
        + (f"<br>changed: {escape(change)}" if change else ""),
    )
    if page.command is not None:
        page.command.content = markup.framed(
            markup.command(command), "<h3>Derivation</h3>", markup.code(str(derivation))
        )
    if page.evolve is not None:
        leave_parent(page.evolve, uri.removeprefix(WORDS))
    page.session.run_in_background(lambda: _check(page), "check")


def _check(page: ComposePage) -> None:
    """Check the current robot, and show the findings unless another robot has replaced it."""
    robot = page.robot
    if robot is None or page.findings is None:
        return
    findings = check(robot, tool_required=has_tool(robot))
    if robot is page.robot:
        table = markup.findings_table(findings, page.session.files.redact)
        page.findings.content = markup.framed(table)


def _add_downloads_tab(page: ComposePage) -> None:
    """Add buttons that write or download the bundle, and the command."""
    gui, session = page.session.client.gui, page.session
    name = gui.add_text("name", "", hint="by default from its parts")
    write = gui.add_button(f"Write to {ROBOTS}/", icon=viser.Icon.DEVICE_FLOPPY)
    download = gui.add_button("Bundle (.zip)", icon=viser.Icon.DOWNLOAD)
    page.command = gui.add_html("")
    session.on_change(
        write, lambda: session.run_in_background(lambda: _write_bundle(page, name.value))
    )
    session.on_change(
        download, lambda: session.run_in_background(lambda: _send_bundle(page, name.value))
    )


def _shown_robot(page: ComposePage) -> Robot:
    """Return the robot that the page shows."""
    if page.robot is None:
        raise CompositionError("no robot is shown: choose parts that fit, or draw one")
    return page.robot


def _write_bundle(page: ComposePage, name: str) -> None:
    robot = _shown_robot(page)
    name = name or robot.name
    write_robot(page.session, replace(robot, name=name), name)


def _send_bundle(page: ComposePage, name: str) -> None:
    robot = _shown_robot(page)
    name = name or robot.name or "robot"
    send_robot(page.session, replace(robot, name=name), name)
