"""The first page: all parts, with links to robots, splits and grammars, and the upload button."""

from __future__ import annotations

import viser

from morphgen.benchmark.split_file import split_names
from morphgen.grammar.grammar_file import grammar_names
from morphgen.viewer import markup
from morphgen.viewer.address import Address
from morphgen.viewer.gallery_grid import Gallery, add_controls, open_panels
from morphgen.viewer.gallery_sheet import add_sheet_buttons
from morphgen.viewer.robot_rows import part_rows, robot_subfolders
from morphgen.viewer.robot_uri import FileAccess
from morphgen.viewer.session import Session
from morphgen.viewer.uploads import store_upload


def show(session: Session) -> None:
    """Build the page."""
    gallery = Gallery(session, "Parts", part_rows(session.files.library))
    open_panels(gallery, markup.breadcrumbs(), library_links(session.files))
    upload = session.client.gui.add_upload_button(
        "Look at a URDF or a zipped bundle", icon=viser.Icon.UPLOAD
    )

    async def uploaded(event: viser.GuiEvent[viser.GuiUploadButtonHandle]) -> None:
        file = event.target.value

        def open_upload() -> None:
            uri = store_upload(file.name, file.content, session.files)
            session.open_address(Address("robot", (uri,)))

        session.enqueue(open_upload)

    upload.on_upload(uploaded)
    add_controls(gallery)
    add_sheet_buttons(gallery)


def library_links(files: FileAccess) -> str:
    """Return links to the robots of the current folder, the splits and the grammars."""
    root = files.roots[0]
    folders = [*robot_subfolders(root), "robots"]
    folders += [f"robots/{name}" for name in robot_subfolders(root / "robots")]
    folders = [name for name in dict.fromkeys(folders) if (root / name).is_dir()]
    sections = [
        ("Robots", [(name, Address("gallery", (name,))) for name in folders]),
        ("Splits", [(name, Address("split", (name,))) for name in split_names()]),
        ("Categories", [(name, Address("compose", (name,))) for name in grammar_names()]),
        ("New", [("compose a robot", Address("compose", ("arm=ur5 ee=plane",)))]),
    ]
    return "".join(
        f"<h3>{title}</h3>" + " · ".join(markup.link(address, text) for text, address in links)
        for title, links in sections
        if links
    )
