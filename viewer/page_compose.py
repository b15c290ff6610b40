"""The page that composes robots: from chosen parts, or from a grammar."""

from __future__ import annotations

import functools
import shlex
from dataclasses import dataclass, field
from pathlib import Path

import viser

from morphgen.checks import check
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import bundle_folder, split_colours, write_bundle
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation
from morphgen.model.robot import Robot
from morphgen.viewer import markup, part_choice
from morphgen.viewer.address import Address
from morphgen.viewer.page_compose_grammar import add_grammar_tab, show_grammar
from morphgen.viewer.page_robot import PANEL_WIDTH, summary
from morphgen.viewer.robot_files import new_bundle_files, zip_files
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.robot_uri import WORDS, resolve_grammar, resolve_words
from morphgen.viewer.scene_robot import RobotView, add_robot, robot_bounds
from morphgen.viewer.scene_stage import add_ground, look_at
from morphgen.viewer.session import Session

ROBOTS = "robots"
"""Folder in which bundles are written."""
DEFAULT_PARTS = ("arm=ur5", "ee=plane")
DEFAULT_GRAMMAR = "arm3"


@dataclass(eq=False)
class ComposePage:
    """The composed robot in one browser, and the texts about it."""

    session: Session
    summary: viser.GuiHtmlHandle
    findings: viser.GuiHtmlHandle | None = None
    command: viser.GuiHtmlHandle | None = None
    robot: Robot | None = None
    view: RobotView | None = None


@dataclass(eq=False)
class PartsTab:
    """The tab on which parts are chosen."""

    page: ComposePage
    choice: part_choice.PartChoice
    fault: viser.GuiHtmlHandle
    folder: viser.GuiFolderHandle
    slots: dict[str, viser.GuiFolderHandle] = field(default_factory=dict)
    """Folders with the controls of each slot."""


def show(session: Session) -> None:
    """Build the page.

    Raises:
        MorphgenError: If the address names invalid words or an unknown grammar.
    """
    words = session.address.subject.split()
    is_grammar = bool(words) and "=" not in words[0]
    parts = DEFAULT_PARTS if is_grammar or not words else words
    choice = part_choice.parse_choice(parts, session.files.library)
    name = words[0] if is_grammar else DEFAULT_GRAMMAR
    grammar = resolve_grammar(name, session.files)
    session.open_panel(PANEL_WIDTH + 30, markup.breadcrumbs(("compose", None)))
    gui = session.client.gui
    page = ComposePage(session, gui.add_html(""))
    add_ground(session.client.scene, 2.0)
    tabs = gui.add_tab_group()
    show_in_page = functools.partial(show_robot, page)
    if is_grammar:  # the tab that the address asks for comes first
        grammar_tab = add_grammar_tab(session, tabs, grammar, name, show_in_page)
        _add_parts_tab(page, tabs, choice)
    else:
        parts_tab = _add_parts_tab(page, tabs, choice)
        add_grammar_tab(session, tabs, grammar, name, show_in_page)
    with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
        page.findings = gui.add_html("")
    with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
        _add_downloads_tab(page)
    if is_grammar:
        show_grammar(grammar_tab, drawn="number" in session.address.state)
    else:
        _show_choice(parts_tab)


def show_robot(
    page: ComposePage, robot: Robot, derivation: Derivation, command: str, uri: str
) -> None:
    """Show a robot in place of the previous one, and check it in the background.

    Args:
        page: The page.
        robot: The robot.
        derivation: Derivation of the robot.
        command: Command that makes the same robot.
        uri: URI of the robot, for the link to its own page.
    """
    client, is_first = page.session.client, page.view is None
    robot = split_colours(robot)
    with client.atomic():
        if page.view is not None:
            page.view.base.remove()
        page.view = add_robot(client.scene, robot, "/robot")
    page.robot = robot
    if is_first:  # later robots keep the camera of the user
        look_at(client, *robot_bounds(robot))
    page.summary.content = summary(
        robot, " · " + markup.link(Address("robot", (uri,)), "open its page")
    )
    if page.command is not None:
        page.command.content = markup.framed(
            markup.command(command), "<h3>Derivation</h3>", markup.code(str(derivation))
        )
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


