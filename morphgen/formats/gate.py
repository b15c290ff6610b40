"""Copies of strangers' robots that other libraries may open.

A library opens whatever a description names: files elsewhere on the machine, pipes that never end,
meshes with references of their own. Therefore a loader gets a copy: the description with known
elements only, its includes inserted, and its meshes rewritten, in a private folder.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from lxml import etree

from morphgen.formats.bundle import MJCF, URDF, mesh_file
from morphgen.formats.description import is_mjcf
from morphgen.formats.mjcf.document import read_document, remove_element
from morphgen.formats.resolve import PackageFinder, default_finder, resolve_uri
from morphgen.formats.urdf import read
from morphgen.formats.urdf.schema import CHILDREN
from morphgen.formats.xml import parse_description
from morphgen.model.geometry import Mesh
from morphgen.model.mesh import require_bounded_meshes

_CHILDREN: Mapping[str, Collection[str]] = {
    **CHILDREN,
    "robot": ("link", "joint", "material", "mujoco"),
    "mujoco": ("compiler", "option"),
    "option": ("flag",),
}
"""Child elements of a URDF that loaders get, by parent element."""
_FILE_ATTRIBUTES = ("assetdir", "meshdir", "strippath", "texturedir")
"""Attributes of ``<compiler>`` that say where files lie; in the copy they lie beside it."""


@contextmanager
def loader_copy(path: Path, finder: PackageFinder | None = None) -> Iterator[Path]:
    """Yield a temporary folder with a copy of a robot that other libraries may open.

    It has ``robot.urdf`` and ``robot.xml`` of a bundle, or what was read, with meshes as STL or OBJ
    beside them, without elements that a robot does not need.
    """
    finder = finder or default_finder()
    with TemporaryDirectory(prefix="morphgen-") as name:
        folder = Path(name)
        if not path.is_dir():
            read.require_description_file(path)
            if is_mjcf(path):
                _copy_mjcf(path, folder, finder)
            else:
                _copy_urdf(path, folder, finder)
        for file, copy in ((URDF, _copy_urdf), (MJCF, _copy_mjcf)):
            # Each loader says itself that its file is missing.
            if path.is_dir() and (path / file).exists():
                copy(resolve_uri(file, path / URDF, finder), folder, finder)
        yield folder


def _copy_mjcf(path: Path, folder: Path, finder: PackageFinder) -> None:
    from morphgen.formats.mjcf.read import compile_document  # loads trimesh

    document = read_document(path, finder, with_options=True)
    compile_document(document)
    root = etree.fromstring(document.text)
    copied = _mesh_copies(folder)
    for element in root.iterfind("asset/mesh[@name]"):
        if element.get("name", "") in document.meshes:
            element.set("file", copied(document.meshes[element.get("name", "")]))
    (folder / MJCF).write_bytes(etree.tostring(root, encoding="utf-8"))


def _copy_urdf(path: Path, folder: Path, finder: PackageFinder) -> None:
    data = read.urdf_bytes(path, {}, finder)
    require_bounded_meshes(read.robot_from_xml(data, path, finder))
    root, _ = parse_description(data, str(path))
    meshes, _, _ = read.resolved_meshes(root, path, finder)
    _keep_known(root)
    copied = _mesh_copies(folder)
    for shape in root.iterfind("link/*"):
        # Of several geometries, loaders get the one that morphgen reads.
        for surplus in (*shape.findall("geometry")[1:], *shape.findall("geometry/*")[1:]):
            remove_element(surplus)
        for element in shape.iterfind("geometry/mesh"):
            element.set("filename", copied(meshes[element.get("filename", "")]))
    (folder / URDF).write_bytes(etree.tostring(root, encoding="utf-8"))


def _keep_known(element: etree._Element) -> None:
    """Remove elements that loaders do not get, names with a namespace, and empty shapes."""
    for key in [*element.attrib]:
        if key.startswith("{") or (element.tag == "compiler" and key in _FILE_ATTRIBUTES):
            del element.attrib[key]
    for child in [*element]:
        if child.tag not in _CHILDREN.get(str(element.tag), ()):
            element.remove(child)
            continue
        _keep_known(child)
        if child.tag in ("visual", "collision") and not len(child.findall("geometry/*")):
            element.remove(child)


def _mesh_copies(folder: Path) -> Callable[[Path], str]:
    names: dict[Path, str] = {}

    def copied(path: Path) -> str:
        if path not in names:
            names[path], data = mesh_file(Mesh(path))
            (folder / names[path]).write_bytes(data)
        return names[path]

    return copied
