"""What PyBullet loads, as files; processes that only load them need none of what writes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from morphgen.formats.bundle import URDF, write_bundle
from morphgen.model.robot import Robot
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.sim.bullet_batch import Exported
from morphgen.tasks.sim.rigid_bodies import rigid_bodies


def export_robots(scenes: Sequence[Scene], folder: Path) -> list[Exported]:
    """Write every robot that the scenes hold, once, for ``BulletBatch``.

    Returns:
        What each scene loads.

    Raises:
        FormatError: If a robot cannot be written.
        MeshError: If a collision mesh cannot be read.
    """
    written: dict[int, Exported] = {}
    for scene in scenes:
        key = id(scene.robot)
        if key not in written:
            written[key] = _export(scene.robot, folder / f"robot{len(written)}")
    return [written[id(scene.robot)] for scene in scenes]


def _export(robot: Robot, folder: Path) -> Exported:
    body = rigid_bodies(robot)
    return write_bundle(body, folder, picture=False) / URDF, body
