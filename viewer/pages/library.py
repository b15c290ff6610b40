"""The first page: all parts, with links to robots, splits and grammars, and the upload button."""

from __future__ import annotations

import viser

from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.app.uploads import store_upload
from morphgen.viewer.gallery import Gallery, add_controls, add_sheet_buttons, open_panels
from morphgen.viewer.pages.index import library_sections, section_links
from morphgen.viewer.robot_rows import part_rows
from morphgen.viewer.robot_uri import DEFAULT_WORDS

_COMPOSE = Address("compose", (DEFAULT_WORDS,))
INTRODUCTION = (
    "<p>morphgen makes robots from a base, arms and end-effectors, and trains and tests policies "
    f"on many of them.</p><p>{markup.button_link(_COMPOSE, 'Compose a robot')}</p>"
)
"""Text above the gallery of parts: the purpose of morphgen, and the link to Compose."""


def show(session: Session) -> None:
    """Build the page."""
    gallery = Gallery(session, "Parts", part_rows(session.files.library), noun="part")
    header = INTRODUCTION + section_links(library_sections(session.files))
    panel = open_panels(gallery, "", header)
    upload = session.client.gui.add_upload_button(
        "Open a URDF, an MJCF or a zip", icon=viser.Icon.UPLOAD
    )

    async def uploaded(event: viser.GuiEvent[viser.GuiUploadButtonHandle]) -> None:
        file = event.target.value

        def open_upload() -> None:
            uri = store_upload(file.name, file.content, session.files)
            session.open_address(Address("robot", (uri,)))

        session.enqueue(open_upload)

    upload.on_upload(uploaded)
    add_controls(gallery, panel)
    add_sheet_buttons(gallery)
