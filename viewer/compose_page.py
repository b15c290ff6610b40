"""The page on which robots are composed: of parts, or after a grammar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import viser

from morphgen.checks import check
from morphgen.errors import GrammarError, MorphgenError
from morphgen.formats.bundle import bundle_folder, split_colours, write_bundle
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation, outline
from morphgen.grammar.derive import First, derive
from morphgen.grammar.model import (
    find_grammar,
    grammar_from_text,
    grammar_names,
    grammar_text,
    load_grammar,
)
from morphgen.grammar.request import parse_words
from morphgen.grammar.sampling import draw
from morphgen.model.kinematics import reach
from morphgen.model.robot import Robot
from morphgen.viewer import markup, robot_tables
from morphgen.viewer.address import Address, AddressError
from morphgen.viewer.choice import (
    NOTHING,
    Choice,
    Control,
    controls_of,
    first_parts,
    kind_of,
    options,
    parse_choice,
    slots_of,
    with_part,
    with_value,
)
from morphgen.viewer.downloads import robot_files, zipped
from morphgen.viewer.overlays import has_tool
from morphgen.viewer.packed_text import packed, unpacked
from morphgen.viewer.places import DERIVED, WORDS
from morphgen.viewer.robot_page import SIDE, add_floor
from morphgen.viewer.robot_view import RobotView, add_robot, look_at, robot_bounds
from morphgen.viewer.session import (
    Session,
    in_worker,
    later,
    notify,
    say,
    set_value,
    show_state,
    when,
)

ROBOTS = "robots"
"""Folder below which bundles are written."""


@dataclass(eq=False)
class ComposePage:
    """The panel in one browser."""

    session: Session
    choice: Choice
    grammar: str = ""
    """Name of the grammar in the text field."""
    original: str = ""
    """Its text before it was edited."""
    derivation: Derivation | None = None
    """Of the whole robot; the one that is shown may have fewer parts."""
    robot: Robot | None = None
    view: RobotView | None = None
    texts: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)
    folders: dict[str, viser.GuiFolderHandle] = field(default_factory=dict)
    """Of every slot's controls."""
    parts: viser.GuiFolderHandle | None = None
    text: viser.GuiTextHandle | None = None
    seed: viser.GuiNumberHandle[int] | None = None
    number: viser.GuiNumberHandle[int] | None = None
    step: viser.GuiSliderHandle[int] | None = None
    framed: bool = False


def show(session: Session) -> None:
    """Build the page.

    Raises:
        MorphgenError: If the address names words or a grammar that mean nothing.
    """
    words = session.address.subject.split()
    library = session.places.library
    is_grammar = bool(words) and "=" not in words[0]
    choice = parse_choice(["arm=ur5", "ee=plane"] if is_grammar or not words else words, library)
    grammar = words[0] if is_grammar else "arm3"
    source = load_grammar(find_grammar(grammar, library.folders), library.folders)
    page = ComposePage(session, choice, source.name, grammar_text(source))
    text = unpacked(session.address.state["text"]) if "text" in session.address.state else None
    gui = session.client.gui
    gui.set_panel_label("morphgen")
    gui.main_panel.dock_right()
    gui.main_panel.set_width(SIDE + 30)
    gui.add_html(markup.STYLE + markup.crumbs(("compose", None)))
    session.status = gui.add_html("")
    page.texts["summary"] = gui.add_html("")
    add_floor(session.client.scene, 2.0)
    tabs = gui.add_tab_group()
    if is_grammar:
        _add_grammar_tab(page, tabs, text or page.original)
        _add_parts_tab(page, tabs)
    else:
        _add_parts_tab(page, tabs)
        _add_grammar_tab(page, tabs, page.original)
    with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
        page.texts["findings"] = gui.add_html("")
    with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
        _add_export(page)
    if is_grammar:
        _derive(page, drawn="number" in session.address.state)
    else:
        _compose_choice(page)


def _add_parts_tab(page: ComposePage, tabs: viser.GuiTabGroupHandle) -> None:
    gui = page.session.client.gui
    with tabs.add_tab("Parts", viser.Icon.PUZZLE):
        page.texts["fault"] = gui.add_html("")
        bases = page.session.places.library.names("base")
        base = gui.add_dropdown("base", tuple(bases), initial_value=page.choice.parts["base"])
        page.parts = gui.add_folder(None)
    when(base, page.session, lambda: _choose(page, "base", base.value))
    _add_slots(page)


def _add_slots(page: ComposePage) -> None:
    """A dropdown a slot of the base, and controls of what is chosen."""
    gui, library = page.session.client.gui, page.session.places.library
    for old in page.folders.values():
        old.remove()
    page.folders.clear()
    if page.parts is None:
        return
    with page.parts:
        for slot in ("base", *slots_of(page.choice, library)):
            folder = page.folders[slot] = gui.add_folder(slot)
            with folder:
                if slot != "base":
                    _add_slot(page, slot)
                if page.choice.parts.get(slot):
                    _add_controls(page, slot)


