"""Fit primitives to robots."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.arguments import checked_signature
from morphgen.extras import explain_missing_extras
from morphgen.grammar.library import LibraryFolders, default_library
from morphgen.grammar.robot_source import RobotLike, resolve_robot
from morphgen.model.geometry import MESH_SUFFIXES, Mesh, Shape
from morphgen.model.robot import Link, Robot

if TYPE_CHECKING:
    from morphgen.fitting.fitted_robot import FittedRobot
    from morphgen.fitting.link_fit import Search


@checked_signature
@explain_missing_extras()
def fit(
    robot: RobotLike,
    *,
    max_primitives: int = 1,
    iou: float = 0.9,
    enclose: bool = False,
    spheres: int | None = None,
    cover: float | None = None,
    search: Search = "clusters",
    visual: bool = False,
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
        enclose: Enclose every point of a link, for conservative collision checks.
        spheres: Number of spheres per link, 1 to 32, for a fit with spheres alone.
        cover: Share of a link's volume that its spheres must cover, such as 0.995; by default they
            have the largest intersection over union.
        search: How several primitives are searched for: ``residual`` takes two to three
            times as long, gets closer, and uses capsules, too.
        visual: Replace the visual shapes, too.
        seed: Seed of the sample points.
        jobs: Number of processes; the result does not depend on it.
        library: Folders of your own parts.

    Returns:
        The quality of each link's fit as ``report``, and the robot with primitives as ``robot``,
        which is made at the first access; ``agreement()`` compares its self-collisions with those
        of the meshes.

    Raises:
        FitError: If an argument is out of its range, or no link has a shape.
        MissingDependencyError: If the extra ``fit`` is not installed.
        MorphgenError: If the robot cannot be composed or read.
    """
    from morphgen.fitting.fitted_robot import fit_robot
    from morphgen.fitting.link_fit import FitOptions

    options = FitOptions(max_primitives, iou, enclose, seed, spheres, cover, search)
    parts = default_library(library)
    target = _mesh_robot(robot) or resolve_robot(robot, parts)
    return fit_robot(target, options, parts.folders, visual=visual, jobs=jobs)


def _mesh_robot(source: RobotLike) -> Robot | None:
    """Return a robot of one link for a mesh file; None for anything else."""
    if not isinstance(source, str | PathLike) or Path(source).suffix.lower() not in MESH_SUFFIXES:
        return None
    path = Path(source)
    return Robot(path.stem, (Link(path.stem, collisions=(Shape(Mesh(path)),)),), ())
