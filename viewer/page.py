"""One robot in a browser, with a slider a joint."""

from __future__ import annotations

import socket
from pathlib import Path

import numpy as np
import viser
from viser.extras import ViserUrdf

from morphgen.errors import MorphgenError
from morphgen.formats.bundle import URDF, read_bundle
from morphgen.model.kinematics import bounds, movable_positions
from morphgen.model.robot import Robot


def serve(folder: Path, host: str = "127.0.0.1", port: int = 8080) -> viser.ViserServer:
    """Serve a page that shows a bundle's robot.

    Args:
        folder: The bundle.
        host: Address to bind.
        port: Port; if it is taken, the next free one.

    Returns:
        The running server.

    Raises:
        FormatError: If the folder is no bundle.
        MorphgenError: If the address is none of this machine's.
    """
    robot = read_bundle(folder)
    try:
        with socket.socket() as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise MorphgenError(f"cannot serve at {host!r}: {error.strerror or error}") from error
    server = viser.ViserServer(host=host, port=port, verbose=False)
    server.gui.set_panel_label(robot.name)
    server.scene.add_grid("/grid", width=4.0, height=4.0, cell_size=0.1, section_size=1.0)
    shown = ViserUrdf(server, folder / URDF, root_node_name="/robot")
    _add_sliders(server, robot, shown)
    return server


def _add_sliders(server: viser.ViserServer, robot: Robot, shown: ViserUrdf) -> None:
    sliders: list[viser.GuiInputHandle[float]] = []
    order = [robot.joints[k].name for k in robot.movable]
    actuated = [order.index(name) for name in shown.get_actuated_joint_names()]

    def update(_: object = None) -> None:
        q = np.array([slider.value for slider in sliders])
        shown.update_cfg(movable_positions(robot, q)[actuated])

    for k, (low, high), rest in zip(robot.independent, bounds(robot), robot.home, strict=True):
        slider = server.gui.add_slider(
            robot.joints[k].name, float(low), float(high), 0.001, float(np.clip(rest, low, high))
        )
        slider.on_update(update)
        sliders.append(slider)
    update()
