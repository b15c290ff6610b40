"""Parse XML from untrusted sources, without entities, and the schemas of XML formats.

Errors name line and column.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

from lxml import etree
from msgspec import field

from morphgen.errors import FormatError
from morphgen.files import xml_parser
from morphgen.formats.data_files import parse_yaml
from morphgen.formats.records import Record, read_record
from morphgen.model.findings import Finding, texts_of

found = texts_of(Path(__file__).with_name("findings.yaml"))
"""Return the finding of a row of ``findings.yaml``."""
_LOCATION = re.compile(r",? line \d+, column \d+.*$", re.DOTALL)
_ENCODING = re.compile(rb"""<\?xml[^>]{0,200}?encoding\s*=\s*["']([\w.:-]{1,40})["']""")
# Those without an end match up to that of the text, or the search would take quadratic time.
_COMMENT = re.compile(r"<!--.*?(-->|\Z)", re.DOTALL)
_INSTRUCTION = re.compile(r"<\?.*?(\?>|\Z)", re.DOTALL)
_SOUND_DECLARATION = re.compile(r"""\A<\?xml\s[^>]*?version\s*=\s*["']1\.[0-9]+["']""")
_ROOT = re.compile(r"<([^\W\d][^\s<>/]*)")
_INVALID = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_PREFIX = re.compile(r"Namespace prefix (\S+) ")
_UNDECLARED = "undeclared:"  # begin of the namespace of a prefix that the document does not declare
_MAX_PREFIXES = 20  # largest number of such prefixes in a document that is repaired
_MAX_ERRORS = 100  # number of errors after which libxml2 reports no more


def parse_xml(data: bytes, origin: str) -> etree._Element:
    """Parse a document strictly and return its root element, without comments.

    Document type declarations are refused: entities are defined there, which could expand without
    bound ("billion laughs") or include other files.
    """
    try:
        root = etree.fromstring(data, xml_parser())
    except etree.XMLSyntaxError as error:
        line, column = error.position
        reason = " ".join(_LOCATION.sub("", error.msg or "not XML").split())
        raise FormatError(f"{origin}:{line}:{column}: not well-formed XML: {reason}") from error
    if root.getroottree().docinfo.internalDTD is not None:
        raise _doctype_error(origin)
    return root


def parse_description(data: bytes, origin: str) -> tuple[etree._Element, tuple[Finding, ...]]:
    """Parse a robot description as tolerantly as robot software does; return warnings, too.

    Repaired is what tinyxml2, which Pinocchio, PyBullet and MuJoCo use, or libxml2's recovery,
    which yourdfpy uses, read without a doubt. What has two meanings is refused, a DOCTYPE always,
    and entities are never expanded.
    """
    try:
        return parse_xml(data, origin), ()
    except FormatError:
        text, findings = _repaired(data, origin)
        if "<!DOCTYPE" in text.upper():
            raise _doctype_error(origin) from None
        if "<!--" in text or "<?" in text:  # without an end; libxml2 takes quadratic time
            raise
        root, more = _recovered(text, origin)
        if root is None:
            raise
        return root, (*findings, *more)


def root_tag(data: bytes) -> str | None:
    """Return the tag of a document's root element, with its prefix; None if it has none."""
    match = _ROOT.search(_repaired(data, "")[0])
    return match and match[1]


def _decoded(data: bytes) -> tuple[str, str, str]:
    """Return a document's text, its declared encoding, and the one read: that, UTF-8 or Latin-1."""
    if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return data.decode("utf-16", errors="replace"), "utf-16", "utf-16"
    data = data.removeprefix(codecs.BOM_UTF8)
    match = _ENCODING.match(data.lstrip())
    declared = "utf-8" if match is None else match[1].decode()
    for encoding in dict.fromkeys((declared, "utf-8", "latin1")):
        with suppress(LookupError, UnicodeDecodeError):
            etree.XMLParser(encoding=encoding)  # knows fewer, safe encodings
            text = data.decode(encoding)
            if match is None or text.lstrip().startswith("<?xml"):
                break
    return text, declared, encoding


def _blank(match: re.Match[str]) -> str:
    """Return a text of as many lines; what has no end stays."""
    return "\n" * match[0].count("\n") if match[1] else match[0]


def _is_invalid_comment(comment: re.Match[str]) -> bool:
    return "--" in comment[0][4:-2] or _INVALID.search(comment[0]) is not None


def _is_invalid_declaration(instruction: re.Match[str]) -> bool:
    is_sound = instruction.start() == 0 and _SOUND_DECLARATION.match(instruction[0])
    return instruction[0][:5].lower() == "<?xml" and not is_sound


_BARE = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#[1-9][0-9]{0,5}|#x[1-9A-Fa-f][0-9A-Fa-f]{0,4});)")
_REPLACEMENTS: dict[re.Pattern[str], tuple[Any, Callable[[re.Match[str]], bool], str, str]] = {
    _COMMENT: (_blank, _is_invalid_comment, "comments with '--' or bad characters", "left out"),
    _INSTRUCTION: (_blank, _is_invalid_declaration, "a declaration not of XML 1", "left out"),
    re.compile(r"\A\s*([^<\s][^<]*)"): (_blank, bool, "text before the root element", "left out"),
    _BARE: ("&amp;", bool, "a bare '&'", "kept"),
    _INVALID: ("\ufffd", bool, "a character that XML does not allow", "read as U+FFFD"),
}
"""Patterns that are replaced, in this order: by what, which matches are faults, the fault and its
repair."""
_RECOVERED = {
    "ERR_DOCUMENT_END": ("text after the root element", "left out"),
    "ERR_LT_IN_ATTRIBUTE": ("'<' in an attribute", "kept"),
    "ERR_MISPLACED_CDATA_END": ("']]>' in a text", "kept"),
}
"""Errors that libxml2 recovers from as other robot software does: the fault and its repair."""


def _repaired(data: bytes, origin: str) -> tuple[str, list[Finding]]:
    """Return a document without comments and instructions, and what was repaired by patterns."""
    text, declared, encoding = _decoded(data)
    findings = []
    if encoding != declared:
        what = f"an encoding other than {declared!r}"
        findings.append(_finding(f"{origin}:1", 1, what, f"read as {encoding}"))
    for pattern, (new, is_fault, what, repair) in _REPLACEMENTS.items():
        faults = [match.start() for match in pattern.finditer(text) if is_fault(match)]
        if faults:
            line = text.count("\n", 0, faults[0]) + 1
            code = "xml-declaration" if pattern is _INSTRUCTION else "xml-repaired"
            findings.append(_finding(f"{origin}:{line}", len(faults), what, repair, code))
        text = pattern.sub(new, text)
    return text, findings


def _recovered(text: str, origin: str) -> tuple[etree._Element | None, list[Finding]]:
    """Parse a document as libxml2 recovers it; None if that may not be what its author meant."""
    prefixes: dict[str, int] = {}  # undeclared ones, with the line of their first use
    missing = {"": 0}
    while missing and len(prefixes) <= _MAX_PREFIXES:
        spaces = "".join(f' xmlns:{name}="{_UNDECLARED}{name}"' for name in prefixes)
        parser = xml_parser(recover=True)
        declared = _ROOT.sub(lambda match: match[0] + spaces, text, count=1)  # noqa: B023
        root: etree._Element | None = etree.fromstring(declared.encode() or b" ", parser)
        errors = [*parser.error_log]
        missing = {}
        for error in errors:
            match = _PREFIX.match(error.message)
            if match and match[1] not in prefixes:  # one that stays undeclared is an error below
                missing.setdefault(match[1], error.line)
        prefixes |= missing
    lines: dict[str, list[int]] = {}
    for error in errors:
        lines.setdefault(error.type_name, []).append(error.line)
    if root is None or not _RECOVERED.keys() >= lines.keys() or len(errors) >= _MAX_ERRORS:
        return None, []
    findings = [
        _finding(f"{origin}:{first}", len(others) + 1, *_RECOVERED[kind])
        for kind, (first, *others) in lines.items()
    ]
    for name, line in prefixes.items():
        what = f"elements and attributes with the undeclared prefix {name!r}"
        findings.append(_finding(f"{origin}:{line}", 1, what, "left out", "prefix-undeclared"))
    return root, findings


def _finding(where: str, count: int, what: str, repair: str, code: str = "xml-repaired") -> Finding:
    times = f" ({count} times)" if count > 1 else ""
    return found(code, f"{where} document", what=what, times=times, how=repair)


def _doctype_error(origin: str) -> FormatError:
    return FormatError(f"{origin}: has a DOCTYPE; a robot description needs none, remove it")


class Attribute(NamedTuple):
    """An attribute of an element."""

    name: str
    counts: tuple[int, ...]  # valid counts of numbers; empty for a text
    required: bool
    positive: bool  # whether its numbers are lengths


class Schema(Record, frozen=True, dict=True):
    """A format in ``schemas.yaml``, which says what its keys mean."""

    elements: dict[str, str]
    left_out: str = ""
    counted: str = ""
    refused: dict[str, str] = field(default_factory=dict)
    expected: dict[str, dict[str, str]] = field(default_factory=dict)

    @cached_property
    def attributes(self) -> dict[str, list[Attribute]]:
        """Attributes that are read by element."""
        found = {
            tag: re.findall(r"(\w+)(=[\d,]*)?(!?)(\+?)", rule.partition(">")[0])
            for tag, rule in self.elements.items()
        }
        return {
            tag: [
                Attribute(name, tuple(map(int, re.findall(r"\d+", counts))), bool(mark), bool(plus))
                for name, counts, mark, plus in words
            ]
            for tag, words in found.items()
        }

    @cached_property
    def children(self) -> dict[str, dict[str, str]]:
        """Children by element, each with its mark."""
        return {
            tag: dict(re.findall(r"(\w+)([*?]?)", rule.partition(">")[2]))
            for tag, rule in self.elements.items()
        }


def read_schema(name: str) -> Schema:
    """Return the schema of a format."""
    return _schemas()[name]


@cache
def _schemas() -> dict[str, Schema]:
    path = Path(__file__).with_name("schemas.yaml")
    return read_record(parse_yaml(path.read_text("utf-8"), str(path)), dict[str, Schema], str(path))
