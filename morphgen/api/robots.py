"""Compose, sample, read, write, fit, encode and compare robots; make environments of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike

from morphgen.checks import check
from morphgen.encoding import tokens as encoding
from morphgen.encoding.similarity import MEASURES, features, get_measure, similarity_matrix
from morphgen.encoding.tokens import default_max_links
from morphgen.errors import (
    BenchmarkError,
    CompositionError,
    FormatError,
    GrammarError,
    TaskError,
    explain_missing_extras,
    nearest,
    path_argument,
    text_argument,
    truth,
    whole_number,
)
from morphgen.fitting.replace_collision import GEOMETRIES, with_geometry
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import bundle_folder, read_robot, write_bundle
from morphgen.grammar.analysis import load_sound_grammar
from morphgen.grammar.compose import compose as compose_derivation
from morphgen.grammar.library import LibraryFolders, default_library
from morphgen.grammar.request import parse_words
from morphgen.grammar.robot_source import RobotLike, is_one_robot, resolve_robot, robot_list
from morphgen.grammar.sampling import SamplingError, sample_robots
from morphgen.grammar.values import parse_conditions
from morphgen.model.geometry import MESH_SUFFIXES
from morphgen.model.robot import Robot
from morphgen.typing import Array

if TYPE_CHECKING:
    from morphgen.fitting.replace_collision import FittedRobot
    from morphgen.tasks.gym.env import TaskEnv
    from morphgen.tasks.gym.vector import TaskVector


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
            cylinders and spheres in place of meshes; ``convex`` for convex pieces of meshes.
        library: Folders of your own parts and grammars.
        **words: More ``key=value`` words. Values without a unit are in SI units.

    Raises:
        MissingDependencyError: If primitives have to be fitted and the extra ``fit`` is
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
        FitError: If an argument is out of its range, or no link has a shape with a volume.
        MissingDependencyError: If the extra ``fit`` is not installed.
        MorphgenError: If the robot cannot be composed or read.
    """
    from morphgen.fitting.link_fit import FitOptions
    from morphgen.fitting.replace_collision import fit_robot, mesh_robot

    options = FitOptions(max_primitives, iou, seed, spheres, cover)
    parts = default_library(library)
    if isinstance(robot, str | PathLike) and Path(robot).suffix.lower() in MESH_SUFFIXES:
        robot = mesh_robot(Path(robot))
    target = resolve_robot(robot, parts)
    return fit_robot(target, options, parts.folders, jobs=jobs)


@overload
def make_env(
    task: str, robot: RobotLike = ..., *, num_envs: None = None, **options: object
) -> TaskEnv: ...
@overload
def make_env(
    task: str,
    robot: RobotLike | Sequence[RobotLike] = ...,
    *,
    num_envs: int,
    **options: object,
) -> TaskVector: ...
@explain_missing_extras()
def make_env(
    task: str,
    robot: RobotLike | Sequence[RobotLike] = "ur5-plane",
    *,
    num_envs: int | None = None,
    **options: Any,
) -> TaskEnv | TaskVector:
    """Make a Gymnasium environment of a robot at a task, or a vector environment of several.

    Examples:
        >>> env = morphgen.make_env("reach", "arm=ur5 ee=plane")
        >>> observation, info = env.reset(seed=0)
        >>> action = env.action_space.sample()
        >>> observation, reward, terminated, truncated, info = env.step(action)
        >>> terminated, truncated
        (False, False)
        >>> env.close()
        >>> envs = morphgen.make_env("reach", ["ur5-plane", "arm3-stick"], num_envs=4)
        >>> envs.reset(seed=0)[0]["tokens"].shape
        (4, 10, 48)
        >>> envs.close()

    Args:
        task: Name of a task, such as ``reach`` or ``push``.
        robot: A robot, or its name: words of ``compose``, parts joined by dashes, a bundle's folder
            or a URDF. For vector environments it may be a list: environment i has robot i modulo
            their number.
        num_envs: None for one environment without a batch axis, ``TaskEnv``; a number, also 1, for
            that many in a vector environment, ``TaskVector``.
        **options: The simulator (``sim="pybullet"``), ``obstacles=True``, ``kind="discrete"``,
            ``library`` and others: for one environment those of ``TaskEnv``, such as
            ``render_mode="rgb_array"``; for vector environments those of ``make_batch``, such as
            ``workers=2``.

    Raises:
        TaskError: If an argument is unknown or invalid.
        MissingDependencyError: If the extra ``tasks`` or the simulator is not installed.
        MorphgenError: If a robot cannot be composed or read, or cannot do the task.
    """
    texts: dict[str, object] = {"task": task, **options}
    for name in ("task", "sim", "kind"):
        if name in texts and (name, texts[name]) != ("sim", None):
            text_argument(name, texts[name], TaskError)
    if num_envs is None:
        from morphgen.tasks.gym.env import TaskEnv

        if not is_one_robot(robot):
            raise TaskError(f"robot {robot!r}: expected one robot; name several with num_envs")
        return TaskEnv(task, robot, **options)
    from morphgen.tasks.gym.vector import task_vector

    several = robot_list(robot)
    if not several:
        raise TaskError("robot []: expected at least one robot")
    return task_vector(num_envs, task=task, robots=several, **options)


