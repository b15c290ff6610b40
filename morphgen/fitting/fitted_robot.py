"""A robot whose collision shapes are fitted primitives, with the quality of the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from morphgen.errors import FitError
from morphgen.fitting.agreement import Agreement, agreement
from morphgen.fitting.link_fit import FitOptions
from morphgen.fitting.part_fits import fits_of
from morphgen.fitting.replace_collision import with_fits, with_primitives
from morphgen.fitting.robot_fit import FitReport, fit_links
from morphgen.formats.fits import read_stored_fits, shapes_to_fit
from morphgen.model.robot import Robot


@dataclass(frozen=True)
class FittedRobot:
    """A fit of primitives to a robot."""

    source: Robot
    """The robot whose shapes were fitted."""
    robot: Robot
    """The same robot with the primitives as its collision shapes."""
    report: FitReport
    """The primitives of each link, and their measured quality."""

    def agreement(self, configurations: int = 1000, seed: int = 0) -> tuple[Agreement, Agreement]:
        """Compare self-collisions with those of the meshes over random configurations.

        Args:
            configurations: Number of configurations within the joint limits.
            seed: Seed of the configurations.

        Returns:
            The agreement of the primitives, and that of the meshes' convex hulls, with the meshes.
        """
        return agreement(self.source, self.robot, configurations, seed)


def fit_robot(
    robot: Robot,
    options: FitOptions,
    folders: Sequence[Path] = (),
    *,
    visual: bool = False,
    jobs: int = 1,
) -> FittedRobot:
    """Fit primitives to a robot's links, and replace its collision shapes by them.

    Args:
        robot: The robot.
        options: Options of the fits.
        folders: Folders of parts, for their stored fits.
        visual: Whether to replace the visual shapes, too.
        jobs: Number of processes; the result does not depend on it.

    Raises:
        FitError: If no link has a shape.
        MeshError: If a mesh cannot be read.
        MorphgenError: If a process died.
    """
    require_shapes(robot, robot.name)
    report = fit_links(robot, options, jobs=jobs)
    return FittedRobot(robot, apply_fit(robot, report, folders, visual=visual), report)


def require_shapes(robot: Robot, name: str) -> None:
    """Require a shape to fit.

    Raises:
        FitError: If no link has one; ``name`` is the robot's name in the message.
    """
    if not any(map(shapes_to_fit, robot.links)):
        raise FitError(f"{name}: no link has a shape")


def apply_fit(
    robot: Robot, report: FitReport, folders: Sequence[Path] = (), *, visual: bool = False
) -> Robot:
    """Return a robot with the primitives of a report as its collision shapes.

    Its provenance has the report without durations.

    Args:
        robot: The robot that was fitted.
        report: Its fits.
        folders: Folders of parts, for their stored fits.
        visual: Whether to replace the visual shapes, too.

    Raises:
        MeshError: If a mesh cannot be read.
        RobotError: If a joint axis is zero.
    """
    primitives = {row.link: row.fit.primitives for row in report.links}
    fits = fits_of(robot, report, read_stored_fits(folders))
    fitted = with_fits(with_primitives(robot, primitives, visual=visual), fits)
    provenance = {**robot.provenance, "primitives": report.without_times()}
    return replace(fitted, provenance=provenance)
