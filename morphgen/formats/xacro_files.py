"""Read and write the XML and YAML documents of a xacro expansion.

The sizes of files and documents are bounded. Every element keeps its file and line for messages.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias
from xml.dom import expatbuilder, minidom
from xml.sax.saxutils import escape, quoteattr

import yaml

from morphgen.errors import FormatError
from morphgen.formats.data_files import read_bytes, yaml_problem
from morphgen.formats.xacro_functions import MAX_SIZE, RefusedError, size_of

MAX_FILE = 16 * 2**20
"""Largest file that an expansion reads [bytes]."""
MAX_OUTPUT = 20_000_000
"""Largest expanded document [characters]."""
MAX_CLONES = 200_000
"""Largest number of elements that an expansion may copy, as macros do; the PR2 has 6,978 nodes."""

Untyped: TypeAlias = Any
"""Objects of minidom and xacro, which have no type hints."""

_LOCATION = "morphgen-location"


def read_file(path: Path) -> bytes:
    """Return the content of a regular file; a device or a pipe might never end.

    Raises:
        OSError: If it cannot be read.
        RefusedError: If it is not a regular file, or too large.
    """
    try:
        return read_bytes(path, MAX_FILE)
    except FormatError as error:
        raise RefusedError(str(error)) from error


def location_of(node: Untyped) -> str:
    """Return ``file:line`` of an element that ``ElementLocations`` parsed, or of a clone of it."""
    return str(node.getUserData(_LOCATION))


class ElementLocations:
    """Source locations of the elements of an expansion; a DOM ``UserDataHandler``.

    minidom calls it for every clone of an element, which gets the location of the original. The
    clones are counted, because macros can multiply them.
    """

    def __init__(self) -> None:
        self.clones = 0

    def parse(self, data: bytes, origin: str) -> minidom.Document:
        """Parse XML and store the location of every element."""
        document = _Builder(origin, self).parseString(data)
        assert isinstance(document, minidom.Document)
        return document

    def handle(
        self, operation: int, key: str, location: object, source: object, clone: Untyped
    ) -> None:
        """Store the location of a clone; minidom calls this.

        Raises:
            RefusedError: If there are more than ``MAX_CLONES``.
        """
        del operation, source
        clone.setUserData(key, location, self)
        self.clones += 1
        if self.clones > MAX_CLONES:
            raise RefusedError(f"the expansion copies more than {MAX_CLONES} elements")


class _Builder(expatbuilder.ExpatBuilderNS):
    def __init__(self, origin: str, locations: ElementLocations) -> None:
        super().__init__()
        self.origin = origin
        self.locations = locations

    def start_element_handler(self, name: Untyped, attributes: Untyped) -> None:
        super().start_element_handler(name, attributes)
        location = f"{self.origin}:{self.getParser().CurrentLineNumber}"
        self.curNode.setUserData(_LOCATION, location, self.locations)


def parse_yaml(data: bytes, path: Path, units: Iterable[Untyped]) -> object:
    """Parse a YAML file of texts, numbers, lists and dictionaries.

    Args:
        data: The file's content.
        path: The file, for messages.
        units: xacro's unit tags.

    Raises:
        FormatError: If it is invalid YAML.
        RefusedError: If it is too large with all aliases expanded.
    """

    class Loader(yaml.SafeLoader):
        """Safe YAML with xacro's unit tags, which must not be added to the shared loader."""

        def flatten_mapping(self, node: yaml.MappingNode) -> None:
            super().flatten_mapping(node)
            if len(node.value) > MAX_SIZE:
                raise RefusedError(f"{path}: a mapping has more than {MAX_SIZE} entries")

    for unit in units:
        Loader.add_constructor(unit.value.tag, unit.constructor)
    for tag in ("set", "binary"):
        Loader.add_constructor(f"tag:yaml.org,2002:{tag}", _refuse_tag)
    try:
        content = yaml.load(data, Loader)
    except yaml.YAMLError as error:
        raise FormatError(f"{path}{yaml_problem(error)}") from error
    size_of(content)
    return content


def _refuse_tag(loader: yaml.SafeLoader, node: yaml.Node) -> object:
    del loader
    raise yaml.constructor.ConstructorError(
        None, None, f"{node.tag} is neither text, number, list nor mapping", node.start_mark
    )


def document_text(document: minidom.Document) -> str:
    """Return a document as text.

    Raises:
        RefusedError: If it is too long.
    """
    pieces = []
    length = 0
    for piece in _serialised(document.documentElement):
        pieces.append(piece)
        length += len(piece)
        if length > MAX_OUTPUT:
            raise RefusedError(f"the expanded document has more than {MAX_OUTPUT} characters")
    return "".join(pieces)


def _serialised(node: minidom.Node | None) -> Iterator[str]:
    """Serialise a DOM; another user of xacro may have replaced ``minidom``'s own writer."""
    if isinstance(node, minidom.Text):
        yield escape(node.data)
    elif isinstance(node, minidom.Element):
        attributes = (f" {name}={quoteattr(value)}" for name, value in node.attributes.items())
        yield f"<{node.tagName}{''.join(attributes)}>"
        for child in node.childNodes:
            yield from _serialised(child)
        yield f"</{node.tagName}>"