def _write_bundle(page: ComposePage, name: str) -> None:
    robot, session = page.robot, page.session
    if robot is None:
        return
    folder = bundle_folder(session.files.roots[0] / ROBOTS, name or robot.name)
    session.set_status(f"writing {ROBOTS}/{folder.name}")
    session.run_in_worker(_write_checked, robot, folder)
    session.set_status("")
    session.notify("Written", f"{ROBOTS}/{folder.name}")


def _write_checked(robot: Robot, folder: Path) -> None:
    """Write a bundle with findings and picture. Runs in a worker, which may use OpenGL."""
    write_bundle(robot, folder, check(robot))


def _send_bundle(page: ComposePage, name: str) -> None:
    robot, session = page.robot, page.session
    if robot is None:
        return
    session.set_status("packing the bundle")
    files = session.run_in_worker(new_bundle_files, robot)
    name = bundle_folder(Path(), name or robot.name or "robot").name  # validates the name
    session.client.send_file_download(f"{name}.zip", zip_files(name, files), save_immediately=True)
    session.set_status("")


def _add_parts_tab(
    page: ComposePage, tabs: viser.GuiTabGroupHandle, choice: part_choice.PartChoice
) -> PartsTab:
    """Add the tab with a dropdown for the base and the controls of its slots."""
    session = page.session
    gui = session.client.gui
    with tabs.add_tab("Parts", viser.Icon.PUZZLE):
        fault = gui.add_html("")
        bases = tuple(session.files.library.names("base"))
        base = gui.add_dropdown("base", bases, initial_value=choice.parts["base"])
        tab = PartsTab(page, choice, fault, gui.add_folder(None))
    session.on_change(base, lambda: _choose_part(tab, "base", base.value))
    _add_slots(tab)
    return tab


def _show_choice(tab: PartsTab) -> None:
    """Show the robot of the chosen parts, or why they do not fit; then the last robot stays."""
    session, words = tab.page.session, tab.choice.words
    try:
        derivation, name = resolve_words(words, session.files)
        robot = compose(derivation, session.files.library, name)
    except MorphgenError as error:
        tab.fault.content = markup.error(session.files.redact(error))
        return
    tab.fault.content = ""
    session.address = Address("compose", (words,))
    session.show_address(f"compose {name}")
    command = shlex.join(["morphgen", "compose", *words.split()])
    show_robot(tab.page, robot, derivation, command, WORDS + words)


def _add_slots(tab: PartsTab) -> None:
    """Add for each slot a dropdown of parts, and sliders of the chosen part's parameters."""
    session = tab.page.session
    gui, library = session.client.gui, session.files.library
    for folder in tab.slots.values():
        folder.remove()
    tab.slots.clear()
    with tab.folder:
        for slot in ("base", *part_choice.slots_of(tab.choice, library)):
            folder = tab.slots[slot] = gui.add_folder(slot)
            with folder:
                if slot != "base":
                    _add_part_dropdown(tab, slot)
                if part := tab.choice.parts.get(slot):
                    for control in part_choice.controls_of(
                        slot, library.manifest(part, part_choice.kind_of(slot))
                    ):
                        _add_slider(tab, control)


def _add_part_dropdown(tab: PartsTab, slot: str) -> None:
    session = tab.page.session
    names = part_choice.part_options(slot, session.files.library)
    chosen = tab.choice.parts.get(slot)
    dropdown = session.client.gui.add_dropdown(
        part_choice.kind_of(slot),
        tuple(names),
        initial_value=chosen if chosen in names else part_choice.NO_PART,
    )
    session.on_change(dropdown, lambda: _choose_part(tab, slot, dropdown.value))


def _add_slider(tab: PartsTab, control: part_choice.Control) -> None:
    """Add the slider of a part's parameter."""
    slider = tab.page.session.client.gui.add_slider(
        control.label,
        control.low,
        control.high,
        control.step,
        tab.choice.values.get(control.key, control.default),
        hint=control.hint,
    )

    def set_parameter() -> None:
        tab.choice = part_choice.with_value(tab.choice, control, slider.value)
        _show_choice(tab)

    tab.page.session.on_change(slider, set_parameter, control.key)


def _choose_part(tab: PartsTab, slot: str, part: str) -> None:
    """Put a part into a slot, and show its controls and the robot."""
    tab.choice = part_choice.with_part(tab.choice, slot, part, tab.page.session.files.library)
    _add_slots(tab)
    _show_choice(tab)
