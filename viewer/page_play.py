"""The page of a rollout: robots at a task, simulated now or played back from a file."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from html import escape

import viser

from morphgen.errors import MorphgenError
from morphgen.tasks.registry import TASKS
from morphgen.viewer import markup
from morphgen.viewer.address import Address, AddressError
from morphgen.viewer.episode import Episode, episode_bytes, read_episode, score_until, snapshot
from morphgen.viewer.episode_export import episode_page, record_scene, render_video
from morphgen.viewer.page_play_controls import (
    RolloutControls,
    add_rollout_controls,
    complete_address,
    parse_rollout,
    rollout_address,
)
from morphgen.viewer.page_play_plots import (
    EpisodePlots,
    add_plots,
    clear_plots,
    show_plots,
    start_plots,
)
from morphgen.viewer.player import SPEEDS, Player
from morphgen.viewer.robot_uri import EPISODE_SUFFIX, uri_name
from morphgen.viewer.rollout import EpisodeSource, RecordedEpisode, Rollout, RolloutConfig
from morphgen.viewer.scene_rollout import RolloutScene, add_episode, show_step
from morphgen.viewer.scene_stage import look_at
from morphgen.viewer.session import Session, set_value

PANEL_WIDTH = 400.0
"""Width of the panel [pixels]."""
PLANNERS = ("ik", "scripted")
"""Policies whose first step takes seconds, because they plan a path."""
ADDRESS_DELAY = 0.5
"""Delay of URL updates after a move of the time slider [s]."""


@dataclass(eq=False)
class PlayPage:
    """Playback in one browser; the display of its player."""

    session: Session
    time: viser.GuiSliderHandle[float]
    fault: viser.GuiHtmlHandle
    score: viser.GuiHtmlHandle
    plots: EpisodePlots
    source: EpisodeSource | None = None
    scene: RolloutScene | None = None
    framed: tuple[str, ...] = ()
    """URIs of the robots that the camera was pointed at."""
    is_planning: bool = False
    """Whether the policy is still planning its first step."""
    position: int | None = None
    """Step at which the user paused; None while the episode plays."""

    def show_start(self, source: EpisodeSource) -> None:
        """Show a new episode at its start."""
        client, self.source = self.session.client, source
        with client.atomic():
            if self.scene is not None:
                self.scene.root.remove()
            self.scene = add_episode(client.scene, source.episode)
        if self.session.closed.is_set():  # the browser has left the page meanwhile
            self.scene.root.remove()
            return
        uris = tuple(track.uri for track in source.episode.tracks)
        if uris != self.framed:  # the next episode of the same robots keeps the user's camera
            self.framed = uris
            look_at(client, self.scene.low, self.scene.high)
        start_plots(self.plots, source.episode)
        self.time.max = max(source.max_steps, 1) * source.episode.period
        self._show_faults(source.faults.values())
        self.is_planning = isinstance(source, Rollout) and source.episode.policy in PLANNERS
        self.session.set_status("the policy plans its path" if self.is_planning else "")

    def show_step(self, step: int) -> None:
        """Show the episode after a number of control steps."""
        if self.scene is None or self.source is None:
            return
        episode = self.source.episode
        with self.session.client.atomic():
            show_step(self.scene, step)
        if step > 0 and self.is_planning:
            self.is_planning = False
            self.session.set_status("")
        set_value(self.time, step * episode.period)
        self.score.content = markup.framed(score_table(episode, step))
        show_plots(self.plots, episode, step)

    def show_stopped(self) -> None:
        """Show errors that ended robots' episodes early."""
        tracks = self.source.episode.tracks if self.source else []
        if faults := [track.fault for track in tracks if track.fault]:
            self._show_faults(faults)

    def show_position(self, step: int | None) -> None:
        """Show in the address where the user paused."""
        self.position = step
        self.session.call_later(ADDRESS_DELAY, self._show_in_address, "address")

    def _show_in_address(self) -> None:
        step, source = self.position, self.source
        text = "" if step is None or source is None else f"{step * source.episode.period:.4g}"
        if text != self.session.address.state.get("t", ""):
            self.session.update_address(self.session.title, t=text)

    def show_failure(self, reason: str) -> None:
        """Show why there is no episode."""
        self.session.set_status("")
        self._show_faults([reason])
        self.score.content = ""
        clear_plots(self.plots)
        if self.scene is not None:
            self.scene.root.remove()
            self.scene = None
        self.source = None

    def _show_faults(self, texts: Iterable[str]) -> None:
        redact = self.session.files.redact
        self.fault.content = "".join(markup.error(redact(text)) for text in texts)


