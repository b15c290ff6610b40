"""The pages without a subject: what there is to open as a gallery, a population or a split."""

from __future__ import annotations

from collections.abc import Mapping

from morphgen.benchmark.split_file import split_names
from morphgen.grammar.grammar_file import grammar_names
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.robot_rows import robot_folders
from morphgen.viewer.robot_uri import FileAccess
from morphgen.viewer.splits import SPLITS

PANEL_WIDTH = 620.0
"""Width of the panel [pixels]."""
Sections = Mapping[str, list[tuple[str, Address]]]
"""Labels and addresses of links, by the title of their section."""
_ROBOTS, _SPLITS, _GRAMMARS = "Robots in this folder", "Splits", "Grammars"
_TITLES = {
    "gallery": "Open the gallery of which robots?",
    "population": "Show which robots on one ground?",
    "split": "Open which split?",
}
_SECTIONS = {
    "gallery": (_ROBOTS, _SPLITS),
    "population": (_ROBOTS, _SPLITS, _GRAMMARS),
    "split": (_SPLITS,),
}
"""Sections of each page's index."""
_EMPTY = {
    _ROBOTS: "none yet: compose a robot and write it to robots/, or run "
    "<code>morphgen sample arm3</code>",
    _SPLITS: "none yet: choose robots in a gallery, then split in the tray",
}


def show_index(session: Session) -> None:
    """Build the page that asks for the subject of a gallery, a population or a split."""
    page = session.address.page
    session.open_panel(PANEL_WIDTH, markup.breadcrumbs((page, None)), left=True)
    targets = _subjects(session.files)
    sections = {
        title: [
            (name, Address("split" if page == "gallery" and title == _SPLITS else page, (name,)))
            for name in targets[title]
        ]
        for title in _SECTIONS[page]
    }
    html = f"<h2>{_TITLES[page]}</h2>{section_links(sections)}"
    session.client.gui.add_html(markup.framed(html))
    session.show_address(page)


def library_sections(files: FileAccess) -> Sections:
    """Return links to the robots of the current folder, the splits and the grammars."""
    pages = {_ROBOTS: "gallery", _SPLITS: "split", _GRAMMARS: "compose"}
    return {
        title: [(name, Address(pages[title], (name,))) for name in names]
        for title, names in _subjects(files).items()
    }


def section_links(sections: Sections) -> str:
    """Return sections of links as HTML; an empty section says what to do."""
    html = ""
    for title, links in sections.items():
        text = " · ".join(markup.link(address, name) for name, address in links)
        html += f"<h3>{title}</h3>{text or markup.dim(_EMPTY[title])}"
    return html


def _subjects(files: FileAccess) -> Mapping[str, list[str]]:
    """Return what addresses can name: folders of robots, splits with the user's first, grammars."""
    root = files.roots[0]
    own = sorted(path.relative_to(root).as_posix() for path in (root / SPLITS).rglob("*.yaml"))
    return {
        _ROBOTS: robot_folders(root),
        _SPLITS: [*own, *split_names()],
        _GRAMMARS: grammar_names(),
    }
