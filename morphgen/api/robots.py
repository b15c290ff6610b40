"""Compose, sample, read and write robots."""

from __future__ import annotations

from collections.abc import Iterator
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.arguments import path_argument, text_argument, truth, whole_number
from morphgen.checks import check
from morphgen.errors import CompositionError, FormatError, GrammarError, nearest
from morphgen.extras import explain_missing_extras
from morphgen.fitting.replace_collision import GEOMETRIES, with_geometry
from morphgen.formats.bundle import bundle_folder, read_robot, write_bundle
from morphgen.grammar.analysis import load_sound_grammar
from morphgen.grammar.compose import compose as compose_derivation
from morphgen.grammar.library import LibraryFolders, default_library
from morphgen.grammar.request import parse_words
from morphgen.grammar.robot_source import RobotLike, resolve_robot
from morphgen.grammar.sampling import SamplingError, sample_robots
from morphgen.grammar.values import parse_conditions
from morphgen.model.geometry import MESH_SUFFIXES, Mesh, Shape
from morphgen.model.robot import Link, Robot

if TYPE_CHECKING:
    from morphgen.fitting.replace_collision import FittedRobot


@explain_missing_extras()
def compose(
    request: str = "",
    *,
    name: str | None = None,
    geometry: str = "mesh",
    library: LibraryFolders = (),
    **words: str | float,
) -> Robot:
    """Compose a robot from parts.

    Examples:
        >>> robot = morphgen.compose("ur5-plane")
        >>> robot.dof
        6
        >>> robot = morphgen.compose(arm="ur5", ee="plane", **{"ee.size": "80mm"})
        >>> robot = morphgen.compose("chain beads=5")

    Args:
        request: ``key=value`` words, such as ``arm=ur5 ee=plane ee.size=80mm``; parts joined by
            dashes, such as ``ur5-plane``; or a grammar and pinned choices, such as
            ``chain beads=5``.
        name: Name of the robot; by default it is made from the parts.
        geometry: Collision shapes: ``mesh`` for those of the parts; ``primitive`` for fitted boxes,
            cylinders and spheres in place of meshes; ``convex`` for convex pieces of meshes; or
            ``sphere`` for 8 spheres for each link.
        library: Folders of your own parts and grammars.
        **words: More ``key=value`` words. Values without a unit are in SI units.

    Raises:
        MissingDependencyError: If primitives or spheres have to be fitted and the extra ``fit`` is
            missing, or meshes decomposed and the extra ``convex``.
        MorphgenError: If a part, parameter, port or grammar does not exist or does not fit, or a
            value is out of range; the message lists what is valid.
    """
    if text_argument("geometry", geometry, CompositionError) not in GEOMETRIES:
        raise CompositionError(f"unknown geometry {geometry!r}{nearest(geometry, GEOMETRIES)}")
    if not isinstance(request, str):
        raise CompositionError(f"{request!r}: expected words, such as ur5-plane")
    for key, value in words.items():
        if isinstance(value, bool) or not isinstance(value, str | Real):  # True is a Real
            raise CompositionError(f"{key} {value!r}: expected a text or a number")
    if name is not None:
        name = text_argument("name", name, CompositionError)
    parts = default_library(library)
    request_words = [*request.split(), *(f"{key}={value}" for key, value in words.items())]
    derivation, default_name = parse_words(request_words, parts)
    robot = compose_derivation(derivation, parts, name or default_name)
    return with_geometry(robot, geometry, parts.folders)


def sample(
    grammar: str | PathLike[str],
    n: int,
    *,
    seed: int = 0,
    where: str | None = None,
    library: LibraryFolders = (),
) -> Iterator[Robot]:
    """Draw robots from a grammar; each is drawn when the iterator reaches it.

    Examples:
        >>> for robot in morphgen.sample("arm3", 2, seed=7, where="reach > 0.4"):
        ...     print(robot.name)
        arm3-000000
        arm3-000001

    Args:
        grammar: Name of a grammar that comes with morphgen or is in ``library``, or a path.
        n: Number of robots.
        seed: Seed; robot i does not depend on n.
        where: Condition that every robot meets, such as ``reach > 0.4 and dof >= 5``.
        library: Folders of your own parts and grammars.

    Raises:
        GrammarError: If the grammar or the condition is invalid.
        SamplingError: If ``n`` or ``seed`` is negative or no integer; while iterating, if no robot
            meets the conditions in 500 draws.
    """
    parts = default_library(library)
    loaded = load_sound_grammar(str(path_argument("grammar", grammar, GrammarError)), parts)
    if where is not None:
        where = text_argument("where", where, GrammarError)
    conditions = parse_conditions([where] if where else [], "where")
    n = whole_number("sample: n", n, SamplingError, 0)
    seed = whole_number("sample: seed", seed, SamplingError, 0)
    samples = sample_robots(loaded, parts, n, seed=seed, where=conditions)
    return (sample.robot for sample in samples)


