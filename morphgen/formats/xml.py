"""Read XML that comes from anywhere: no entities, no surprises, errors with a place."""

from __future__ import annotations

import re

from lxml import etree

from morphgen.errors import FormatError

_PLACE = re.compile(r",? line \d+, column \d+.*$", re.DOTALL)


def parse_xml(data: bytes, origin: str) -> etree._Element:
    """Parse a document strictly and return its root element.

    A document type declaration is refused, and with it every way to define an entity: neither an
    entity bomb nor a reference to another file gets through. Comments and processing instructions
    are dropped, so that text on both sides of one is a single string.

    Args:
        data: The document's bytes; its own encoding declaration is respected.
        origin: What to call the document in errors, usually its path.

    Raises:
        FormatError: The document is broken (``origin:line:column: reason``) or has a DOCTYPE.
    """
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        remove_comments=True,
        remove_pis=True,
    )
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        line, column = error.position
        reason = " ".join(_PLACE.sub("", error.msg or "not XML").split())
        raise FormatError(f"{origin}:{line}:{column}: {reason}") from error
    if root.getroottree().docinfo.internalDTD is not None:
        raise FormatError(f"{origin}: has a DOCTYPE; a robot description needs none, remove it")
    return root
