"""Encode and compare robots."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from morphgen.arguments import text_argument
from morphgen.encoding import tokens as encoding
from morphgen.encoding.similarity import MEASURES, features, get_measure, similarity_matrix
from morphgen.encoding.tokens import default_max_links
from morphgen.errors import BenchmarkError
from morphgen.extras import explain_missing_extras
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.library import LibraryFolders, default_library
from morphgen.grammar.robot_source import RobotLike, resolve_robot, robot_list
from morphgen.typing import Array


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
