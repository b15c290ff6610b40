"""Parse XML from untrusted sources, without entities, and the schemas of XML formats.

Errors name line and column.
"""

from __future__ import annotations

import codecs
import re
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path
from typing import NamedTuple

from lxml import etree
from msgspec import field

from morphgen.errors import FormatError, shortened
from morphgen.formats.data_files import parse_yaml
from morphgen.formats.records import Record, read_record
from morphgen.model.findings import Finding

_LOCATION = re.compile(r",? line \d+, column \d+.*$", re.DOTALL)
_ENCODING = re.compile(rb"""<\?xml[^>]{0,200}?encoding\s*=\s*["']([\w.:-]{1,40})["']""")
_VERSION = re.compile(r"""\sversion\s*=\s*["']([^"'<>]{0,20})["']""")
_NAME = r"""[^\W\d][^\s<>/="'&!?]*"""
_START = re.compile(rf"<\s*({_NAME})")
_END = re.compile(rf"</{_NAME}\s*>")
_ATTRIBUTE = re.compile(rf"""(\s*)({_NAME})(\s*=\s*)("[^"]*"|'[^']*')""")
_CLOSE = re.compile(r"\s*(/?)>")
_MARKUP = re.compile(r"<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>|<![^>]*>", re.DOTALL)
_BARE = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#[1-9][0-9]{0,5}|#x[1-9A-Fa-f][0-9A-Fa-f]{0,4});)")
_SOUND_TAIL = re.compile(r"<!--(?:(?!--).)*-->|<\?.*?\?>", re.DOTALL)
_INVALID = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_UNDECLARED = "undeclared:"  # begin of the namespace of a prefix that the document does not declare
_MAX_PREFIXES = 20  # largest number of prefixes in a document that is repaired


def parse_xml(data: bytes, origin: str) -> etree._Element:
    """Parse a document strictly and return its root element.

    Document type declarations are refused, because entities are defined there: they could expand
    without bound ("billion laughs") or include other files. Comments and processing instructions
    are dropped, so that the text around them is a single string.
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
        reason = " ".join(_LOCATION.sub("", error.msg or "not XML").split())
        raise FormatError(f"{origin}:{line}:{column}: {reason}") from error
    if root.getroottree().docinfo.internalDTD is not None:
        raise _doctype_error(origin)
    return root


def parse_description(data: bytes, origin: str) -> tuple[etree._Element, tuple[Finding, ...]]:
    """Parse a robot description as tolerantly as robot software does.

    A document that is not valid XML is repaired where tinyxml2, which Pinocchio, PyBullet and
    MuJoCo use, or libxml2's recovery, which yourdfpy uses, read it without a doubt: comments with
    ``--``, a bare ``&``, ``<`` in an attribute, text before and after the root element, missing
    spaces between attributes, an invalid declaration or encoding, unprintable characters, and
    prefixes without a namespace. ``parse_xml`` then parses the repaired document. What has two
    meanings is refused: elements that are not closed, attributes that are repeated or without a
    value, a ``<`` in a text. A DOCTYPE is always refused, and entities are never expanded.

    Returns:
        The root element, and a warning for every kind of repair.
    """
    try:
        return parse_xml(data, origin), ()
    except FormatError as error:
        repair = _Repair(origin)
        if not repair.run(repair.decode(data)):
            raise
        return repair.result(str(error))


def root_tag(data: bytes) -> str | None:
    """Return the tag of a document's root element, with its prefix; None if it has none."""
    repair = _Repair("")
    with suppress(FormatError):
        repair.run(repair.decode(data), to_root=True)
    return repair.root


