"""Where in a URDF something is found."""

from __future__ import annotations

from dataclasses import dataclass

from lxml import etree

from morphgen.model.findings import Finding

SHOWN_TEXT = 80
"""Characters of a text that a message shows."""


@dataclass(frozen=True)
class Place:
    """The link, joint or robot that an element belongs to."""

    origin: str
    """Name of the file."""
    owner: str
    """Such as ``link 'base'``."""

    def finding(
        self,
        element: etree._Element,
        code: str,
        why: str,
        fix: str,
        repair: str = "",
    ) -> Finding:
        """A finding at the element's line: a warning if reading repairs it, else an error."""
        where = f"{self.origin}:{element.sourceline} {self.owner}"
        return Finding(code, "warning" if repair else "error", where, why, fix, repair)


def place_of(element: etree._Element, origin: str) -> Place:
    """The place named after a link, joint or other element at the top level."""
    name = element.get("name")
    return Place(
        origin, f"{element.tag} {shortened(name)!r}" if name else f"{element.tag} without a name"
    )


def shortened(text: str) -> str:
    """The beginning of a text, to be shown in a message."""
    return text if len(text) <= SHOWN_TEXT else f"{text[: SHOWN_TEXT - 3]}..."
