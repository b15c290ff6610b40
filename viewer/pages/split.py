"""The page of a split: its robots, a map of their similarity, statistics and the audit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape

import viser

from morphgen.benchmark.audit import Audit
from morphgen.encoding.similarity import MEASURES, classical_mds, to_distances
from morphgen.splits.split import SIDES, Split, split_id
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.figures import map_svg
from morphgen.viewer.pages import gallery as gallery_page
from morphgen.viewer.robot_rows import split_rows
from morphgen.viewer.robot_uri import member_uri, resolve_split
from morphgen.viewer.splits import SplitStudy, study_split

PANEL_WIDTH = 520.0  # largest width of the controls [pixels]
PANEL_SHARE = 0.36  # largest share of the window for the controls: names on the map stay readable
NUM_PLAYED = 4  # test robots of the link to a rollout


@dataclass(eq=False)
class SplitPage:
    """A split in one browser."""

    session: Session
    name: str  # name or file of the split, as in the address
    split: Split
    gallery: gallery_page.Gallery
    measure: viser.GuiDropdownHandle[str]
    study: SplitStudy | None = None
    texts: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)


def show(session: Session) -> None:
    """Build the page."""
    if not session.address.subject:
        gallery_page.show_index(session)
        return
    name = session.address.subject
    split = resolve_split(name, session.files)
    gallery = gallery_page.Gallery(session, split.name, split_rows(name, split), SIDES)
    gui = session.client.gui
    header = _description(split) + _rollout_link(name, split)
    width = min(PANEL_WIDTH, PANEL_SHARE * session.width)
    panel = gallery_page.open_panels(gallery, markup.breadcrumbs((split.name, None)), header, width)
    tabs = gui.add_tab_group()
    with tabs.add_tab("Robots", viser.Icon.ROBOT):
        gallery_page.add_controls(gallery)
    texts = {}
    with panel.add_tab("Map", viser.Icon.MAP):
        panel.visible = True  # on a narrow window, too
        measure = gui.add_dropdown("measure", tuple(MEASURES), initial_value="tree")
        texts["map"] = gui.add_html(markup.framed(markup.dim("the robots are being compared")))
    with tabs.add_tab("Statistics", viser.Icon.TABLE):
        texts["statistics"] = gui.add_html(markup.framed(statistics_table(split.statistics)))
    with tabs.add_tab("Audit", viser.Icon.STETHOSCOPE):
        texts["audit"] = gui.add_html("")
    page = SplitPage(session, name, split, gallery, measure, texts=texts)
    session.on_change(measure, lambda: _draw_map(page))
    session.run_in_background(lambda: _study(page))


def statistics_table(statistics: Mapping[str, object]) -> str:
    """Return a table of the statistics of both sides; distributions as mean (min to max)."""
    sides = [statistics.get(side) for side in SIDES]
    train, test = (side if isinstance(side, Mapping) else {} for side in sides)
    if not train or not test:
        return markup.dim("no statistics yet")
    rows = [
        (escape(str(key).replace("_", " ")), _format(train.get(key)), _format(test.get(key)))
        for key in train
    ]
    text = markup.table(("", *SIDES), rows, (1, 2))
    if "cosine" in statistics:
        text += f"<h3>Cosine of test to train</h3>{_format(statistics['cosine'])}"
    return text


def audit_text(audit: Audit) -> str:
    """Return the audit's findings, the accepted ones with reasons, and the nearest robots."""
    text = "<h3>Findings</h3>" + markup.findings_table(audit.findings)
    if audit.accepted:
        rows = [
            (f"<code>{escape(finding.code)}</code>", escape(finding.where), escape(reason))
            for finding, reason in audit.accepted
        ]
        text += "<h3>Accepted</h3>" + markup.table(("code", "where", "why"), rows)
    nearest = [
        (escape(test), measure, escape(found.train), f"{found.value:.3f}")
        for test, trains in audit.nearest.items()
        for measure, found in trains.items()
    ]
    table = markup.table(("test", "measure", "train", ""), nearest, (3,))
    return f"{text}<h3>Nearest train robots</h3>{table}"


def _description(split: Split) -> str:
    reference = f"<br>{escape(split.reference)}" if split.reference else ""
    details = f"{split.regime} · id {split_id(split)}{reference}"
    return escape(split.summary) + markup.dim(details)


def _rollout_link(name: str, split: Split) -> str:
    first = split.test[0]
    robots = tuple(
        member_uri(name, "test", member)
        for member in split.test[:NUM_PLAYED]
        if member.task == first.task
    )
    state = {"obstacles": "yes"} if first.obstacles else {}
    address = Address("play", (first.task,), state, robots)
    population = markup.link(Address("population", (name,)), "see all on one ground")
    return markup.dim(f"{markup.link(address, 'see robots to test on at work')} · {population}")


def _format(value: object) -> str:
    if isinstance(value, Mapping):
        mean, low, high = (value.get(key) for key in ("mean", "min", "max"))
        if all(isinstance(number, (int, float)) for number in (mean, low, high)):
            return f"{mean:.3g} ({low:.3g} to {high:.3g})"
    return f"{value:.4g}" if isinstance(value, float) else escape(str(value))


def _study(page: SplitPage) -> None:
    """Study the split in the worker processes, once for all browsers, and show the results."""
    session = page.session
    folders = session.files.library_folders
    page.study = session.cached(
        f"study {split_id(page.split)}",
        lambda: study_split(page.split, folders, session.workers),
        "comparing {} robots",
    )
    if page.study.statistics:
        table = statistics_table(page.study.statistics)
        page.texts["statistics"].content = markup.framed(table)
    page.texts["audit"].content = markup.framed(audit_text(page.study.audit))
    _draw_map(page)
    uris = {member_uri(page.name, side, member) for side, member in page.study.members}
    gallery_page.load_pictures(page.gallery, [row for row in page.gallery.rows if row.uri in uris])
    _draw_map(page)


def _draw_map(page: SplitPage) -> None:
    study = page.study
    if study is None or not study.members:
        return
    measure = MEASURES[page.measure.value]
    values = study.matrices[measure.name]
    names = [member.name for _, member in study.members]
    sides = [side for side, _ in study.members]
    uris = [member_uri(page.name, side, member) for side, member in study.members]
    plane = classical_mds(to_distances(values, measure.name))
    page.texts["map"].content = markup.framed(
        markup.dim(
            f"{measure.meaning}; {plane.kept:.0%} of the variation shown; "
            f"{markup.tag('train', 'train')}{markup.tag('test', 'test')} click a robot"
        ),
        map_svg(plane.points, names, sides, uris, page.gallery.thumbnails),
    )
