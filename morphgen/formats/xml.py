"""Parse XML from untrusted sources: without entities, with errors that name line and column."""

from __future__ import annotations

import re
from contextlib import suppress

from lxml import etree

from morphgen.errors import FormatError
from morphgen.model.findings import Finding

_LOCATION = re.compile(r",? line \d+, column \d+.*$", re.DOTALL)
_DECLARATION = re.compile(rb"<\?xml\s[^>]*\?>")
_VERSION = re.compile(rb"""(<\?xml\s+version\s*=\s*["'])([^"'<>]{0,20})(?=["'])""")
_START_TAG = re.compile(rb"<[A-Za-z_][^\s/>]*")
_UNDECLARED = re.compile(r"Namespace prefix ([A-Za-z_][\w.-]*) ", re.ASCII)
_BOM = b"\xef\xbb\xbf"
_MAX_PREFIXES = 20
"""Largest number of undeclared prefixes in a document that is read."""


def parse_xml(data: bytes, origin: str) -> etree._Element:
    """Parse a document strictly and return its root element.

    Document type declarations are refused, because entities are defined there: they could expand
    without bound ("billion laughs") or include other files. Comments and processing instructions
    are dropped, so that the text around them is a single string.

    Args:
        data: The document's bytes; its own encoding declaration is respected.
        origin: Name of the document in errors, usually its path.

    Raises:
        FormatError: The document is broken (``origin:line:column: reason``) or has a DOCTYPE.
    """
    parser = _parser()
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        line, column = error.position
        reason = " ".join(_LOCATION.sub("", error.msg or "not XML").split())
        raise FormatError(f"{origin}:{line}:{column}: {reason}") from error
    if root.getroottree().docinfo.internalDTD is not None:
        raise FormatError(f"{origin}: has a DOCTYPE; a robot description needs none, remove it")
    return root


def parse_description(data: bytes, origin: str) -> tuple[etree._Element, tuple[Finding, ...]]:
    """Parse a robot description as tolerantly as robot software does.

    Three faults that ROS and PyBullet tolerate are repaired: white space before the XML
    declaration, an unknown declared version, and prefixes without a declared namespace. Then
    ``parse_xml`` parses the document.

    Args:
        data: The document's bytes.
        origin: Name of the document in errors, usually its path.

    Returns:
        The root element, and a warning for every repair.

    Raises:
        FormatError: As ``parse_xml``.
    """
    data, findings = _with_sound_declaration(data, origin)
    try:
        return parse_xml(data, origin), tuple(findings)
    except FormatError:
        prefixes = _undeclared_prefixes(data)
        if not prefixes:
            raise
    findings += [
        Finding(
            "prefix-undeclared",
            "warning",
            f"{origin}: document",
            f"the prefix {prefix!r} is used but not declared",
            f'declare it by xmlns:{prefix}="..."',
            f"elements and attributes with the undeclared prefix {prefix!r} were left out",
        )
        for prefix in prefixes
    ]
    return parse_xml(_with_prefixes(data, prefixes), origin), tuple(findings)


def _parser() -> etree.XMLParser:
    return etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        remove_comments=True,
        remove_pis=True,
    )


def _with_sound_declaration(data: bytes, origin: str) -> tuple[bytes, list[Finding]]:
    """Return the document with its XML declaration at the start and an existing version."""
    findings = []
    body = data.removeprefix(_BOM)
    blank = body[: len(body) - len(body.lstrip())]
    match = _DECLARATION.match(body, len(blank))
    if match is None:
        return data, []
    declaration, rest = match[0], body[match.end() :]
    version = _VERSION.match(declaration)
    if version is not None and not re.fullmatch(rb"1\.[0-9]+", version[2]):
        declaration = version[1] + b"1.0" + declaration[version.end() :]
        findings.append(
            Finding(
                "xml-declaration",
                "warning",
                f"{origin}:1 document",
                f"it declares XML version {version[2].decode(errors='replace')!r}",
                'write version="1.0"',
                "its XML version was read as 1.0",
            )
        )
    if blank:
        findings.append(
            Finding(
                "xml-declaration",
                "warning",
                f"{origin}:1 document",
                "there is white space before the XML declaration",
                "begin the file with <?xml",
                "white space before the XML declaration was left out",
            )
        )
    # The white space moves behind the declaration, so that line numbers do not change.
    return (declaration + blank + rest, findings) if findings else (data, [])


def _undeclared_prefixes(data: bytes) -> list[str]:
    """Return prefixes without a namespace, in order; none if there are too many."""
    prefixes: list[str] = []
    while len(prefixes) <= _MAX_PREFIXES:
        parser = _parser()
        with suppress(etree.XMLSyntaxError):
            etree.fromstring(_with_prefixes(data, prefixes), parser)
        # The log ends after 100 errors; further prefixes appear in the next round.
        matches = [_UNDECLARED.match(entry.message or "") for entry in parser.error_log]
        names = dict.fromkeys(match[1] for match in matches if match is not None)
        new = [name for name in names if name not in prefixes]
        if not new:
            return prefixes
        prefixes += new
    return []


def _with_prefixes(data: bytes, prefixes: list[str]) -> bytes:
    """Return the document with prefixes declared in its first start tag."""
    position = 0
    while prefixes:
        position = data.find(b"<", position)
        tag = _START_TAG.match(data, max(position, 0))
        if tag is not None:
            declared = "".join(f' xmlns:{name}="undeclared:{name}"' for name in prefixes)
            return data[: tag.end()] + declared.encode() + data[tag.end() :]
        end = data.find(b"-->" if data.startswith(b"<!--", position) else b">", position)
        if position < 0 or end < 0:
            break
        position = end
    return data
