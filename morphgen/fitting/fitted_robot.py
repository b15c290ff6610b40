"""A robot whose collision shapes are fitted primitives, with the quality of the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
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
    report: FitReport
    """The primitives of each link, and their measured quality."""
    folders: tuple[Path, ...] = ()
    """Folders of parts, for their stored fits."""
    visual: bool = False
    """Whether ``robot`` has the primitives as its visual shapes, too."""

    @cached_property
    def robot(self) -> Robot:
        """The same robot with the primitives as its collision shapes, made at the first access.

        Its provenance has the report without durations.

        Raises:
            MeshError: If a mesh cannot be read.
            RobotError: If a joint axis is zero.
        """
        primitives = {row.link: row.fit.primitives for row in self.report.links}
        fits = fits_of(self.source, self.report, read_stored_fits(self.folders))
        fitted = with_fits(with_primitives(self.source, primitives, visual=self.visual), fits)
        provenance = {**self.source.provenance, "primitives": self.report.without_times()}
        return replace(fitted, provenance=provenance)

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
    folders: tuple[Path, ...] = (),
    *,
    visual: bool = False,
    jobs: int = 1,
) -> FittedRobot:
    """Fit primitives to a robot's links.

    visual: Whether to replace the visual shapes, too.
    """
    if not any(map(shapes_to_fit, robot.links)):
        raise FitError(f"robot {robot.name!r}: no link has a shape")
    report = fit_links(robot, options, jobs=jobs)
    return FittedRobot(robot, report, folders, visual)
