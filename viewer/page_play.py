"""The page on which bodies do their tasks: simulated now, or as they were recorded."""

from __future__ import annotations

import functools
from collections.abc import Callable
from html import escape

import viser

from morphgen.errors import MorphgenError
from morphgen.viewer import browser, episode_export, markup
from morphgen.viewer.address import Address
from morphgen.viewer.episode import Episode, episode_bytes, read_episode, still
from morphgen.viewer.page_play_controls import add_choices, begin, parse_rollout, trained_bodies
from morphgen.viewer.play_screen import PlayPage, playing
from morphgen.viewer.player import SPEEDS, Player
from morphgen.viewer.robot_uri import EPISODE_SUFFIX, name_of
from morphgen.viewer.rollout import Recorded
from morphgen.viewer.session import Session, at_end, in_worker, later, say, when

SIDE = 400.0
"""Width of the panel, pixels."""


def show(session: Session) -> None:
    """Build the page.

    Raises:
        MorphgenError: If its address names no task, nothing that plays, or a broken episode.
    """
    page = PlayPage(session)
    gui, subject = session.client.gui, session.address.subject
    gui.set_panel_label("morphgen")
    gui.main_panel.dock_right()
    gui.main_panel.set_width(SIDE)
    gui.add_html(markup.STYLE + markup.crumbs((name_of(subject) or "play", None)))
    session.status = gui.add_html(markup.status("reading"))
    episode = None
    if subject.endswith(EPISODE_SUFFIX):
        episode = read_episode(session.places.path(subject), session.places)
    else:
        page.trained = trained_bodies(page)
        page.wanted = parse_rollout(session.address, page.trained)
    page.texts["fault"] = gui.add_html("")
    _add_time(page)
    page.texts["score"] = gui.add_html("")
    if page.wanted is not None:
        add_choices(page, page.wanted)
    elif episode is not None:
        gui.add_html(markup.framed(_about(episode)))
    with gui.add_folder("Get"):
        _add_downloads(page)
    player = page.player = Player(page)
    at_end(session, player.stop)
    if episode is not None:
        recorded = Recorded(episode)
        player.prepare(lambda: recorded)
        browser.show_query(session.client, session.address.query, f"play {name_of(subject)}")
    else:
        begin(page)


def _add_time(page: PlayPage) -> None:
    gui, session = page.session.client.gui, page.session
    buttons = gui.add_button_group("Episode", ("play", "pause", "back", "step"))
    speed = gui.add_dropdown("speed", tuple(f"{each:g}x" for each in SPEEDS), initial_value="1x")
    time = gui.add_slider("time (s)", 0.0, 6.0, 0.02, 0.0, hint="as far as it was simulated")
    page.controls |= {"buttons": buttons, "speed": speed, "time": time}

    def pressed() -> None:
        player = playing(page)
        match buttons.value:
            case "play":
                player.play()
            case "pause":
                player.pause()
            case "back":
                player.go_by(-1)
            case _:
                player.go_by(1)

    when(buttons, session, pressed)
    when(speed, session, lambda: playing(page).at_speed(float(speed.value.removesuffix("x"))))
    when(time, session, lambda: _scrub(page), "time")


def _scrub(page: PlayPage) -> None:
    if page.source is not None:
        playing(page).go_to(round(page.controls["time"].value / page.source.episode.period))


def _add_downloads(page: PlayPage) -> None:
    gui, session = page.session.client.gui, page.session
    film = functools.partial(in_worker, session, episode_export.film)
    scene = functools.partial(in_worker, session, episode_export.recording)
    files: tuple[tuple[str, str, Callable[[Episode], bytes]], ...] = (
        (f"Save episode ({EPISODE_SUFFIX})", EPISODE_SUFFIX, episode_bytes),
        ("Film (.mp4)", ".mp4", film),
        ("Scene (.viser)", ".viser", scene),
    )
    for label, suffix, work in files:
        button = gui.add_button(label, icon=viser.Icon.DOWNLOAD)
        send = functools.partial(_send, page, suffix, work)
        when(button, session, functools.partial(later, session, send))


def _send(page: PlayPage, suffix: str, work: Callable[[Episode], bytes]) -> None:
    """Send the episode as far as it has been simulated."""
    if page.source is None:
        raise MorphgenError("there is no episode yet")
    episode = still(page.source.episode)
    say(page.session, f"making the {suffix} of {episode.steps * episode.period:.2f} s")
    content = work(episode)
    name = f"{episode.task}-{episode.tracks[0].robot.name}-{episode.seed}{suffix}"
    page.session.client.send_file_download(name, content, save_immediately=True)
    say(page.session, "")


def _about(episode: Episode) -> str:
    """What a recorded episode is, with links to its robots and to playing it anew."""
    rows = [
        ("task", escape(episode.task) + (" with obstacles" if episode.obstacles else "")),
        ("policy", escape(episode.policy)),
        ("seed", str(episode.seed)),
        ("simulator", escape(episode.simulator)),
    ]
    for track in episode.tracks:
        robot = Address("robot", (track.place,))
        rows.append(("robot", markup.link(robot, track.robot.name)))
    return markup.table(("recorded", ""), rows)
