"""Check and repair robots, and compare how loaders read them."""

from __future__ import annotations

from pathlib import Path

from morphgen import checks
from morphgen.api.library import LibraryFolders, open_library
from morphgen.checks import fix
from morphgen.checks.conformance import ConformanceReport, conformance, robot_conformance
from morphgen.formats.bundle import CARD, file_findings
from morphgen.formats.urdf import UnsoundError
from morphgen.grammar.library import Library
from morphgen.grammar.robot_source import (
    RobotLike,
    RobotSource,
    find_robot,
    read_source,
)
from morphgen.model.findings import Finding
from morphgen.model.robot import Robot

__all__ = ["check", "check_source", "conform", "conform_source", "fix"]


def check(
    robot: RobotLike, *, tool_required: bool = True, library: LibraryFolders = ()
) -> tuple[Finding, ...]:
    """Find faults of a robot, with a repair for each.

    Examples:
        >>> findings = morphgen.check("ur5-plane")
        >>> [finding.code for finding in findings if finding.severity == "error"]
        []

    Args:
        robot: The robot, its bundle's folder, a description, or words of ``compose``.
        tool_required: Whether a missing tool is a finding; without effect for a file that is not
            a bundle, which need not have one.
        library: Folders of your own parts.

    Returns:
        Findings: errors first, then warnings and hints.

    Raises:
        MorphgenError: If the robot cannot be composed or read.
    """
    if isinstance(robot, Robot):
        return checks.check(robot, tool_required=tool_required)
    return check_source(find_robot(robot), open_library(library), tool_required=tool_required)


def check_source(
    source: RobotSource, library: Library, root: Path | None = None, *, tool_required: bool = True
) -> tuple[Finding, ...]:
    """Find faults of a robot and, if it is a bundle, of its files.

    Args:
        source: The robot, as ``find_robots`` returns it.
        library: Library of the parts.
        root: A folder that meshes, includes and YAML may come from, besides the description's own.
        tool_required: Whether a missing tool is a finding; never for a file without a card.

    Raises:
        MorphgenError: As ``read_source``, but the faults of an unsound file are findings.
    """
    try:
        robot = read_source(source, library, root)
    except UnsoundError as error:
        return error.findings
    folder = bundle_of(source)
    required = tool_required and (folder is not None or source.path is None)
    findings = checks.check(robot, tool_required=required)
    return (*findings, *file_findings(folder)) if folder is not None else findings


def bundle_of(source: RobotSource) -> Path | None:
    """Return the folder of a source's bundle, of which it may be a file; None if it has none."""
    if source.path is None:
        return None
    folder = source.path if source.path.is_dir() else source.path.parent
    return folder if (folder / CARD).is_file() else None


def conform(
    robot: RobotLike, *, samples: int = 100, seed: int = 0, library: LibraryFolders = ()
) -> ConformanceReport:
    """Load a robot in every installed loader and compare joints, mass and tool pose.

    The loaders are yourdfpy, PyBullet, MuJoCo (URDF and MJCF) and Pinocchio.

    Examples:
        >>> report = morphgen.conform("ur5-plane", samples=10)
        >>> report.passed
        True
        >>> report.rows[2].loader, report.rows[2].position_error < 1e-5
        ('mujoco (urdf)', True)

    Args:
        robot: The robot, its bundle's folder, a description, or words of ``compose``. The files
            of a bundle are loaded; for anything else a temporary bundle is written.
        samples: Number of random configurations within the joint limits.
        seed: Seed of the configurations.
        library: Folders of your own parts.

    Returns:
        The report; ``rows`` has an entry for each loader.

    Raises:
        FormatError: If ``samples`` is below 1, ``seed`` is below 0, or the robot's name cannot be
            that of a folder.
        MorphgenError: If the robot cannot be composed or read.
    """
    if isinstance(robot, Robot):
        return robot_conformance(robot, samples, seed)
    return conform_source(find_robot(robot), open_library(library), samples=samples, seed=seed)


def conform_source(
    source: RobotSource,
    library: Library,
    root: Path | None = None,
    *,
    samples: int = 100,
    seed: int = 0,
) -> ConformanceReport:
    """Compare the loaders on a bundle, or on a robot whose bundle is written for it.

    Args:
        source: The robot, as ``find_robots`` returns it.
        library: Library of the parts.
        root: A folder that meshes, includes and YAML may come from, besides the description's own.
        samples: Number of random configurations within the joint limits.
        seed: Seed of the configurations.

    Raises:
        MorphgenError: As ``read_source``.
    """
    if source.path is not None and (source.path / CARD).is_file():
        return conformance(source.path, samples, seed)
    return robot_conformance(read_source(source, library, root), samples, seed)