def read(
    path: str | PathLike[str],
    *,
    root: str | PathLike[str] | None = None,
    skip_missing_meshes: bool = False,
) -> Robot:
    """Read a robot from a bundle's folder, a URDF, a xacro or an MJCF.

    Examples:
        >>> folder = morphgen.write("ur5-plane", "robots", picture=False)
        >>> morphgen.read(folder).name
        'ur5-plane'

    Args:
        path: The file or folder.
        root: A folder that meshes, includes and YAML may come from, besides the description's own
            folder and package.
        skip_missing_meshes: Whether shapes of a URDF whose mesh is not found are left out. The
            robot's ``source_findings`` name them.

    Raises:
        FormatError: If the path is none of these, or the description is invalid.
    """
    folder = None if root is None else path_argument("root", root, FormatError)
    source = path_argument("path", path, FormatError)
    return read_robot(source, root=folder, skip_missing_meshes=skip_missing_meshes)


def write(
    robot: RobotLike,
    folder: str | PathLike[str],
    *,
    picture: bool = True,
    library: LibraryFolders = (),
) -> Path:
    """Check a robot and write its bundle: URDF, MJCF, meshes, card and picture.

    Examples:
        >>> folder = morphgen.write("ur5-plane", "robots", picture=False)
        >>> print(folder)
        robots/ur5-plane

    Args:
        robot: The robot, its bundle's folder, a description, or words of ``compose``.
        folder: Folder in which the bundle's folder, of the robot's name, is created or replaced.
        picture: Whether to render ``preview.png``.
        library: Folders of your own parts.

    Returns:
        The bundle's folder.

    Raises:
        FormatError: If the folder cannot be written, or contains something else of that name.
        MorphgenError: If the robot cannot be composed or read.
    """
    parent = path_argument("folder", folder, FormatError)
    picture = truth("picture", picture, FormatError)
    robot = resolve_robot(robot, default_library(library))
    target = bundle_folder(parent, robot.name)  # names of strangers may be paths
    return write_bundle(robot, target, check(robot), picture=picture)


@explain_missing_extras()
def fit(
    robot: RobotLike,
    *,
    max_primitives: int = 1,
    iou: float = 0.9,
    spheres: int | None = None,
    cover: float | None = None,
    seed: int = 0,
    jobs: int = 1,
    library: LibraryFolders = (),
) -> FittedRobot:
    """Replace the meshes of a robot by primitives, and measure the fit.

    Examples:
        >>> fitted = morphgen.fit("rethink", max_primitives=2)
        >>> [len(link.fit.primitives) for link in fitted.report.links]
        [1, 2, 1, 2, 1]
        >>> fitted.report.mean.iou > 0.99
        True

    Args:
        robot: The robot, its bundle's folder, a description, or words of ``compose``; or a mesh
            file, which becomes a robot of one link.
        max_primitives: Largest number of primitives per link, 1 to 32.
        iou: Use the fewest primitives that reach this intersection over union.
        spheres: Number of spheres per link, 1 to 32, for a fit with spheres alone.
        cover: Share of a link's volume that its spheres must cover, such as 0.995; by default they
            have the largest intersection over union.
        seed: Seed of the sample points.
        jobs: Number of processes; the result does not depend on it.
        library: Folders of your own parts.

    Returns:
        The quality of each link's fit as ``report``, and the robot with primitives as ``robot``,
        which is made at the first access.

    Raises:
        FitError: If an argument is out of its range, or no link has a shape.
        MissingDependencyError: If the extra ``fit`` is not installed.
        MorphgenError: If the robot cannot be composed or read.
    """
    from morphgen.fitting.link_fit import FitOptions
    from morphgen.fitting.replace_collision import fit_robot

    options = FitOptions(max_primitives, iou, seed, spheres, cover)
    parts = default_library(library)
    if isinstance(robot, str | PathLike) and Path(robot).suffix.lower() in MESH_SUFFIXES:
        path = Path(robot)
        robot = Robot(path.stem, (Link(path.stem, collisions=(Shape(Mesh(path)),)),), ())
    target = resolve_robot(robot, parts)
    return fit_robot(target, options, parts.folders, jobs=jobs)
