"""Find the files that a robot description names, without ROS."""

from __future__ import annotations

import difflib
import importlib.metadata
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from itertools import product
from pathlib import Path, PurePosixPath
from typing import Literal
from urllib.parse import unquote

from morphgen.errors import FormatError
from morphgen.formats.xacro.evaluator import RefusedError

REQUIREMENTS = {"rtb-data": "rtb-data==1.1.0", "example-robot-data": "example-robot-data"}
"""pip requirement of each distribution that provides robot files."""

_DATA_ROOTS = {
    "rtb-data": ("rtbdata/xacro", "rtbdata"),
    "example-robot-data": ("cmeel.prefix/share", "cmeel.prefix/share/example-robot-data/robots"),
}
_MORPHGEN_PACKAGES = ("morphgen.templates", "morphgen.robots_real")
_SUBFOLDERS = ("urdf", "urdfs", "xacro", "xacros", "robot", "robots")
_ROOT_HINT = "name the folder that it may come from as root (--root DIR of morphgen import)"
SKIP_HINT = "or leave out what has none by --skip-missing-meshes of morphgen import"
_PACKAGE_SUFFIX = re.compile(r"_(description|support)$")
_PACKAGE_NAME = re.compile(r"[A-Za-z][\w-]*$")
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):(?://)?")
_LICENCE_TAG = re.compile(rb"<license[^>]*>([^<]{1,200})<")
_MAX_MANIFEST = 2**20  # part of a package.xml that is searched for name and licence [bytes]
_NAME_TAG = re.compile(rb"<name>\s*([^<\s]+)\s*</name>")


@dataclass(frozen=True)
class PackageFinder:
    """Finds ROS packages around the file that names them and in further folders."""

    roots: tuple[Path, ...] = ()  # folders that contain packages, in search order
    root: Path | None = None
    """A folder from which files may be read, besides the description's own folder and package."""
    skip_missing: bool = False
    """Whether shapes of a URDF whose mesh is not found are left out, with a finding."""

    def find(self, package: str, *files: Path) -> Path:
        """Return the folder of a package: around the files, from each upwards, then in the roots.

        Above a file's tree a folder needs a ``package.xml`` or ROS's suffix. Descriptions are often
        copied into a folder without that, so ``x_description`` and ``x_support`` are then searched
        as ``x``.
        """
        prefix = f"{files[0]}: " if files else ""
        if not _PACKAGE_NAME.match(package):
            raise FormatError(
                f"{prefix}{package!r} is not a package name (letters, digits, _ and -)"
            )
        for candidate, _ in self.candidates(package, files):
            return candidate
        around = f"in or beside the folders above {files[0]}, " if files else ""
        roots = ", ".join(map(str, self.roots)) or "(none)"
        raise FormatError(
            f"{prefix}package {package!r} not found: looked {around}in the roots {roots};"
            " give the folder that holds it as --root"
        )

    def candidates(self, package: str, files: Iterable[Path]) -> Iterator[tuple[Path, bool]]:
        """Yield the folders that may be a package, in search order.

        Each comes with whether it is an installed package or one of ROS's environment, which the
        user did not name.
        """
        stems = dict.fromkeys([package, _PACKAGE_SUFFIX.sub("", package)])
        for name in stems:
            yield from ((folder, False) for folder in self._around(name, files))
            for root in self.roots:
                for folder in self._in_root(name, root):
                    yield folder, root != self.root and not any(_is_in(f, [root]) for f in files)

    @staticmethod
    def _around(name: str, files: Iterable[Path]) -> Iterator[Path]:
        for file in files:
            tree = _tree(file)
            for folder, near in product(_ancestors(file), ("", name)):
                package = folder / near
                # Above the tree may be the user's home, of which any folder could be named.
                may_be_plain = package.is_relative_to(tree) or _has_suffix(package)
                is_named = package.name == name and package.is_dir()
                if _declared_name(package) == name or (
                    is_named and (may_be_plain or _is_package(package))
                ):
                    yield package

    @staticmethod
    def _in_root(name: str, root: Path) -> Iterator[Path]:
        if root.name == name or _declared_name(root) == name:
            yield root
        if (root / name).is_dir():
            yield root / name
        for manifest in sorted([*root.glob("*/package.xml"), *root.glob("*/*/package.xml")]):
            if _declared_name(manifest.parent) == name:
                yield manifest.parent


def default_finder(*, root: Path | None = None, skip_missing: bool = False) -> PackageFinder:
    """Return a finder for ``root``, then ROS's present environment, then the pip data packages.

    root: A folder from which files may be read, besides the description's own folder and package.
    skip_missing: Whether shapes of a URDF whose mesh is not found are left out.
    """
    if root is not None:
        if not root.is_dir():
            raise FormatError(f"root {root}: no such folder")
        root = _absolute(root)
    roots = () if root is None else (root,)
    shares = (prefix / "share" for prefix in _path_list("AMENT_PREFIX_PATH"))
    folders = map(_absolute, (*roots, *_path_list("ROS_PACKAGE_PATH"), *shares, *_data_roots()))
    return PackageFinder(tuple(dict.fromkeys(folders)), root, skip_missing)


@dataclass(frozen=True)
class FoundFile:
    """A file that a description refers to."""

    path: Path
    package: str = ""  # package of its URI, if it names one
    place: Literal["", "beside", "installed"] = ""
    """``beside`` if the package is unknown and the file was found around the description;
    ``installed`` if the package is an installed one that the user did not name."""
    folder: Path = Path()  # folder of the package


def resolve_uri(uri: str, base_file: Path, finder: PackageFinder) -> Path:
    """Return the file that a URI inside a robot description refers to; see ``find_file``."""
    return find_file(uri, base_file, finder).path


def find_file(uri: str, base_file: Path, finder: PackageFinder) -> FoundFile:
    """Return the file that a URI inside a robot description refers to; see docs/importing.md.

    A name is tried as written, then with its ``%`` escapes decoded; backslashes count as slashes;
    letter case matters. If no package has the file, it is also searched without the package's name:
    in the folders of the description's tree, nearest first, and in the finder's ``root``, there
    also by the last parts of its path.

    Security: only files of ROS packages, the finder's folders and the description's own tree are
    allowed, symbolic links resolved, because a stranger's file could otherwise copy private files
    into a bundle.
    """
    base = _absolute(base_file)
    text = uri.strip().replace("\\", "/")
    match = _SCHEME.match(text)
    scheme, rest = (match[1], text[match.end() :]) if match else ("", text)
    if scheme not in ("package", "model", "file", "") or not rest:
        raise FormatError(
            f"{base}: cannot read {uri!r}; valid: package://, model://, file:// or a path"
        )
    tree, root = _tree(base), finder.root
    # A root also replaces a search path: PyBullet's data names meshes from its top folder.
    folders = [base.parent, *([root] if root and not scheme else [])]
    places = [(FoundFile(Path(), folder=folder), tree, rest) for folder in folders]
    if scheme in ("package", "model"):
        places = _package_places(*rest.lstrip("/").partition("/")[::2], base, finder)
    missing = []
    for place, boundary, name in places:
        # A file's own name may hold a percent sign, so the name as written comes first.
        for text in dict.fromkeys([name, unquote(name)]):
            absolute = scheme in ("file", "") and Path(text).is_absolute()
            path = Path(os.path.normpath(text if absolute else place.folder / text.lstrip("/")))
            inside = path.is_relative_to(boundary) or _is_in(path, [root])
            if not inside and not (absolute and _is_in_package(path, finder)):
                raise FormatError(
                    f"{base}: {uri!r} leaves {boundary}, the folder of its description;"
                    f" move the file inside, refer to it by package://, or {_ROOT_HINT}"
                )
            if path.is_file():
                real = path.resolve()
                trees = (boundary, _tree(base.resolve()), root)
                if not _is_in(real, trees) and not _is_in_package(real, finder):
                    raise FormatError(
                        f"{base}: {uri!r} is a symbolic link that leaves {boundary}, the folder of"
                        f" its description; put the file itself there, or {_ROOT_HINT}"
                    )
                return replace(place, path=path)
            if place.place != "beside":
                missing.append(path)
    if not missing:
        finder.find(rest.lstrip("/").partition("/")[0], base)  # raises: the package is unknown
    raise FormatError(f"{base}: {uri!r} does not exist: looked for {_listed(missing)}")


def _package_places(
    package: str, rest: str, base: Path, finder: PackageFinder
) -> list[tuple[FoundFile, Path, str]]:
    """Return where a file of a package may be, with the folder not to leave and its name there."""
    places: list[tuple[FoundFile, Path, str]] = []
    installed: list[tuple[FoundFile, Path, str]] = []
    if _PACKAGE_NAME.match(package):
        for folder, is_installed in finder.candidates(package, [base]):
            place: Literal["", "installed"] = "installed" if is_installed else ""
            found = FoundFile(Path(), package, place, folder)
            (installed if is_installed else places).append((found, folder, rest))
    tree = _tree(base)
    beside = FoundFile(Path(), package, "beside")
    for folder in _ancestors(base):
        if folder.is_relative_to(tree):
            places.append((replace(beside, folder=folder), tree, rest))
    if finder.root is not None:
        parts = PurePosixPath(rest).parts
        for k in range(len(parts)):
            name = "/".join(parts[k:])
            places.append((replace(beside, folder=finder.root), finder.root, name))
    return places + installed


def package_source(file: FoundFile) -> dict[str, str]:
    """Return ``source`` and ``licence`` of an installed package that a file was found in."""
    manifest = file.folder / "package.xml"
    declared = _LICENCE_TAG.search(_manifest_text(manifest)) if manifest.is_file() else None
    licence = declared[1].decode(errors="replace").strip() if declared else ""
    for name, folders in _DATA_ROOTS.items():
        with suppress(importlib.metadata.PackageNotFoundError):
            distribution = importlib.metadata.distribution(name)
            if _is_in(file.folder, [_absolute(distribution.locate_file(f)) for f in folders]):
                about = distribution.metadata.json
                licence = licence or str(about.get("license_expression", about.get("license", "")))
                return {"source": f"{name} {distribution.version}", "licence": licence or "unknown"}
    return {"source": file.folder.name, "licence": licence or "unknown"}


def require_allowed_text(path: Path, finder: PackageFinder, *files: Path) -> None:
    """Require that a xacro may copy a file into the robot or list a folder: none is private."""
    real = path.resolve()
    if _is_in(real, (*finder.roots, finder.root)):
        return
    trees = [_tree(path, for_text=True) for file in files for path in (file, file.resolve())]
    packaged = any(map(_is_package, _ancestors(real)))
    if not packaged and not _is_in(real, trees):
        raise RefusedError(
            f"{str(path)!r} is not in {trees[0]}, the folder of the description, nor in a ROS"
            f" package; move the file inside, or {_ROOT_HINT}"
        )


def is_installed(path: Path) -> bool:
    """Return whether a file was installed with morphgen or one of the data packages."""
    return _is_in(path.resolve(), (*_morphgen_folders(), *_data_roots()))


def finds_installed_only(finder: PackageFinder) -> bool:
    """Return whether a finder finds packages of the installed data packages only."""
    return finder.root is None and {*finder.roots} <= {*_data_roots()}


def portable_uri(path: Path) -> str:
    """Return the ``package://`` URI of a file in a ROS package, which is valid on any machine.

    A file outside of packages (no folder above has a ``package.xml`` or ROS's suffix) keeps
    its path.
    """
    for folder in path.parents:
        if _is_package(folder) or _has_suffix(folder):
            return f"package://{folder.name}/{path.relative_to(folder).as_posix()}"
    return path.as_posix()


def distribution_file(package: str, relative: str) -> Path:
    """Return a file of an installed pip distribution."""
    requirement = REQUIREMENTS.get(package, package)
    inside = PurePosixPath(relative)
    if inside.is_absolute() or ".." in inside.parts:
        raise FormatError(f"{relative!r} is not a path below the install root of {package!r}")
    try:
        distribution = importlib.metadata.distribution(package)
    except (importlib.metadata.PackageNotFoundError, ValueError) as error:
        raise FormatError(
            f"{relative!r} is part of {package!r}, not installed: pip install {requirement}"
        ) from error
    path = _absolute(distribution.locate_file(relative))
    if not path.is_file():
        raise FormatError(
            f"{package} {distribution.version} has no file {_listed([path])};"
            f" try pip install {requirement}"
        )
    return path


def _tree(file: Path, *, for_text: bool = False) -> Path:
    """Return the folder that a description's mesh paths must not leave.

    With ``for_text``, it is that of a xacro's includes, a stricter one: text would be copied
    literally, and the folder above a download may be the user's home.
    """
    file = _absolute(file)
    ancestors = _ancestors(file)
    declared = [folder for folder in ancestors if _is_package(folder)]
    named = [folder for folder in ancestors if _has_suffix(folder)]
    is_above_allowed = not for_text or file.parent.name.lower() in _SUBFOLDERS
    above = ancestors[1:2] if is_above_allowed else []
    return (declared + named + above + [file.parent])[0]


def _is_in(path: Path, folders: Iterable[Path | None]) -> bool:
    """Return whether a path is in one of the folders, as written or with links resolved."""
    given = [folder for folder in folders if folder is not None]
    return any(path.is_relative_to(folder) for folder in given) or any(
        path.is_relative_to(folder.resolve()) for folder in given
    )


def _is_in_package(path: Path, finder: PackageFinder) -> bool:
    """Return whether an absolute path is in one of the finder's folders or in a ROS package."""
    return _is_in(path, finder.roots) or any(
        _has_suffix(folder) or _is_package(folder) for folder in path.parents
    )


def _has_suffix(folder: Path) -> bool:
    return _PACKAGE_SUFFIX.search(folder.name) is not None


def _is_package(folder: Path) -> bool:
    return (folder / "package.xml").is_file()


def _ancestors(file: Path) -> list[Path]:
    """Return the folders above a file, nearest first, without the root of the file system."""
    return [folder for folder in _absolute(file).parents if folder != folder.parent]


def _absolute(path: object) -> Path:
    return Path(os.path.normpath(Path(str(path)).absolute()))


def _path_list(variable: str) -> list[Path]:
    return [Path(entry) for entry in os.environ.get(variable, "").split(os.pathsep) if entry]


def _declared_name(folder: Path) -> str | None:
    manifest = folder / "package.xml"
    if not manifest.is_file():
        return None
    return _read_name(manifest, manifest.stat().st_mtime_ns)


def _manifest_text(manifest: Path) -> bytes:
    with manifest.open("rb") as file:
        return file.read(_MAX_MANIFEST)


@lru_cache(maxsize=1024)
def _read_name(manifest: Path, mtime_ns: int) -> str | None:
    match = _NAME_TAG.search(_manifest_text(manifest))
    return match[1].decode(errors="replace") if match else None


@lru_cache(maxsize=1)
def _morphgen_folders() -> tuple[Path, ...]:
    return tuple(Path(str(files(package))).resolve() for package in _MORPHGEN_PACKAGES)


@lru_cache(maxsize=1)
def _data_roots() -> tuple[Path, ...]:
    roots = []
    for name, folders in _DATA_ROOTS.items():
        try:
            distribution = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        roots += [_absolute(distribution.locate_file(folder)) for folder in folders]
    return tuple(roots)


def _listed(paths: list[Path]) -> str:
    """Return missing paths as text, with the most similar file name in the folder of the last."""
    text = " and ".join(dict.fromkeys(map(str, paths)))
    folder, name = paths[-1].parent, paths[-1].name
    names = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []
    same = [other for other in names if other.lower() == name.lower()]
    close = same or difflib.get_close_matches(name, names, n=1, cutoff=0.7)
    return f"{text}; did you mean {close[0]!r}?" if close else text
