"""Curves of an episode under the playback controls: distance and score of every robot over time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import viser
from viser import uplot

from morphgen.tasks.registry import TASKS
from morphgen.typing import Array
from morphgen.viewer.episode import Episode, score_until
from morphgen.viewer.session import Session

PLOT_INTERVAL = 0.25
"""Time between two updates of the curves [s]."""
COLOURS = (
    *("#1c7ed6", "#f76707", "#2f9e44", "#ae3ec9", "#e03131"),
    *("#0ca678", "#f59f00", "#7048e8", "#868e96"),
)
"""Colours of the robots, in their order."""
_HEIGHT = 150
"""Height of a chart [pixels]."""
_NOW = "#868e96"
"""Colour of the line at the current time."""


@dataclass(eq=False)
class EpisodePlots:
    """The charts of a page."""

    session: Session
    folder: viser.GuiFolderHandle
    charts: list[viser.GuiUplotHandle] = field(default_factory=list)
    """Charts of the distance and of the score; empty until an episode is shown."""
    step: int = 0
    """Number of control steps that the scene shows."""
    scores: list[list[float]] = field(default_factory=list)
    """Score after every step by robot, as far as it was computed."""


def add_plots(session: Session) -> EpisodePlots:
    """Add the folder of the charts."""
    return EpisodePlots(session, session.client.gui.add_folder("Distance and score"))


def start_plots(plots: EpisodePlots, episode: Episode) -> None:
    """Replace the charts by those of a new episode."""
    clear_plots(plots)
    plots.step, plots.scores = 0, [[] for _ in episode.tracks]
    names = [track.robot.name for track in episode.tracks]
    target = TASKS[episode.task].target
    dark = plots.session.dark
    with plots.folder:
        for label, data in zip(
            (f"m from {target}", "score so far"), curves(episode, 0, plots.scores), strict=True
        ):
            plots.charts.append(
                plots.session.client.gui.add_uplot(
                    data,
                    _series(names),
                    axes=(_axis("time (s)", dark=dark), _axis(label, dark=dark)),
                    scales={"x": uplot.Scale(time=False)},
                    legend=uplot.Legend(show=label == "score so far" and len(names) > 1),
                    height=_HEIGHT,
                )
            )


def clear_plots(plots: EpisodePlots) -> None:
    """Remove the charts."""
    for chart in plots.charts:
        chart.remove()
    plots.charts = []


def show_plots(plots: EpisodePlots, episode: Episode, step: int) -> None:
    """Update the charts to what is simulated and shown, at most every ``PLOT_INTERVAL``."""
    plots.step = step
    plots.session.call_later(PLOT_INTERVAL, lambda: _update(plots, episode), "plots")


def _update(plots: EpisodePlots, episode: Episode) -> None:
    if len(plots.scores) != len(episode.tracks):  # another episode has begun meanwhile
        return
    for chart, data in zip(plots.charts, curves(episode, plots.step, plots.scores), strict=False):
        chart.data = data


def curves(
    episode: Episode, step: int, scores: list[list[float]]
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return the data of both charts: time, the robots' curves, and a line at a step.

    uPlot has no vertical lines; a curve at the bottom with a peak at the step looks like one.

    Args:
        episode: The episode, as far as it is simulated.
        step: Number of control steps that the scene shows.
        scores: Scores by robot that are known; missing ones are appended.

    Returns:
        Data of distance and of score: 2 + R arrays of the length of the episode. Robots whose
        episode ended earlier keep their last value, because uPlot draws no curve with NaN.
    """
    num_steps = max(episode.num_steps, 1)
    time = np.arange(1, num_steps + 1) * episode.period
    distances, totals = [], []
    for track, known in zip(episode.tracks, scores, strict=True):
        n = min(len(track.score), len(track.distance), num_steps)
        for i in range(len(known) + 1, n + 1):
            value = score_until(track, episode.task, i)
            known.append(0.0 if value is None else value)
        distances.append(_padded(track.distance[:n], num_steps))
        totals.append(_padded(known[:n], num_steps))
    is_now = np.arange(1, num_steps + 1) == min(step, num_steps)

    def with_line(values: list[Array]) -> tuple[Array, ...]:
        low, high = np.min(values), np.max(values)
        return (time, *values, np.where(is_now, high, low))

    return with_line(distances), with_line(totals)


def _padded(values: list[float], length: int) -> Array:
    """Return values, the last one repeated up to a length; zeros if there are none."""
    last = values[-1] if values else 0.0
    return np.array([*values, *[last] * (length - len(values))], dtype=np.float64)


def _series(names: list[str]) -> tuple[uplot.Series, ...]:
    """Return the curves of the robots, and the line at the current time."""
    colours = [COLOURS[i % len(COLOURS)] for i in range(len(names))]
    lines = [
        uplot.Series(label=name, stroke=colour, width=2, points={"show": False})
        for name, colour in zip(names, colours, strict=True)
    ]
    now = uplot.Series(label="shown", stroke=_NOW, width=1, points={"show": False})
    return (uplot.Series(label="time (s)"), *lines, now)


def _axis(label: str, *, dark: bool) -> uplot.Axis:
    """Return an axis whose text is readable on the page."""
    colour, lines = ("#ced4da", "#495057") if dark else ("#495057", "#e9ecef")
    return uplot.Axis(
        label=label,
        labelSize=18,
        size=34,
        labelFont="11px sans-serif",
        font="11px sans-serif",
        stroke=colour,
        grid={"stroke": lines, "width": 1},
        ticks={"stroke": lines, "width": 1, "size": 4},
    )