def _add_slot(page: ComposePage, slot: str) -> None:
    names = options(slot, page.session.places.library)
    chosen = page.choice.parts.get(slot) or NOTHING
    box = page.session.client.gui.add_dropdown(
        kind_of(slot), tuple(names), initial_value=chosen if chosen in names else NOTHING
    )
    when(box, page.session, lambda: _choose(page, slot, box.value))


def _add_controls(page: ComposePage, slot: str) -> None:
    manifest = page.session.places.library.manifest(page.choice.parts[slot], kind_of(slot))
    for control in controls_of(slot, manifest):
        slider = page.session.client.gui.add_slider(
            control.label,
            control.low,
            control.high,
            control.step,
            page.choice.values.get(control.key, control.default),
            hint=control.hint,
        )
        when(slider, page.session, _setter(page, control, slider), control.key)


def _setter(
    page: ComposePage, control: Control, slider: viser.GuiSliderHandle[float]
) -> Callable[[], None]:
    def set_value() -> None:
        page.choice = with_value(page.choice, control, slider.value)
        _compose_choice(page)

    return set_value


def _choose(page: ComposePage, slot: str, part: str) -> None:
    page.choice = with_part(page.choice, slot, part, page.session.places.library)
    _add_slots(page)
    _compose_choice(page)


def _compose_choice(page: ComposePage) -> None:
    """Show the robot of the chosen parts, or why there is none."""
    library, words = page.session.places.library, page.choice.words
    try:
        derivation, name = parse_words(words.split(), library)
        robot = compose(derivation, library, name)
    except MorphgenError as error:
        page.texts["fault"].content = _fault(error)
        return
    page.texts["fault"].content = ""
    page.session.address = Address("compose", (words,))
    show_state(page.session, f"compose {name}")
    _show_robot(page, robot, derivation, f"morphgen compose {words}", WORDS + words)


def _add_grammar_tab(page: ComposePage, tabs: viser.GuiTabGroupHandle, text: str) -> None:
    gui, session = page.session.client.gui, page.session
    with tabs.add_tab("Grammar", viser.Icon.BINARY_TREE):
        names = tuple(dict.fromkeys((page.grammar, *grammar_names())))
        chosen = gui.add_dropdown("start from", names, initial_value=page.grammar)
        page.text = gui.add_text("text", text, multiline=True)
        page.texts["grammar fault"] = gui.add_html("")
        page.texts["too long"] = gui.add_html("")
        state = session.address.state
        page.seed = gui.add_number("seed", _count(state.get("seed", "")), min=0, step=1)
        page.number = gui.add_number("robot number", _count(state.get("number", "")), min=0, step=1)
        action = gui.add_button_group("draw", ("typical", "this", "next"))
        page.step = gui.add_slider(
            "parts shown", 1, 2, 1, 1, hint="how far the derivation is shown"
        )
        page.texts["tree"] = gui.add_html("")
    when(chosen, session, lambda: _load(page, chosen.value))
    when(page.text, session, lambda: _edited(page), "grammar")
    when(action, session, lambda: _draw(page, action.value))
    when(page.step, session, lambda: _show_step(page), "step")


def _load(page: ComposePage, name: str) -> None:
    library = page.session.places.library
    page.grammar = name
    if page.text is not None:
        found = load_grammar(find_grammar(name, library.folders), library.folders)
        page.original = grammar_text(found)
        set_value(page.text, page.original)
    _derive(page, drawn=False)


def _edited(page: ComposePage) -> None:
    """Check the text, and keep it in the address."""
    page.session.address = Address("compose", (page.grammar,), _text_state(page))
    show_state(page.session, f"compose {page.grammar}")
    _read_grammar(page)


def _text_state(page: ComposePage) -> dict[str, str]:
    """The text as the address keeps it, if it was edited and is not too long; else it is said."""
    page.texts["too long"].content = ""
    if not _is_edited(page) or page.text is None:
        return {}
    try:
        return {"text": packed(page.text.value)}
    except AddressError as error:
        page.texts["too long"].content = markup.framed(f'<div class="dim">{error}</div>')
        return {}


def _is_edited(page: ComposePage) -> bool:
    return page.text is not None and page.text.value != page.original


def _read_grammar(page: ComposePage) -> bool:
    """Say whether the text is a grammar that can be derived; if not, where it fails."""
    if page.text is None:
        return False
    try:
        grammar = grammar_from_text(page.text.value, page.grammar)
        derive(grammar, page.session.places.library, First())
    except GrammarError as error:
        page.texts["grammar fault"].content = _fault(error)
        return False
    page.texts["grammar fault"].content = ""
    return True


def _draw(page: ComposePage, what: str) -> None:
    if page.number is not None and what == "next":
        set_value(page.number, page.number.value + 1)
    _derive(page, drawn=what != "typical")


