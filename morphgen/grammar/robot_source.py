"""Find and read the robots that a user names: files, bundles, sets, or words of a request."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TypeAlias, TypeGuard

from morphgen.checks import fix, record_repairs
from morphgen.checks.self_collision import survey_collisions
from morphgen.checks.srdf import read_srdf, with_disabled_pairs
from morphgen.errors import CompositionError, FormatError, nearest
from morphgen.formats.bundle import CARD, SUFFIXES, XACRO, fits_in, read_description, read_robot
from morphgen.formats.data_files import read_text
from morphgen.formats.resolve import default_finder
from morphgen.grammar.compose import compose
from morphgen.grammar.grammar_file import SUFFIX as GRAMMAR_SUFFIX
from morphgen.grammar.library import Library
from morphgen.grammar.request import known_grammars, parse_words
from morphgen.grammar.sampling import DERIVATION, INDEX, SETTINGS, read_index
from morphgen.grammar.syntax import MAX_DERIVATION_TEXT, Derivation, parse_derivation
from morphgen.model.robot import TOOL, Frame, Robot
from morphgen.model.tree import rename, subtree

RobotLike: TypeAlias = Robot | str | PathLike[str]
"""A robot, or its name: words of ``morphgen compose``, parts joined by dashes, or a path."""


@dataclass(frozen=True)
class RobotReference:
    """A robot that a user names: by a path, or by the words of a request."""

    label: str  # the path or the words, as printed in messages and tables
    path: Path | None = None
    """A bundle's folder, a robot's folder in a light set, a URDF, a xacro or an MJCF."""
    words: tuple[str, ...] = ()  # words of `morphgen compose`


def find_robots(
    words: Sequence[str],
    library: Library,
    refuse: Callable[[str, FormatError], object] | None = None,
) -> list[RobotReference]:
    """Return the robots that the words of a command line name, once each, without reading them.

    Each word is a bundle's folder, a description, a set or folder of bundles, which stand for all
    their robots, or parts joined by dashes. Neighbouring words ``key=value`` are one robot
    together, also after a grammar's name. A word with spaces is a request of its own.
    """
    if not words:
        raise CompositionError("no robot is named; expected one such as ur5-plane or robots/arm3")
    sources: list[RobotReference] = []
    is_open = False  # whether key=value words belong to the last source
    for word in words:
        if is_robot_file(word):
            is_open = False
            try:
                sources += _file_sources(Path(word))
            except FormatError as error:
                if refuse is None:
                    raise
                refuse(word, error)
            continue
        is_single = len(word.split()) == 1
        if is_open and is_single and "=" in word:
            sources[-1] = _request_source((*sources[-1].words, word))
            continue
        sources.append(_request_source(word.split()))
        is_open = is_single and (
            "=" in word or word.endswith(GRAMMAR_SUFFIX) or word in known_grammars(library)
        )
    return list(dict.fromkeys(sources))


def find_robot(text: str | PathLike[str]) -> RobotReference:
    """Return the one robot that a text names; see ``find_robots``."""
    if not isinstance(text, str | PathLike):
        raise CompositionError(
            f"{text!r} is no robot; expected a Robot, a path, or a name such as ur5-plane"
        )
    if isinstance(text, str) and not is_robot_file(text):
        return _request_source(text.split())
    sources = _file_sources(Path(text))
    if len(sources) > 1:
        raise CompositionError(
            f"{text} holds {len(sources)} robots; name one, such as {sources[0].label}"
        )
    return sources[0]


def read_source(source: RobotReference, library: Library, root: Path | None = None) -> Robot:
    """Return a robot: read from its file, or composed from its words.

    A robot of a light set is composed from its derivation, since its URDF has no home. In a URDF,
    the frame ``tool`` is that of the link ``tool``, which is renamed ``tool_link``.
    """
    path = source.path
    if path is None:
        try:
            derivation, name = parse_words(source.words, library)
        except CompositionError as error:
            if source.words and "=" not in source.label and Path(source.label).exists():
                raise _no_robot(Path(source.label)) from error
            raise
        return compose(derivation, library, name)
    if light := light_derivation(path):
        return compose(light, library, path.resolve().name)
    robot = read_robot(path, root=root)
    return _with_tool(robot, TOOL) if _has_tool_link(robot) else robot


def is_one_robot(robots: RobotLike | Iterable[RobotLike]) -> TypeGuard[RobotLike]:
    """Return whether an argument is one robot, itself or by its name, and not several."""
    return isinstance(robots, Robot | str | PathLike)


def robot_list(robots: RobotLike | Iterable[RobotLike]) -> list[RobotLike]:
    """Return an argument that may be one robot or several as a list."""
    if is_one_robot(robots) or not isinstance(robots, Iterable):
        return [robots]  # anything else is refused as every value of a list
    return list(robots)


def resolve_robot(robot: RobotLike, library: Library) -> Robot:
    """Return a robot, given itself or by its name; see ``find_robot`` and ``read_source``."""
    return robot if isinstance(robot, Robot) else read_source(find_robot(robot), library)


def light_derivation(folder: Path) -> Derivation | None:
    """Return the derivation of a robot of a light set; None for anything else."""
    path = folder / DERIVATION
    if not path.is_file() or (folder / CARD).is_file():
        return None
    return parse_derivation(read_text(path, MAX_DERIVATION_TEXT), str(path))


def is_robot_folder(folder: Path) -> bool:
    """Return whether a folder is a bundle, or a robot of a light set."""
    return (folder / CARD).is_file() or (folder / DERIVATION).is_file()


def is_set_folder(folder: Path) -> bool:
    """Return whether a folder is a set of ``morphgen sample``, finished or not."""
    return (folder / INDEX).is_file() or (folder / SETTINGS).is_file()


def is_robot_file(text: str) -> bool:
    """Return whether a text names robots on disk rather than parts or a grammar.

    A folder without robots, or a file without a suffix, does not hide a grammar or a part of the
    same name.
    """
    path = Path(text)
    is_description = path.suffix not in ("", GRAMMAR_SUFFIX) and path.is_file()
    if is_description or (path.is_dir() and holds_robots(path)):
        return True
    if "=" in text or text.partition(" ")[0].endswith(GRAMMAR_SUFFIX):
        return False
    return "/" in text or text in (".", "..") or text.endswith(SUFFIXES)


def holds_robots(folder: Path) -> bool:
    """Return whether a folder is a robot or a set, or has robots directly in it."""
    is_robot = is_robot_folder(folder) or is_set_folder(folder)
    return is_robot or any(map(is_robot_folder, folder.iterdir()))


def robots_in(folder: Path) -> Iterator[Path]:
    """Yield the robots of a folder: itself, those of a set by its index, or the bundles in it."""
    if is_robot_folder(folder):
        yield folder
    elif is_set_folder(folder):
        yield from (folder / record["name"] for record in read_index(folder))
    else:
        yield from (child for child in sorted(folder.iterdir()) if is_robot_folder(child))


def _file_sources(path: Path) -> list[RobotReference]:
    if not path.exists():
        raise FormatError(f"{path}: no such file or folder")
    robots = [path] if path.is_file() else list(robots_in(path))
    if not robots:
        raise _no_robot(path)
    return [RobotReference(str(robot), robot) for robot in robots]


def _no_robot(path: Path) -> FormatError:
    files = sorted(path.iterdir()) if path.is_dir() else ()
    inside = next((file for file in files if file.name.endswith(SUFFIXES)), None)
    return FormatError(
        f"{path} holds no robot; expected a bundle, a URDF, a set of morphgen sample, or a "
        "folder of bundles" + (f"; did you mean {inside}?" if inside else "")
    )


def _request_source(words: Sequence[str]) -> RobotReference:
    return RobotReference(" ".join(words), words=tuple(words))


def import_robot(
    path: Path,
    args: Mapping[str, str] | None = None,
    *,
    root: Path | None = None,
    root_link: str | None = None,
    tool: str | None = None,
    srdf: Path | None = None,
    name: str | None = None,
    repair: bool = True,
    skip_missing_meshes: bool = False,
) -> Robot:
    """Read any robot description, and add what it lacks: a tool frame and ignored pairs.

    skip_missing_meshes: Whether shapes of a URDF whose mesh is not found are left out, with a
        finding, instead of an error.
    """
    robot = read_description(
        path,
        args,
        default_finder(root=root, skip_missing=skip_missing_meshes),
        root_link=root_link,
        written_frames=tool is None and path.suffix != XACRO,  # a tool is named by its link
    )
    robot = replace(robot, fits=fits_in(path.parent))
    if srdf is not None:
        robot = with_disabled_pairs(robot, read_srdf(srdf), str(srdf))
    for option, link in (("root link", root_link), ("tool", tool)):
        if link is not None and link not in robot.link_index:
            raise FormatError(
                f"{path}: no link {link!r} for {option}{nearest(link, robot.link_index)}"
            )
    if root_link is not None:
        robot = subtree(robot, root_link)
    if tool is not None and tool not in robot.link_index:
        raise FormatError(f"{path}: tool {tool!r} is not below the root link {root_link!r}")
    if tool is not None or _has_tool_link(robot):
        robot = _with_tool(robot, tool or TOOL)
    robot = replace(
        robot,
        name=robot.name if name is None else name,
        provenance={"source": path.name, **robot.provenance},
    )
    robot = record_repairs(robot, robot.source_findings)
    if repair:
        robot, _ = fix(robot)
    survey = survey_collisions(robot, known_pairs=robot.ignore_pairs)
    return replace(robot, ignore_pairs=survey.ignore_pairs)


def _has_tool_link(robot: Robot) -> bool:
    """Return whether a robot has a link ``tool`` and no such frame."""
    return TOOL in robot.link_index and robot.tool is None


def _with_tool(robot: Robot, link: str) -> Robot:
    """Return the robot with a link's frame as ``tool``; a link of that name gets another one."""
    links = {TOOL: _free(f"{TOOL}_link", robot.link_index)} if TOOL in robot.link_index else {}
    joint, new_joint = f"{TOOL}_joint", _free(f"{TOOL}_link_joint", robot.joint_index)
    robot = rename(robot, links, {joint: new_joint} if joint in robot.joint_index else {})
    others = (frame for frame in robot.frames if frame.name != TOOL)
    return replace(robot, frames=(*others, Frame(TOOL, links.get(link, link))))


def _free(name: str, taken: Collection[str]) -> str:
    """Return a name that is not taken: the given one, or with underscores appended."""
    while name in taken:
        name += "_"
    return name
