"""Check and repair robots, and compare how loaders read them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from morphgen import checks
from morphgen.checks.conformance import ConformanceReport, compare_file, conformance
from morphgen.formats.bundle import CARD, bundle_folder, file_findings, write_bundle
from morphgen.formats.resolve import default_finder
from morphgen.formats.urdf.read import UnsoundError
from morphgen.grammar.library import Library, LibraryFolders, default_library
from morphgen.grammar.robot_source import (
    RobotLike,
    RobotReference,
    find_robot,
    read_source,
    resolve_robot,
)
from morphgen.model.findings import Finding
from morphgen.model.robot import Robot


def check(robot: RobotLike, *, library: LibraryFolders = ()) -> tuple[Finding, ...]:
    """Find faults of a robot, with a repair for each.

    Examples:
        >>> findings = morphgen.check("ur5-plane")
        >>> [finding.code for finding in findings if finding.severity == "error"]
        []

    Args:
        robot: The robot, its bundle's folder, a description, or words of ``compose``.
        library: Folders of your own parts.

    Returns:
        Findings: errors first, then warnings and hints.

    Raises:
        MorphgenError: If the robot cannot be composed or read.
    """
    if isinstance(robot, Robot):
        return checks.check(robot)
    return check_source(find_robot(robot), default_library(library))


def fix(robot: RobotLike, *, library: LibraryFolders = ()) -> tuple[Robot, tuple[Finding, ...]]:
    """Apply all safe repairs to a robot.

    Args:
        robot: The robot, its bundle's folder, a description, or words of ``compose``.
        library: Folders of your own parts.

    Returns:
        The repaired robot, whose provenance lists the repairs, and the repaired findings.

    Raises:
        MorphgenError: If the robot cannot be composed or read.
    """
    return checks.fix(resolve_robot(robot, default_library(library)))


def check_source(
    source: RobotReference, library: Library, root: Path | None = None
) -> tuple[Finding, ...]:
    """Find faults of a robot, also an unsound one, and of a bundle; a lone URDF needs no tool."""
    try:
        robot = read_source(source, library, root)
    except UnsoundError as error:
        return error.findings
    folder = bundle_of(source)
    is_robot = folder is not None or source.path is None
    findings = checks.check(robot, tool_required=is_robot)
    return (*findings, *file_findings(folder)) if folder is not None else findings


def bundle_of(source: RobotReference) -> Path | None:
    """Return the folder of a source's bundle, of which it may be a file; None if it has none."""
    if source.path is None:
        return None
    folder = source.path if source.path.is_dir() else source.path.parent
    return folder if (folder / CARD).is_file() else None


def conform(
    robot: RobotLike, *, samples: int = 100, seed: int = 0, library: LibraryFolders = ()
) -> ConformanceReport:
    """Compare a robot in every installed loader, and measure how it holds its home.

    The loaders are yourdfpy, PyBullet, MuJoCo (URDF and MJCF) and Pinocchio. They are compared in
    joints, limits, couplings, damping, gains, mass, tool pose, gravity torque and inertia. A URDF,
    xacro or MJCF is also loaded as it is, which gives rows of ``source`` ``file``, for information.
    The robot then holds its home for 5 s: its MJCF in MuJoCo, its URDF in PyBullet.

    Examples:
        >>> report = morphgen.conform("ur5-plane", samples=10)
        >>> report.passed
        True
        >>> report.rows[2].loader, report.rows[2].position_error < 1e-5
        ('mujoco (urdf)', True)
        >>> report.holds[0].simulator, report.holds[0].drift < 0.02
        ('mujoco (mjcf)', True)

    Args:
        robot: The robot, its bundle's folder, a description, or words of ``compose``. The files
            of a bundle are loaded; for anything else a temporary bundle is written.
        samples: Number of random configurations within the joint limits.
        seed: Seed of the configurations.
        library: Folders of your own parts.

    Returns:
        The report; ``rows`` has an entry for each loader, ``holds`` one for each simulator.

    Raises:
        FormatError: If ``samples`` is below 1, ``seed`` is below 0, or the robot's name cannot be
            that of a folder.
        MorphgenError: If the robot cannot be composed or read.
    """
    if isinstance(robot, Robot):
        return _conform_robot(robot, samples, seed)
    return conform_source(find_robot(robot), default_library(library), samples=samples, seed=seed)


def conform_source(
    source: RobotReference,
    library: Library,
    root: Path | None = None,
    *,
    samples: int = 100,
    seed: int = 0,
) -> ConformanceReport:
    """Compare loaders and simulators on a file, and on its bundle; see ``conform``."""
    if source.path is not None and (source.path / CARD).is_file():
        return conformance(source.path, samples, seed, holds=True)
    # First the bundle that morphgen makes of the file, then the file as it is.
    report = _conform_robot(read_source(source, library, root), samples, seed)
    if source.path is None or source.path.is_dir():
        return report
    rows = compare_file(source.path, default_finder(root=root), samples, seed)
    return replace(report, rows=(*rows, *report.rows))


def _conform_robot(robot: Robot, samples: int, seed: int) -> ConformanceReport:
    with TemporaryDirectory() as folder:  # loaders read files
        bundle = bundle_folder(Path(folder), robot.name)
        write_bundle(robot, bundle, checks.check(robot), picture=False)
        return conformance(bundle, samples, seed, holds=True)
