"""A robot with fitted primitives, and the quality of the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from morphgen.errors import FitError
from morphgen.fitting.link_fit import FitOptions
from morphgen.fitting.replace_collision import with_fits, with_primitives
from morphgen.fitting.robot_fit import FitReport, fit_links, fits_of
from morphgen.formats.fits import read_stored_fits
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


def fit_robot(
    robot: Robot,
    options: FitOptions,
    folders: tuple[Path, ...] = (),
    *,
    visual: bool = False,
    jobs: int = 1,
) -> FittedRobot:
    """Fit primitives to a robot's links; ``visual``: they replace the visual shapes, too."""
    if not any(link.solid_shapes for link in robot.links):
        raise FitError(f"robot {robot.name!r}: no link has a shape")
    report = fit_links(robot, options, jobs=jobs)
    return FittedRobot(robot, report, folders, visual)