class _Repair:
    """Rewrites a document piece by piece; line numbers stay.

    Attributes:
        root: Tag of the root element, once it has begun.
    """

    def __init__(self, origin: str) -> None:
        self.root: str | None = None
        self._origin = origin
        self._pieces: list[str] = []
        self._line = 1
        self._after_root_name = 0
        self._declared: set[str] = set()
        self._prefixes: dict[str, int] = {}
        self._faults: dict[str, tuple[Finding, int]] = {}

    def decode(self, data: bytes) -> str:
        """Return the text of a document: in the declared encoding, else UTF-8, else Latin-1."""
        if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            return data.decode("utf-16", errors="replace")
        data = data.removeprefix(codecs.BOM_UTF8)
        match = _ENCODING.match(data.lstrip())
        declared = "utf-8" if match is None else match[1].decode()
        for encoding in dict.fromkeys((declared, "utf-8", "latin1")):
            with suppress(LookupError, UnicodeDecodeError):
                etree.XMLParser(encoding=encoding)  # knows fewer, safe encodings
                text = data.decode(encoding)
                if match is None or text.lstrip().startswith("<?xml"):
                    break
        if encoding != declared:
            why, repair = f"its encoding is not {declared!r}", f"it was read as {encoding}"
            self._note(why, "save it as UTF-8", repair)
        return text

    def run(self, text: str, *, to_root: bool = False) -> bool:
        """Rewrite a text, or what comes up to its root; return whether it was understood."""
        position = depth = 0
        while position < len(text) and (depth or self.root is None):
            if text[position] != "<":
                end = text.find("<", position)
                end = len(text) if end < 0 else end
                self._text(text[position:end], is_inside=depth > 0)
            elif markup := _MARKUP.match(text, position):
                end = markup.end()
                if not self._markup(markup[0]):
                    return False
            elif tag := _END.match(text, position):
                end = tag.end()
                self._put(tag[0], tag[0])
                depth -= 1
            else:
                end = self._start(text, position)
                if end == 0 or to_root:
                    return end > 0
                depth += text[end - 2] != "/"
            position = end
        return self.root is not None and self._end(text[position:])

    def result(self, fault: str) -> tuple[etree._Element, tuple[Finding, ...]]:
        """Parse what was rewritten; return its root, and a finding for each kind of repair."""
        undeclared = [name for name in self._prefixes if name not in self._declared]
        namespaces = "".join(f' xmlns:{name}="{_UNDECLARED}{name}"' for name in undeclared)
        self._pieces.insert(self._after_root_name, namespaces)
        root = parse_xml("".join(self._pieces).encode(), self._origin)
        names = (name for element in root.iter("*") for name in (element.tag, *element.keys()))
        used = {etree.QName(name).namespace for name in names}
        for name in undeclared:
            if f"{_UNDECLARED}{name}" in used:
                self._line = self._prefixes[name]
                self._note(
                    f"the prefix {name!r} is used but not declared",
                    f'declare it by xmlns:{name}="..."',
                    f"elements and attributes with the undeclared prefix {name!r} were left out",
                    "prefix-undeclared",
                )
        if not self._faults:
            why = fault.removeprefix(f"{self._origin}:")
            self._note(f"it is not valid XML: {why}", "correct it", "it was read as tinyxml2 does")
        findings = (
            replace(first, why=f"{first.why} ({count} times)" if count > 1 else first.why)
            for first, count in self._faults.values()
        )
        return root, tuple(findings)

    def _note(self, why: str, fix: str, repair: str, code: str = "xml-repaired") -> None:
        """Add a finding; those with the same repair are counted."""
        where = f"{self._origin}:{self._line} document"
        first, count = self._faults.get(repair, (None, 0))
        self._faults[repair] = first or Finding(code, "warning", where, why, fix, repair), count + 1

    def _put(self, original: str, repaired: str) -> None:
        self._pieces.append(repaired)
        self._line += original.count("\n")

    def _blank(self, original: str) -> None:
        self._put(original, "\n" * original.count("\n"))

    def _text(self, text: str, *, is_inside: bool) -> None:
        if is_inside:
            self._put(text, self._escaped(text).replace("]]>", "]]&gt;"))
            return
        if text.strip():
            why = f"{_excerpt(text)} stands before the root element"
            self._note(why, "remove it", "text before the root element was left out")
        self._blank(text)

    def _escaped(self, text: str) -> str:
        """Return a text or attribute with ``&`` as an entity and printable characters only."""
        if _BARE.search(text):
            self._note(f"a bare '&' in {_excerpt(text)}", "write &amp;", "a bare '&' was kept")
        if _INVALID.search(text):
            why = f"a character that XML does not allow in {_excerpt(text)}"
            self._note(why, "remove it", "a character that XML does not allow was read as U+FFFD")
        return _INVALID.sub("\ufffd", _BARE.sub("&amp;", text))

    def _markup(self, markup: str) -> bool:
        """Rewrite a comment, instruction, declaration or CDATA; return whether it is allowed."""
        if markup.startswith("<![CDATA["):
            self._put(markup, markup)
            return markup.endswith("]]>")
        if markup[:9].upper() == "<!DOCTYPE":
            raise _doctype_error(self._origin)
        if markup.startswith("<!--"):
            if not markup.endswith("-->"):
                return False
            if "--" in markup[4:-3] or markup.endswith("--->") or _INVALID.search(markup):
                why = f"the comment {_excerpt(markup)} holds '--' or a character that XML forbids"
                self._note(why, "write single hyphens", "invalid comments were left out")
        elif markup[:5].lower() == "<?xml":
            self._declaration(markup)
        elif markup.startswith("<!"):
            why = f"{_excerpt(markup)} is not XML"
            self._note(why, "remove it", f"{_excerpt(markup)} was left out")
        self._blank(markup)
        return True

    def _declaration(self, markup: str) -> None:
        version = _VERSION.search(markup)
        number = "" if version is None else version[1]
        if not re.fullmatch(r"1\.[0-9]+", number):
            why, repair = f"it declares XML version {number!r}", "its XML version was read as 1.0"
            self._note(why, 'write version="1.0"', repair, "xml-declaration")
        if self._pieces:
            why = "there is white space or another text before the XML declaration"
            repair = "white space before the XML declaration was left out"
            self._note(why, "begin the file with <?xml", repair, "xml-declaration")

    def _start(self, text: str, begin: int) -> int:
        """Rewrite a start tag; return its end, or 0 if it is malformed."""
        tag = _START.match(text, begin)
        if tag is None:
            return 0
        names, words, end = [tag[1]], [], tag.end()
        while attribute := _ATTRIBUTE.match(text, end):
            blank, name, equals, value = attribute.groups()
            end = attribute.end()
            if name.startswith("xmlns:") and not value[1:-1].strip():
                continue  # a namespace without a name declares nothing
            names.append(name)
            if not blank or "<" in value:
                why = f"'<' or no space before {_excerpt(name + equals + value)}"
                fix = "write &lt;, and a space before each attribute"
                self._note(why, fix, "attributes with '<' or without a space were read")
            words.append(f"{blank or ' '}{name}{equals}{self._escaped(value).replace('<', '&lt;')}")
        close = _CLOSE.match(text, end)
        if close is None:
            return 0
        self._pieces.append(f"<{tag[1]}")
        for name in names:
            prefix, colon, local = name.partition(":")
            if prefix == "xmlns" and self.root is None:
                self._declared.add(local)
            elif colon and prefix not in ("xml", "xmlns"):
                self._prefixes.setdefault(prefix, self._line)
        if self.root is None:
            self.root, self._after_root_name = tag[1], len(self._pieces)
        self._put(text[begin : close.end()], "".join(words) + close[0])
        return close.end()

    def _end(self, rest: str) -> bool:
        """Leave out what follows the root element; return whether it may be left out."""
        surplus = _SOUND_TAIL.sub("", rest).strip()
        if surplus:
            self._line += rest[: rest.find(surplus[0])].count("\n")
            why = f"{_excerpt(surplus)} follows the root element"
            self._note(why, "remove it", "text after the root element was left out")
        if "<!DOCTYPE" in surplus.upper():
            raise _doctype_error(self._origin)
        return len(self._prefixes) <= _MAX_PREFIXES


def _doctype_error(origin: str) -> FormatError:
    return FormatError(f"{origin}: has a DOCTYPE; a robot description needs none, remove it")


def _excerpt(text: str) -> str:
    return repr(shortened(" ".join(text.split())))


class Attribute(NamedTuple):
    """An attribute of an element."""

    name: str
    counts: tuple[int, ...]  # valid counts of numbers, 0 for any but none; empty for a text
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
