"""The controls of the workspace on the robot page: the position of the slice, and the legend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser

from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.scene_overlays import OFTEN, SELDOM
from morphgen.viewer.session import Session, set_value
from morphgen.viewer.workspace import NUM_POINTS, sample_workspace

_STEP = 0.01
"""Step of the slice [m]."""


@dataclass(eq=False)
class WorkspaceView:
    """The workspace of a page's robot."""

    position: viser.GuiSliderHandle[float]
    """Position y of the slice [m]."""
    legend: viser.GuiHtmlHandle
    points: Array | None = None
    """Tool positions, shape (n, 3) [m]; None until they are sampled."""


def add_controls(session: Session) -> WorkspaceView:
    """Add the slider and the legend, hidden until the workspace is shown."""
    gui = session.client.gui
    slider = gui.add_slider("slice at y [m]", -1.0, 1.0, _STEP, 0.0, visible=False)
    return WorkspaceView(slider, gui.add_html(""))


def show_controls(workspace: WorkspaceView, *, visible: bool) -> None:
    """Show or hide the slider and the legend."""
    workspace.position.visible = visible
    workspace.legend.content = markup.framed(_legend(workspace.points)) if visible else ""


def sample(workspace: WorkspaceView, robot: Robot, text: str) -> None:
    """Sample the workspace and set the range of the slider.

    Args:
        workspace: The workspace.
        robot: The robot.
        text: Position of the slice in the address; anything but a number means zero.
    """
    points = workspace.points = sample_workspace(robot)
    slider = workspace.position
    slider.min = float(np.floor(points[:, 1].min() / _STEP) * _STEP)
    slider.max = float(max(np.ceil(points[:, 1].max() / _STEP) * _STEP, slider.min + _STEP))
    try:
        y = float(text)
    except ValueError:
        y = 0.0
    y = y if np.isfinite(y) else 0.0
    set_value(slider, float(np.clip(y, slider.min, slider.max)))


def slice_state(workspace: WorkspaceView | None) -> str:
    """Return the position of the slice for the address; empty at zero."""
    y = workspace.position.value if workspace is not None else 0.0
    return f"{y:.3g}" if abs(y) > _STEP / 2 else ""


def _legend(points: Array | None) -> str:
    """Return what the colours of the workspace mean."""
    if points is None:
        return ""
    seldom, often = (f"rgb({r},{g},{b})" for r, g, b in (SELDOM.tolist(), OFTEN.tolist()))
    low, high = points.min(axis=0), points.max(axis=0)
    sides = " × ".join(f"{side:.2f}" for side in high - low)  # noqa: RUF001
    return (
        f'<div class="scale" style="background:linear-gradient(90deg,{seldom},{often})"></div>'
        + '<div class="ends"><span>few configurations</span><span>many</span></div>'
        + markup.dim(
            f"Surface: outermost tool positions of {NUM_POINTS:,} random configurations, "
            f"{sides} m. Slice: how many of them lead to each cell."
        )
    )