def _derive(page: ComposePage, *, drawn: bool) -> None:
    """Show a robot of the grammar in the text field: a drawn one, or the typical one."""
    if page.text is None or page.seed is None or page.number is None or page.step is None:
        raise RuntimeError("the grammar's controls are not there yet")
    if not _read_grammar(page):
        return
    library = page.session.places.library
    grammar = grammar_from_text(page.text.value, page.grammar)
    name = f"{page.grammar}.grammar" if _is_edited(page) else page.grammar
    note = f"# with the text of the tab Grammar in {name}\n" if _is_edited(page) else ""
    command = f"{note}morphgen compose {name}"
    if drawn:
        seed, number = page.seed.value, page.number.value
        say(page.session, f"drawing robot {number} of seed {seed}")
        sample = draw(grammar, library, number, seed=seed)
        say(page.session, "")
        robot, page.derivation = sample.robot, sample.derivation
        command = f"{note}morphgen sample {name} -n {number + 1} --seed {seed}"
    else:
        page.derivation = derive(grammar, library, First())
        robot = compose(page.derivation, library, page.grammar)
    n = sum(1 for _ in page.derivation.walk())
    page.step.max = max(n, 2)
    set_value(page.step, n)
    state = {"seed": str(page.seed.value), "number": str(page.number.value)} if drawn else {}
    state |= _text_state(page)
    page.session.address = Address("compose", (page.grammar,), state)
    show_state(page.session, f"compose {page.grammar}")
    _show_tree(page, n)
    _show_robot(page, robot, page.derivation, command, f"{DERIVED}{page.derivation}")


def _show_step(page: ComposePage) -> None:
    """Show the robot as it was after some of its parts."""
    if page.derivation is None or page.step is None:
        return
    n = page.step.value
    partial = first_parts(page.derivation, n)
    _show_tree(page, n)
    robot = compose(partial, page.session.places.library, page.grammar)
    place = f"{DERIVED}{partial}"
    _show_robot(page, robot, partial, f"# {partial}", place)


def _show_tree(page: ComposePage, n: int) -> None:
    if page.derivation is None:
        return
    lines = [escape(line) for line in outline(page.derivation).splitlines()]
    shown = [line if i < n else f'<span class="dim">{line}</span>' for i, line in enumerate(lines)]
    page.texts["tree"].content = markup.framed(
        f"<h3>Derivation</h3><pre>{'<br>'.join(shown)}</pre>"
    )


def _show_robot(
    page: ComposePage, robot: Robot, derivation: Derivation, command: str, place: str
) -> None:
    client = page.session.client
    robot = split_colours(robot)
    with client.atomic():
        if page.view is not None:
            page.view.base.remove()
        page.view = add_robot(client.scene, robot, "/robot")
    page.robot = robot
    if not page.framed:
        look_at(client, *robot_bounds(robot))
        page.framed = True
    distance = reach(robot) if has_tool(robot) and robot.dof else None
    own = markup.link(Address("robot", (place,)), "open its page")
    page.texts["summary"].content = markup.framed(
        f"<h3>{escape(robot.name)}</h3>"
        f'<div class="dim">{robot_tables.summary(robot, distance)} · {own}</div>'
    )
    page.texts["command"].content = markup.framed(
        "<h3>The same on the command line</h3>",
        markup.code(command),
        "<h3>Derivation</h3>",
        markup.code(str(derivation)),
    )
    later(page.session, lambda: _check(page), "check")


def _check(page: ComposePage) -> None:
    robot = page.robot
    if robot is None:
        return
    findings = check(robot, tool_required=has_tool(robot))
    if robot is page.robot:
        page.texts["findings"].content = markup.framed(markup.findings_table(findings))


def _add_export(page: ComposePage) -> None:
    gui, session = page.session.client.gui, page.session
    name = gui.add_text("name", "", hint="by default from its parts")
    write = gui.add_button(f"Write to {ROBOTS}/", icon=viser.Icon.DEVICE_FLOPPY)
    pack = gui.add_button("Bundle (.zip)", icon=viser.Icon.DOWNLOAD)
    page.texts["command"] = gui.add_html("")
    when(write, session, lambda: later(session, lambda: _write(page, name.value)))
    when(pack, session, lambda: later(session, lambda: _send(page, name.value)))


def _write(page: ComposePage, name: str) -> None:
    if page.robot is None:
        return
    folder = bundle_folder(page.session.places.roots[0] / ROBOTS, name or page.robot.name)
    say(page.session, f"writing {folder}")
    in_worker(page.session, _bundle, page.robot, folder)
    say(page.session, "")
    notify(page.session, "Written", f"{ROBOTS}/{folder.name}")


def _bundle(robot: Robot, folder: Path) -> None:
    """Write a bundle with its picture; for a worker, where drawing disturbs nobody."""
    write_bundle(robot, folder, check(robot))


def _send(page: ComposePage, name: str) -> None:
    if page.robot is None:
        return
    say(page.session, "packing the bundle")
    files = in_worker(page.session, robot_files, page.robot)
    name = name or page.robot.name
    page.session.client.send_file_download(
        f"{name}.zip", zipped(name, files), save_immediately=True
    )
    say(page.session, "")


def _count(text: str) -> int:
    return int(text) if text.isdigit() else 0


def _fault(error: MorphgenError) -> str:
    return markup.framed(markup.tag("error", "error"), f" {escape(str(error))}")
