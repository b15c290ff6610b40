"""The page of a split: its two sides, how alike they are, and what the audit says."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import cast

import viser

from morphgen.benchmark.audit import Audit
from morphgen.benchmark.similarity import MEASURES, classical_mds, to_distances
from morphgen.benchmark.split import REGIMES, SIDES, Member, Split, split_id
from morphgen.viewer import gallery_grid, markup
from morphgen.viewer.address import Address
from morphgen.viewer.drawings import heatmap_svg, map_svg
from morphgen.viewer.gallery_grid import Gallery
from morphgen.viewer.new_split import save_split
from morphgen.viewer.robot_rows import split_entries
from morphgen.viewer.robot_uri import member_uri, resolve_member, resolve_split
from morphgen.viewer.session import Session, later, notify, say, when
from morphgen.viewer.splits import Study, study

SIDE = 520.0
"""Width of the panel, pixels."""


@dataclass(eq=False)
class SplitPage:
    """A split in one browser."""

    session: Session
    place: str
    split: Split
    gallery: Gallery
    study: Study | None = None
    texts: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)
    measure: viser.GuiDropdownHandle[str] | None = None


def show(session: Session) -> None:
    """Build the page.

    Raises:
        MorphgenError: If there is no such split, or its file cannot be read.
    """
    place = session.address.subject
    split = resolve_split(place, session.places)
    rows = Gallery(session, split.name, split_entries(place, split), columns=SIDES)
    page = SplitPage(session, place, split, rows)
    gui = session.client.gui
    gallery_grid.open_panels(
        rows, markup.crumbs((split.name, None)), _about(split) + _plays(place, split), SIDE
    )
    tabs = gui.add_tab_group()
    with tabs.add_tab("Robots", viser.Icon.ROBOT):
        gallery_grid.build(rows)
        _add_new_split(page)
    with tabs.add_tab("Map", viser.Icon.MAP):
        page.measure = gui.add_dropdown("measure", tuple(MEASURES), initial_value="tree")
        page.texts["map"] = gui.add_html("")
        page.texts["heatmap"] = gui.add_html("")
    with tabs.add_tab("Statistics", viser.Icon.TABLE):
        page.texts["statistics"] = gui.add_html(markup.framed(statistics_table(split.statistics)))
    with tabs.add_tab("Audit", viser.Icon.STETHOSCOPE):
        page.texts["audit"] = gui.add_html("")
    when(page.measure, session, lambda: _draw(page))
    later(session, lambda: _study(page))


def statistics_table(statistics: Mapping[str, object]) -> str:
    """Figures of both sides beside each other; ranges as mean, least and largest."""
    sides = [statistics.get(side) for side in SIDES]
    train, test = (side if isinstance(side, Mapping) else {} for side in sides)
    if not train or not test:
        return '<div class="dim">no figures yet</div>'
    rows = [
        (escape(str(key).replace("_", " ")), _figure(train.get(key)), _figure(test.get(key)))
        for key in train
    ]
    text = markup.table(("", *SIDES), rows, (1, 2))
    if "cosine" in statistics:
        text += f"<h3>Cosine of test to train</h3>{_figure(statistics['cosine'])}"
    return text


def audit_text(audit: Audit) -> str:
    """Findings, those that the author accepted with their reasons, and the nearest robots."""
    text = "<h3>Findings</h3>" + markup.findings_table(audit.findings)
    if audit.accepted:
        rows = [
            (f"<code>{escape(finding.code)}</code>", escape(finding.where), escape(reason))
            for finding, reason in audit.accepted
        ]
        text += "<h3>Accepted</h3>" + markup.table(("code", "where", "why"), rows)
    nearest = [
        (escape(each.test), each.measure, escape(each.train), f"{each.value:.3f}")
        for each in audit.neighbours
    ]
    return (
        text
        + "<h3>Nearest train robots</h3>"
        + markup.table(("test", "measure", "train", ""), nearest, (3,))
    )


def _about(split: Split) -> str:
    reference = f"<br>{escape(split.reference)}" if split.reference else ""
    return (
        f'{escape(split.summary)}<div class="dim">{split.regime} · id {split_id(split)}'
        f"{reference}</div>"
    )


def _plays(place: str, split: Split) -> str:
    """A link to the page on which the first robots to test on do their task."""
    first = split.test[0]
    robots = tuple(
        member_uri(place, "test", member) for member in split.test[:4] if member.task == first.task
    )
    state = {"obstacles": "yes"} if first.obstacles else {}
    link = markup.link(
        Address("play", (first.task,), state, robots), "see robots to test on at work"
    )
    return f'<div class="dim">{link}</div>'


def _figure(value: object) -> str:
    if isinstance(value, Mapping):
        return f"{value['mean']:.3g} ({value['min']:.3g} to {value['max']:.3g})"
    return f"{value:.4g}" if isinstance(value, float) else escape(str(value))


def _study(page: SplitPage) -> None:
    """Have the workers examine the robots, once a split for all browsers."""
    session = page.session
    key = f"study {split_id(page.split)}"
    if key not in session.shared:

        def progress(done: int, total: int) -> None:
            say(session, f"comparing {total} robots", done / total)

        session.shared[key] = study(page.split, session.places.folders, session.workers, progress)
        say(session, "")
    page.study = cast(Study, session.shared[key])
    if page.study.statistics:
        table = statistics_table(page.study.statistics)
        page.texts["statistics"].content = markup.framed(table)
    page.texts["audit"].content = markup.framed(audit_text(page.study.audit))
    _draw(page)


def _draw(page: SplitPage) -> None:
    """Draw the map and the heatmap of the chosen measure."""
    found = page.study
    if found is None or page.measure is None or not found.members:
        return
    measure = MEASURES[page.measure.value]
    values = found.matrices[measure.name]
    names = [member.name for member in found.members]
    flat = classical_mds(to_distances(values, measure.name))
    places = _member_places(page, found.members, found.sides)
    page.texts["map"].content = markup.framed(
        f'<div class="dim">{measure.meaning}; {flat.kept:.0%} of the variation shown; '
        f"{markup.tag('train', 'train')}{markup.tag('test', 'test')} click a point</div>",
        map_svg(flat.points, names, found.sides, places),
    )
    larger = measure.larger_is_more_alike
    page.texts["heatmap"].content = markup.framed(
        f'<div class="dim">dark is alike; {"larger" if larger else "smaller"} is more alike</div>',
        heatmap_svg(values, names, found.sides, larger=larger),
    )


def _member_places(page: SplitPage, members: Sequence[Member], sides: Sequence[str]) -> list[str]:
    return [
        member_uri(page.place, "train" if side == "train" else "test", member)
        for member, side in zip(members, sides, strict=True)
    ]


def _add_new_split(page: SplitPage) -> None:
    gui, session = page.session.client.gui, page.session
    with gui.add_folder("New split of what is shown", expand_by_default=False):
        name = gui.add_text("split name", "")
        regime = gui.add_dropdown("regime", REGIMES, initial_value=page.split.regime)
        button = gui.add_button("Save", icon=viser.Icon.DEVICE_FLOPPY)
        told = gui.add_html("")

    def save() -> None:
        sides: dict[str, list[Member]] = {side: [] for side in SIDES}
        for entry in gallery_grid.passing(page.gallery):
            sides[entry.role].append(resolve_member(entry.place, session.places))
        chosen = regime.value
        path = save_split(name.value, chosen, sides["train"], sides["test"], session.places)
        shown = path.relative_to(session.places.roots[0])
        told.content = markup.framed(markup.code(f"morphgen split audit {shlex.quote(str(shown))}"))
        notify(session, "Saved", str(shown))

    when(button, session, save)
