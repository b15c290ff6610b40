"""Write a composed robot to a bundle below ``robots/``, or send it to the browser as a zip."""

from __future__ import annotations

from pathlib import Path

from morphgen.checks import check
from morphgen.errors import CompositionError
from morphgen.formats.bundle import bundle_folder, write_bundle
from morphgen.grammar.robot_set import INDEX
from morphgen.model.robot import Robot
from morphgen.viewer.robot_files import new_bundle_files, zip_files
from morphgen.viewer.session import Session

ROBOTS = "robots"
"""Folder in which bundles are written."""


def write_robot(session: Session, robot: Robot, name: str, set_name: str = "") -> None:
    """Write a robot's bundle with findings and picture below ``robots/``.

    Args:
        session: The page.
        robot: The robot.
        name: Name of the bundle's folder.
        set_name: Folder of robots that gets the bundle; empty for ``robots/`` itself.

    Raises:
        CompositionError: If that folder is a set of ``morphgen sample``.
        FormatError: If a name is not a plain folder name, or the bundle cannot be written.
    """
    parent = session.files.roots[0] / ROBOTS
    if set_name:
        parent = bundle_folder(parent, set_name)
        if (parent / INDEX).exists():
            raise CompositionError(
                f"{ROBOTS}/{set_name} is a set of morphgen sample, which draws its robots itself; "
                "expected another name"
            )
    folder = bundle_folder(parent, name)
    target = str(folder.relative_to(session.files.roots[0]))
    session.set_status(f"writing {target}")
    session.run_in_worker(_write_checked, robot, folder)
    session.set_status("")
    session.notify("Written", target)


def send_robot(session: Session, robot: Robot, name: str) -> None:
    """Send a zip of a robot's bundle to the browser.

    Raises:
        FormatError: If the name is not a plain folder name.
    """
    name = bundle_folder(Path(), name).name  # validates the name
    session.set_status("packing the bundle")
    files = session.run_in_worker(new_bundle_files, robot)
    session.client.send_file_download(f"{name}.zip", zip_files(name, files), save_immediately=True)
    session.set_status("")


def _write_checked(robot: Robot, folder: Path) -> None:
    """Write a bundle with findings and picture. Runs in a worker, which may use OpenGL."""
    write_bundle(robot, folder, check(robot))