@explain_missing_extras()
def tokens(
    robot: RobotLike,
    q: ArrayLike | None = None,
    *,
    max_links: int | None = None,
    library: LibraryFolders = (),
) -> Array:
    """Encode a robot as 48 numbers per link, the input of the paper's policies.

    Examples:
        >>> robot = morphgen.compose("ur5-plane")
        >>> morphgen.tokens(robot).shape == (len(robot.links), 48)
        True

    Args:
        robot: The robot, its bundle's folder, a description, or words of ``compose``.
        q: Independent joint positions, shape (..., dof) [rad or m]; by default the home.
        max_links: Number that link indices are relative to, the same for all robots that are
            compared; by default the paper's 23, or the links of the robot if it has more.
        library: Folders of your own parts.

    Returns:
        Tokens of the links, root first, shape (..., n_links, 48);
        ``morphgen.encoding.tokens.LAYOUT`` describes their fields.

    Raises:
        BenchmarkError: If the robot has more links than ``max_links`` or cannot be encoded.
        MissingDependencyError: If a mesh has to be fitted and the extra ``fit`` is missing.
        MorphgenError: If the robot cannot be composed or read.
        ValueError: If the last axis of ``q`` is not ``robot.dof`` long.
    """
    parts = default_library(library)
    loaded = resolve_robot(robot, parts)
    size = default_max_links([len(loaded.links)]) if max_links is None else max_links
    if q is not None:
        try:
            q = np.asarray(q, dtype=np.float64)
        except (TypeError, ValueError):
            raise BenchmarkError(f"q {q!r}: expected joint positions") from None
    return encoding.tokens(loaded, token_shapes(loaded, parts.folders), q, max_links=size)


@explain_missing_extras()
def similarity(
    robots: Iterable[RobotLike],
    measures: Sequence[str] = tuple(MEASURES),
    *,
    max_links: int | None = None,
    library: LibraryFolders = (),
) -> dict[str, Array]:
    """Compare all pairs of robots by their tokens, kinematic trees and workspaces.

    Examples:
        >>> values = morphgen.similarity(["ur5-plane", "ur10-plane", "arm3-stick"])
        >>> list(values)
        ['cosine', 'tree', 'workspace']
        >>> bool(values["tree"][0, 1] < values["tree"][0, 2])
        True

    Args:
        robots: Two or more robots, each given itself or named as for ``tokens``.
        measures: Names of measures: ``cosine`` of the tokens, ``tree``, the edit distance of the
            kinematic trees, and ``workspace``, the overlap of the tool positions.
        max_links: See ``tokens``; by default at least the links of the largest robot.
        library: Folders of your own parts.

    Returns:
        A symmetric matrix by measure, shape (n, n), in the order of the robots. 1 means equal for
        ``cosine`` and ``workspace``, 0 for the distance ``tree``.

    Raises:
        BenchmarkError: If a measure is unknown, there are fewer than two robots, or a robot has
            no movable tool.
        MissingDependencyError: If a mesh has to be fitted and the extra ``fit`` is missing.
        MorphgenError: If a robot cannot be composed or read.
    """
    several = (
        [measures] if isinstance(measures, str) or not isinstance(measures, Iterable) else measures
    )
    names = [text_argument("measure", name, BenchmarkError) for name in several]
    if not names:
        raise BenchmarkError(f"no measure is named; valid: {', '.join(MEASURES)}")
    for name in names:  # before robots are read and fitted
        get_measure(name)
    parts = default_library(library)
    loaded = [resolve_robot(robot, parts) for robot in robot_list(robots)]
    if len(loaded) < 2:
        raise BenchmarkError(f"{len(loaded)} robots to compare; expected a list of two or more")
    size = default_max_links(len(each.links) for each in loaded) if max_links is None else max_links
    compared = [
        features(each, token_shapes(each, parts.folders), max_links=size) for each in loaded
    ]
    return {name: similarity_matrix(compared, name) for name in names}
