"""The page of demonstrations: it plays any episode of a data set."""

from __future__ import annotations

from html import escape

from morphgen.errors import MorphgenError
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session, set_value
from morphgen.viewer.controls import bind
from morphgen.viewer.episode import Episode
from morphgen.viewer.pages.gallery import show_index
from morphgen.viewer.pages.play import PANEL_WIDTH, PlayPage
from morphgen.viewer.robot_uri import uri_name
from morphgen.viewer.rollout import EpisodeSource, simulation

ANY = "any"  # choice of a robot, task or outcome that leaves no episode out
OUTCOMES = ("failure", "success")


def show(session: Session) -> None:
    """Build the page: the choice of an episode above its playback."""
    if not session.address.subject:
        show_index(session)
        return
    folder, gui, files = session.address.subject, session.client.gui, session.files
    header = markup.breadcrumbs((uri_name(folder), None))
    session.open_panel(PANEL_WIDTH, header, "reading")
    robots, episodes = session.simulator.call(simulation("list_episodes"), folder, files)
    names, count = [name for name, _ in robots], len(episodes)
    labels = [name if names.count(name) == 1 else f"{name} {key}" for name, key in robots]
    rows = [(labels[body], task, OUTCOMES[success]) for body, task, success in episodes]
    robot = gui.add_dropdown("robot", (ANY, *labels), hint="type to search")
    task = gui.add_dropdown("task", (ANY, *dict.fromkeys(task for _, task, _ in rows)))
    outcome = gui.add_dropdown("outcome", (ANY, *OUTCOMES))
    choices = (robot, task, outcome)
    number = gui.add_number("episode", 0, min=0, max=count - 1, step=1)
    move = gui.add_button_group("go to", ("previous", "next"))
    page = PlayPage(session)
    facts = gui.add_html("")
    bind(session, "body", robot, (ANY, *(key for _, key in robots)))
    bind(session, "task", task)
    bind(session, "outcome", outcome)
    bind(session, "episode", number)

    def play(*, is_recorded: bool = True) -> None:
        index = number.value

        def read() -> EpisodeSource:
            if not is_recorded:
                raise MorphgenError("no such episode was recorded")
            episode = session.simulator.call(simulation("recorded_episode"), folder, index, files)
            facts.content = markup.framed(describe_episode(episode))
            return EpisodeSource(episode, episode.num_steps)

        session.title = f"{uri_name(folder)} {index}"
        page.load(read)

    def seek(start: int, direction: int = 1) -> None:
        """Play the first episode from a number on, or back from it, that the choices allow."""
        allowed = [
            index
            for index, row in enumerate(rows)
            if all(choice.value in (ANY, own) for choice, own in zip(choices, row, strict=True))
        ]
        if allowed:
            set_value(number, min(allowed, key=lambda index: direction * (index - start) % count))
        play(is_recorded=bool(allowed))

    def step() -> None:
        direction = 1 if move.value == "next" else -1
        seek(number.value + direction, direction)

    for choice in choices:
        session.on_change(choice, lambda: seek(number.value), "seek")
    session.on_change(number, play, "play")
    session.on_change(move, step)
    session.apply_state()
    if 0 <= number.value < count:
        seek(number.value)  # an address may name an episode that its other choices leave out
    else:
        play()  # says that there is no such episode
    page.add_downloads()


def describe_episode(episode: Episode) -> str:
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
