"""Read MJCF documents from untrusted sources: one text without files, and the meshes it names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from lxml import etree

from morphgen.errors import FormatError
from morphgen.formats.data_files import read_bytes
from morphgen.formats.resolve import PackageFinder, require_allowed_text, resolve_uri
from morphgen.formats.urdf.read import UnsoundError
from morphgen.formats.urdf.schema import MAX_LINKS, counted_elements
from morphgen.formats.xacro.evaluator import RefusedError
from morphgen.formats.xml import found, parse_description, read_schema
from morphgen.model.findings import Finding
from morphgen.model.mesh import require_bounded_files

MAX_MJCF_BYTES = 8 * 2**20  # largest MJCF that is read, with all its includes [bytes]
MAX_INCLUDES = 100  # largest number of files that an MJCF includes
MAX_DEPTH = 40  # deepest nesting of includes
MAX_ELEMENTS = {"*": 20_000, "body": MAX_LINKS, "default": 1000, "mesh": 2000}
"""Largest number of elements of an MJCF with its includes, of all tags and of some. MuJoCo's time
grows with the square of it."""
GEOM_TYPES = "box, sphere, cylinder, capsule, ellipsoid or mesh"
"""Types of geoms that a robot can have, for errors."""

_SCHEMA = read_schema("mjcf")
_LEFT_OUT = _SCHEMA.left_out.split()
_FILES = re.compile(r"file|file(back|down|front|left|right|up)|(asset|mesh|texture)dir")
"""Attributes that name files or folders."""
_ALLOCATING = ("user", "act", "actdim", "nsample", "delay", "interp")
"""Attributes by which MuJoCo allocates memory, for values that a robot does not have."""
_LINE = re.compile(r",? line \d+(, column \d+)?")


@dataclass(frozen=True)
class MjcfDocument:
    """An MJCF document that names no file."""

    path: Path  # the file that it was read from
    name: str  # name of the model; that of the file if the document has none
    text: str
    """The document with includes inserted, without the sections that a robot does not need."""
    meshes: Mapping[str, Path]
    """File of every mesh asset by name; assets with vertices in the document have none until
    ``inline_meshes`` adds it."""
    includes: tuple[Path, ...] = ()  # files whose content is inserted
    findings: tuple[Finding, ...] = ()
    """Repairs without which the document could not be parsed, and what is left out."""

    def error(self, why: str) -> FormatError:
        """Return an error about the document, without the lines of the text with includes."""
        return FormatError(f"{self.path}: {' '.join(_LINE.sub('', why).split())}")


def read_document(path: Path, finder: PackageFinder, *, with_options: bool = False) -> MjcfDocument:
    """Read an MJCF with its includes, and resolve the files of its meshes; see docs/importing.md.

    Textures, height fields and skins are not read. MuJoCo gets the elements of an allow-list. It
    ignores namespaces, which would hide an element from that list, so names with one are refused.
    """
    includes = _Includes(path, finder)
    root, findings = includes.read(path, 0)
    etree.cleanup_namespaces(root)  # declarations that no name uses are harmless
    _require_few_elements(root, path)
    if not with_options:
        for element in [*root.iterchildren("option")]:
            root.remove(element)
    for field in root.iterfind("asset/hfield"):
        field.set("name", field.get("name") or PurePosixPath(field.get("file", "")).stem)
        _drop(field, "file", "content_type", "elevation")
        # Without a file MuJoCo needs sizes; the smallest ones take no memory.
        field.set("nrow", "2")
        field.set("ncol", "2")
    for element in root.iter("material", "light"):
        _drop(element, "texture")
    meshes = _take_mesh_files(root, path, finder)
    for element in root.iter():
        _drop(element, *_ALLOCATING)
        if named := [key for key in element.attrib if _FILES.fullmatch(str(key))]:
            raise FormatError(
                f"{path}: <{element.tag}> has the attribute {named[0]!r}; only assets, includes "
                "and the compiler name files"
            )
    where = str(path)
    return MjcfDocument(
        path,
        root.get("model") or path.stem,
        etree.tostring(root, encoding="unicode"),
        meshes,
        tuple(sorted(includes.seen - {path.resolve()})),
        tuple(replace(f, where=f"{path.name}{f.where.removeprefix(where)}") for f in findings),
    )


class _Includes:
    """Reads a document and inserts the files that it includes, each at most once."""

    def __init__(self, main: Path, finder: PackageFinder) -> None:
        self._main = main
        self._finder = finder
        self.seen: set[Path] = set()  # files read so far, links resolved
        self._bytes_left = MAX_MJCF_BYTES

    def read(self, path: Path, depth: int) -> tuple[etree._Element, tuple[Finding, ...]]:
        """Return the root of a file with its includes inserted, and what was repaired."""
        self._require_bounded(path, depth)
        if self._bytes_left <= 0:
            raise FormatError(
                f"{path}: holds more than {MAX_MJCF_BYTES} bytes with its includes, the most that "
                "is read"
            )
        data = read_bytes(path, self._bytes_left)
        self._bytes_left -= len(data)
        root, findings = parse_description(data, str(path))
        findings = (*findings, *_left_out_findings(root, path))
        _keep_known(root, path)
        for element in [*root.iter("include")]:
            included = self._file(element, path)
            child, more = self.read(included, depth + 1)
            findings = (*findings, *more)
            parent = element.getparent()
            if parent is None:
                raise FormatError(f"{path}: the root element is <include>, not <mujoco>")
            at = parent.index(element)
            parent[at : at + 1] = [*child]
        return root, findings

    def _require_bounded(self, path: Path, depth: int) -> None:
        real = path.resolve()
        if real in self.seen:
            raise FormatError(f"{path}: is included twice; MJCF includes a file once")
        if depth > MAX_DEPTH:
            raise FormatError(f"{path}: includes are nested deeper than {MAX_DEPTH} levels")
        if len(self.seen) > MAX_INCLUDES:
            raise FormatError(f"{self._main}: includes more than {MAX_INCLUDES} files")
        self.seen.add(real)

    def _file(self, element: etree._Element, includer: Path) -> Path:
        where = f"{includer}:{element.sourceline}"
        name = element.get("file", "")
        if not name.strip():
            raise FormatError(f"{where}: <include> names no file")
        # MuJoCo searches the folder of the main file, then that of the file with the <include>.
        bases = [self._main]
        if not (self._main.parent / name).is_file() and (includer.parent / name).is_file():
            bases = [includer]
        file = resolve_uri(name, bases[0], self._finder)
        try:
            require_allowed_text(file, self._finder, self._main, includer)
        except RefusedError as error:
            raise FormatError(f"{where}: {error}") from error
        return file


def _keep_known(root: etree._Element, path: Path) -> None:
    """Remove what a robot does not need from a file, and refuse what MuJoCo must not get."""
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise FormatError(f"{path}: the root element is <{root.tag}>, not <mujoco>")
    for element in [*root.iter()]:
        tag = str(element.tag)
        for attribute in map(etree.QName, (tag, *map(str, element.attrib))):
            if attribute.namespace is not None:
                raise FormatError(
                    f"{path}:{element.sourceline}: {attribute.localname!r} has the namespace "
                    f"{attribute.namespace!r}; names in an MJCF have none, remove it"
                )
        if tag in _SCHEMA.refused:
            name = element.get("name") or element.get("plugin") or element.get("model")
            label = f"<{tag}>" if name is None else f"<{tag}> {name!r}"
            raise FormatError(f"{path}: {label} is refused: {_SCHEMA.refused[tag]}")
        if tag == "mesh" and "builtin" in element.attrib:
            raise FormatError(
                f"{path}: mesh {element.get('name')!r} is built in MuJoCo; give it a file, or use "
                "a primitive geom"
            )
    for element in [*root.iter(*_LEFT_OUT)]:
        remove_element(element)
    for element in root.iter():
        if element.tag not in _SCHEMA.elements:
            raise FormatError(
                f"{path}:{element.sourceline}: <{element.tag}> is no element of MJCF that is read"
            )


def _left_out_findings(root: etree._Element, path: Path) -> Iterator[Finding]:
    """Count what is left out of a file: elements by their parent, attributes by their element."""
    elements: dict[tuple[str, str], list[etree._Element]] = {}
    attributes: dict[str, list[tuple[etree._Element, str]]] = {}
    skipped = frozenset([*_LEFT_OUT, *_SCHEMA.counted.split()])
    todo = [root]
    while todo:
        element = todo.pop()
        tag, names = str(element.tag), [str(name) for name in element.attrib]
        unheld = (*_SCHEMA.elements.get(tag, "").split(), *_ALLOCATING)
        if places := [(element, name) for name in names if name in unheld]:
            attributes.setdefault(tag, []).extend(places)
        for child in element:
            if child.tag in skipped:
                elements.setdefault((tag, str(child.tag)), []).append(child)
        todo += reversed([child for child in element if child.tag not in skipped])
    for (tag, name), children in elements.items():
        what = counted_elements(children, name, tag)
        yield found("element-unread/known", f"{path}:{children[0].sourceline}", what=what)
    for tag, places in attributes.items():
        counts = Counter(name for _, name in places)
        what = ", ".join(f"{n} {name}=..." for name, n in sorted(counts.items()))
        where = f"{path}:{places[0][0].sourceline}"
        yield found("attribute-unread/known", where, what=f"{what} of <{tag}>")


def _require_few_elements(root: etree._Element, path: Path) -> None:
    if root.tag != "mujoco":
        raise FormatError(f"{path}: the root element is <{root.tag}>, not <mujoco>")
    for tag, bound in MAX_ELEMENTS.items():
        count = sum(1 for _ in root.iter(tag))
        if count > bound:
            what = "elements" if tag == "*" else f"<{tag}> elements"
            raise FormatError(f"{path}: has {count} {what}; at most {bound} are read")


def _take_mesh_files(root: etree._Element, path: Path, finder: PackageFinder) -> dict[str, Path]:
    """Remove the files of the mesh assets from the document, and return them by name."""
    folder = ""
    strip = False
    for compiler in root.iterfind("compiler"):
        folder = compiler.get("meshdir", compiler.get("assetdir", folder))
        strip = compiler.get("strippath", str(strip).lower()) == "true"
        _drop(compiler, "meshdir", "assetdir", "texturedir", "strippath")
    meshes: dict[str, Path] = {}
    missing: list[Finding] = []
    for element in root.iterfind("asset/mesh[@file]"):
        uri = element.get("file", "")
        _drop(element, "file", "content_type")
        parts = PurePosixPath(uri.replace("\\", "/"))
        name = element.get("name") or parts.stem
        element.set("name", name)
        try:
            inside = parts.name if strip else uri
            meshes[name] = resolve_uri(_joined(folder, inside), path, finder)
        except FormatError as error:
            where = f"{path}: mesh {name!r}"
            missing.append(found("mesh-unresolved", where, error=error, hint=""))
    if missing:
        raise UnsoundError(str(path), missing)
    require_bounded_files(meshes.values(), str(path))
    return meshes


def _joined(folder: str, name: str) -> str:
    """Return a file's name below a folder, both as an MJCF writes them."""
    return (PurePosixPath(folder.replace("\\", "/")) / name.replace("\\", "/")).as_posix()


def _drop(element: etree._Element, *keys: str) -> None:
    for key in keys:
        if key in element.attrib:
            del element.attrib[key]


def remove_element(element: etree._Element) -> None:
    """Remove an element from its parent, if it has one."""
    parent = element.getparent()
    if parent is not None:
        parent.remove(element)


def listed(names: Iterable[str]) -> str:
    """Return quoted names, at most five, for an error."""
    names = [*names]
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(repr(name) for name in names[:5]) + more
