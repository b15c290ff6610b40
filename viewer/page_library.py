"""The first page: all parts, and links to robots, splits and grammars."""

from __future__ import annotations

import viser

from morphgen.benchmark.split_file import split_names
from morphgen.grammar.grammar_file import grammar_names
from morphgen.viewer import browser, gallery_grid, markup
from morphgen.viewer.address import Address
from morphgen.viewer.gallery_grid import Gallery
from morphgen.viewer.robot_rows import part_entries, subfolders
from morphgen.viewer.robot_uri import FileAccess
from morphgen.viewer.session import Session, post
from morphgen.viewer.uploads import keep


def show(session: Session) -> None:
    """The first page: sets and splits, grammars, and the parts as a gallery."""
    rows = Gallery(session, "Parts", part_entries(session.places.library))
    gallery_grid.open_panels(rows, markup.crumbs(), library_links(session.places))
    gui = session.client.gui
    upload = gui.add_upload_button("Look at a URDF or a zipped bundle", icon=viser.Icon.UPLOAD)

    async def uploaded(event: viser.GuiEvent[viser.GuiUploadButtonHandle]) -> None:
        sent = event.target.value
        post(session, lambda: _open_upload(session, sent.name, sent.content))

    upload.on_upload(uploaded)
    gallery_grid.build(rows)


def _open_upload(session: Session, name: str, content: bytes) -> None:
    place = keep(name, content, session.places)
    browser.go_to(session.client, Address("robot", (place,)).query)


def library_links(places: FileAccess) -> str:
    """Links to all that is no part: robots of this folder, splits, grammars."""
    here = places.roots[0]
    robots = ["robots", *(f"robots/{name}" for name in subfolders(here / "robots"))]
    folders = [*subfolders(here), *(name for name in robots if (here / name).is_dir())]
    sections = [
        ("Robots", [(name, Address("gallery", (name,))) for name in dict.fromkeys(folders)]),
        ("Splits", [(name, Address("split", (name,))) for name in split_names()]),
        ("Categories", [(name, Address("compose", (name,))) for name in grammar_names()]),
        ("New", [("compose a robot", Address("compose", ("arm=ur5 ee=plane",)))]),
    ]
    return "".join(
        f"<h3>{title}</h3>" + " · ".join(markup.link(where, text) for text, where in links)
        for title, links in sections
        if links
    )