def show(session: Session) -> None:
    """Build the page.

    Raises:
        MorphgenError: If the address names an unknown task, policy or robot, or an invalid episode.
    """
    gui, subject = session.client.gui, session.address.subject
    paused_at = parse_time(session.address.state.get("t", ""))
    header = markup.breadcrumbs((uri_name(subject) or "play", None))
    session.open_panel(PANEL_WIDTH, header, "reading")
    if subject.endswith(EPISODE_SUFFIX):
        episode = read_episode(session.files.path(subject), session.files)
        page, player = _add_player(session)
        gui.add_html(markup.framed(_description(episode)))
        player.load(lambda: RecordedEpisode(episode), start=paused_at)
        session.show_address(f"play {uri_name(subject)}")
    else:
        trained_on = complete_address(session)
        config = parse_rollout(session.address, trained_on)
        page, player = _add_player(session)

        def start(config: RolloutConfig, paused_at: float | None = None) -> None:
            """Show a rollout's address, and let the player simulate it."""
            session.address = rollout_address(config)
            session.show_address(f"{config.task} {uri_name(config.robots[0])}")
            player.load(lambda: Rollout(config, session.files, session.set_status), start=paused_at)

        add_rollout_controls(RolloutControls(session, config, trained_on, start))
        start(config, paused_at)
    with gui.add_folder("Get"):
        _add_downloads(page)


def parse_time(text: str) -> float | None:
    """Return the time at which an address shows an episode [s]; None if the text is empty.

    Raises:
        AddressError: If the text is no time.
    """
    if not text:
        return None
    try:
        time = float(text)
    except ValueError:
        time = math.nan
    if not 0 <= time < math.inf:
        raise AddressError(f"t={text[:40]} is no time; expected seconds, 0 or more")
    return time


def score_table(episode: Episode, step: int) -> str:
    """Return a table of the robots' scores after a number of control steps."""
    rows = []
    for track in episode.tracks:
        i = min(step, track.num_steps)
        score = score_until(track, episode.task, i)
        if score is None:
            rows.append((escape(track.robot.name), "", "", ""))
            continue
        tag = markup.tag("success", "train") if track.success[i - 1] else markup.tag("not yet")
        distance = f"{track.distance[i - 1]:.3f}"
        rows.append((escape(track.robot.name), f"{score:.2f}", distance, tag))
    seconds, simulated = step * episode.period, episode.num_steps * episode.period
    header = ("", "score so far", f"m from {TASKS[episode.task].target}", "now")
    head = markup.dim(f"{seconds:.2f} s; simulated: {simulated:.2f} s")
    return head + markup.table(header, rows, (1, 2))


def _add_player(session: Session) -> tuple[PlayPage, Player]:
    """Add the controls of the playback; return the page and its player."""
    gui = session.client.gui
    fault = gui.add_html("")
    buttons = gui.add_button_group("Episode", ("play", "pause", "back", "step"))
    speeds = tuple(f"{speed:g}x" for speed in SPEEDS)
    speed = gui.add_dropdown("speed", speeds, initial_value="1x")
    time = gui.add_slider("time (s)", 0.0, 6.0, 0.02, 0.0, hint="as far as it was simulated")
    page = PlayPage(session, time, fault, gui.add_html(""), add_plots(session))
    player = Player(page)
    session.on_close(player.stop)
    commands: dict[str, Callable[[], None]] = {
        "play": player.play,
        "pause": player.pause,
        "back": lambda: player.go_by(-1),
        "step": lambda: player.go_by(1),
    }

    def go_to_time() -> None:
        if page.source is not None:
            player.go_to(round(time.value / page.source.episode.period))

    session.on_change(buttons, lambda: commands[buttons.value]())
    session.on_change(speed, lambda: player.set_speed(float(speed.value.removesuffix("x"))))
    session.on_change(time, go_to_time, "time")
    return page, player


def _add_downloads(page: PlayPage) -> None:
    """Add buttons that send the episode as a file, a video or a recorded scene."""
    gui, session = page.session.client.gui, page.session
    downloads: tuple[tuple[str, str, Callable[[Episode], bytes]], ...] = (
        (f"Save episode ({EPISODE_SUFFIX})", EPISODE_SUFFIX, episode_bytes),
        ("Film (.mp4)", ".mp4", functools.partial(session.run_in_worker, render_video)),
        (
            "Web page (.html)",
            ".html",
            lambda episode: session.run_in_worker(episode_page, episode, session.dark),
        ),
        ("Scene (.viser)", ".viser", functools.partial(session.run_in_worker, record_scene)),
    )
    for label, suffix, make in downloads:
        button = gui.add_button(label, icon=viser.Icon.DOWNLOAD)
        send = functools.partial(_send, page, suffix, make)
        session.on_change(button, functools.partial(session.run_in_background, send))


def _send(page: PlayPage, suffix: str, make: Callable[[Episode], bytes]) -> None:
    """Send a file of the episode as far as it has been simulated."""
    if page.source is None:
        raise MorphgenError("there is no episode yet")
    episode = snapshot(page.source.episode)
    seconds = episode.num_steps * episode.period
    page.session.set_status(f"making the {suffix} of {seconds:.2f} s")
    content = make(episode)
    name = f"{episode.task}-{episode.tracks[0].robot.name}-{episode.seed}{suffix}"
    page.session.client.send_file_download(name, content, save_immediately=True)
    page.session.set_status("")


def _description(episode: Episode) -> str:
    """Return a table about a recorded episode, with links to its robots."""
    rows = [
        ("task", escape(episode.task) + (" with obstacles" if episode.obstacles else "")),
        ("policy", escape(episode.policy)),
        ("seed", str(episode.seed)),
        ("simulator", escape(episode.simulator)),
    ]
    for track in episode.tracks:
        rows.append(("robot", markup.link(Address("robot", (track.uri,)), track.robot.name)))
    return markup.table(("recorded", ""), rows)
