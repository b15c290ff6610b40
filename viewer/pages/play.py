"""The pages of playback: robots at a task, simulated now, and demonstrations as recorded."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from html import escape

import numpy as np
import viser
from viser import uplot

from morphgen.errors import MorphgenError, TaskError, nearest
from morphgen.grammar.robot_source import is_set_folder
from morphgen.rl.baselines import baselines_for
from morphgen.rl.shipped_policies import is_named, policies_for, zero_shot_policy
from morphgen.splits.split import split_names
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
from morphgen.tasks.task import TaskConfig
from morphgen.typing import Array
from morphgen.viewer import markup, rollout
from morphgen.viewer.app.address import MAX_PLAYED, Address, AddressError
from morphgen.viewer.app.session import Session, bind, set_value
from morphgen.viewer.pages.gallery import show_index
from morphgen.viewer.robot_rows import robot_folders, source_rows
from morphgen.viewer.robot_uri import (
    DEFAULT_WORDS,
    WORDS,
    FileAccess,
    member_split,
    parent_folder,
    uri_name,
)
from morphgen.viewer.rollout import Episode, score_until, snapshot
from morphgen.viewer.scene.rollout import RolloutScene, add_episode, episode_page, show_step
from morphgen.viewer.scene.stage import look_at

SIMULATOR_NAMES = (DEFAULT_SIMULATOR, *sorted({*SIMULATORS} - {DEFAULT_SIMULATOR, "warp"}))
"""Simulators for a single environment; Warp needs a GPU."""
PANEL_WIDTH = 400.0  # width of the panel [pixels]
PLANNERS = ("ik", "scripted")  # policies whose first step takes seconds, because they plan a path
ACTIONS = ("replace", "add", "only")  # replace the first robot, add one, or remove all others


def show(session: Session) -> None:
    """Build the page."""
    header = markup.breadcrumbs((session.address.subject or "play", None))
    session.open_panel(PANEL_WIDTH, header, "reading")
    trained_on = complete_address(session)
    if (task := session.address.subject) not in TASKS:
        raise MorphgenError(f"no task {task!r} to play{nearest(task, TASKS)}")
    page = PlayPage(session)
    page.add_rollout_controls(trained_on)
    page.add_download()


class PlayPage:
    """Playback in one browser; the display of its player."""

    def __init__(self, session: Session) -> None:
        """Add the controls of the playback."""
        gui, self.session = session.client.gui, session
        self.player = rollout.Player(self)
        session.on_close(self.player.stop)
        self._source: rollout.EpisodeSource | None = None
        self._scene: RolloutScene | None = None
        self._framed: tuple[str, ...] = ()  # URIs of the robots that the camera was pointed at
        self._is_planning = False  # whether the policy is still planning its first step
        self._position: int | None = None  # step of a pause; None while the episode plays
        self._step = 0  # step that is shown
        self._start: float | None = None  # time at which the address asks to pause [s]
        self._charts: list[viser.GuiUplotHandle] = []  # of distance and score
        self._fault = gui.add_html("")
        buttons = gui.add_button_group("Episode", ("play", "pause", "back", "step"))
        hint = "as far as it was simulated"
        self._time = gui.add_slider("time (s)", 0.0, 6.0, 0.02, 0.0, hint=hint)
        self._score, self._plots = gui.add_html(""), gui.add_folder("Distance and score")
        commands: Mapping[str, Callable[[], None]] = {
            "play": self.player.play,
            "pause": self.player.pause,
            "back": lambda: self.player.go_by(-1),
            "step": lambda: self.player.go_by(1),
        }
        session.on_change(buttons, lambda: commands[buttons.value]())
        session.on_change(self._time, self._go_to_time, "time")
        session.keep("t", self._write_time, self._apply_time)

    def load(self, make_source: Callable[[], rollout.EpisodeSource]) -> None:
        """Show the state in the address, and let the player show an episode."""
        self._position = None
        self.session.show_state()
        start, self._start = self._start, None

        def load() -> rollout.EpisodeSource:  # on the player's thread, which also removes scenes
            if self._scene is not None:  # not the pose of another seed until the new start is there
                self._scene.root.visible = False
            return make_source()

        self.player.load(load, start=start)

    def add_rollout_controls(self, trained_on: Robots) -> None:
        """Add the controls of a rollout in the state that the address gives, and start it."""
        gui, session, state = self.session.client.gui, self.session, self.session.address.state
        first = trained_on[0][1] if trained_on else WORDS + DEFAULT_WORDS
        robots = (session.address.robots or (first,))[:MAX_PLAYED]
        asked = state.get("policy") or default_policy(
            session.address.subject, obstacles="obstacles" in state
        )
        next_one = gui.add_button("New episode", icon=viser.Icon.REFRESH, hint="with the next seed")
        with gui.add_folder("Task"):
            task = gui.add_dropdown("task", tuple(TASKS), initial_value=session.address.subject)
            policies = _policies(session.files, task.value, asked)
            policy = gui.add_dropdown("policy", policies, initial_value=asked)
            obstacles = gui.add_checkbox("obstacles", initial_value=False)
            seed = gui.add_number("seed", 0, min=0, step=1)
            simulator = gui.add_dropdown("simulator", SIMULATOR_NAMES)
        with gui.add_folder("Robots"):
            picker = RobotPicker(session, lambda: robots[0], trained_on)
            action = gui.add_button_group("this robot", ACTIONS)
        session.keep("policy", lambda: policy.value)  # its default depends on the task
        bind(session, "seed", seed)
        bind(session, "obstacles", obstacles, ("yes",))
        bind(session, "sim", simulator)

        def restart() -> None:
            # Those that the address asks for in vain can be switched off.
            obstacles.visible = obstacles.value or has_obstacles(task.value)
            config = rollout.RolloutConfig(
                task.value, robots, policy.value, seed.value, obstacles.value, simulator.value
            )
            session.address = replace(session.address, subjects=(task.value,), robots=robots)
            session.title = f"{task.value} {uri_name(robots[0])}"
            session.set_status(f"preparing {', '.join(map(uri_name, robots))}")
            self.load(lambda: rollout.RemoteRollout(config, session.files, session.simulator))

        def start_next() -> None:
            set_value(seed, seed.value + 1)
            restart()

        def change_task() -> None:
            """Start another task, with its own policy if the current one is for the other."""
            chosen = policy.value
            if not has_obstacles(task.value):
                set_value(obstacles, False)
            if is_named(chosen) and chosen not in policies_for(task.value):
                chosen = default_policy(task.value, obstacles=obstacles.value)
            policy.options = _policies(session.files, task.value, chosen)
            set_value(policy, chosen)
            restart()

        def use_robot(action: str) -> None:
            """Apply one of ``ACTIONS`` to the robot that the user named or picked."""
            nonlocal robots
            uri = picker.picked_uri()
            if action == "add" and len(robots) >= MAX_PLAYED:
                raise MorphgenError(f"at most {MAX_PLAYED} robots are shown")
            kept = {"add": robots, "replace": robots[1:], "only": ()}[action]
            robots = (*kept, uri) if action == "add" else (uri, *kept)
            restart()

        session.on_change(next_one, start_next)
        session.on_change(task, change_task)
        for control in (policy, obstacles, seed, simulator):
            session.on_change(control, restart, "restart")
        session.on_change(picker.robot, lambda: use_robot("replace"))
        session.on_change(action, lambda: use_robot(action.value))
        session.apply_state()
        restart()

    def add_download(self) -> None:
        """Add a button that sends the episode, as far as it is simulated, as a web page."""
        session = self.session
        button = session.client.gui.add_button("Web page (.html)", icon=viser.Icon.DOWNLOAD)

        def send() -> None:
            if self._source is None:
                raise MorphgenError("there is no episode yet")
            episode = snapshot(self._source.episode)
            name = f"{episode.task}-{episode.tracks[0].robot.name}-{episode.seed}.html"
            with session.activity(f"making the page of {episode.num_steps * episode.period:.2f} s"):
                page = session.workers.call(episode_page, episode, session.dark)
                session.send_file(name, page)

        session.on_press(button, send)

    def show_start(self, source: rollout.EpisodeSource) -> None:
        """Show a new episode at its start."""
        client, self._source, episode = self.session.client, source, source.episode
        with client.atomic():
            if self._scene is not None:
                self._scene.root.remove()
            self._scene = add_episode(client.scene, episode)
        if self.session.closed.is_set():  # the browser has left the page meanwhile
            self._scene.root.remove()
            return
        uris = tuple(track.uri for track in episode.tracks)
        if uris != self._framed:  # the next episode of the same robots keeps the user's camera
            self._framed = uris
            look_at(client, self._scene.low, self._scene.high)
        self._clear_plots()
        with self._plots:
            self._charts = add_charts(client.gui, episode, dark=self.session.dark)
        self._time.max = max(source.max_steps, 1) * episode.period
        self._show_faults(source.faults.values())
        self._is_planning = isinstance(source, rollout.RemoteRollout) and episode.policy in PLANNERS
        self.session.set_status("the policy plans its path" if self._is_planning else "")

    def show_step(self, step: int) -> None:
        """Show the episode after a number of control steps."""
        if self._scene is None or self._source is None:
            return
        episode, self._step = self._source.episode, step
        with self.session.client.atomic():
            show_step(self._scene, step)
        if step > 0 and self._is_planning:
            self._is_planning = False
            self.session.set_status("")
        set_value(self._time, step * episode.period)
        self._score.content = markup.framed(score_table(episode, step))
        self.session.call_later(PLOT_INTERVAL, self._update_plots, "plots")

    def show_stopped(self) -> None:
        """Show errors that ended robots' episodes early."""
        tracks = self._source.episode.tracks if self._source else []
        if faults := [track.fault for track in tracks if track.fault]:
            self._show_faults(faults)

    def show_position(self, step: int | None) -> None:
        """Show in the address where the user paused."""
        self._position = step
        self.session.show_state_later()

    def show_failure(self, reason: str) -> None:
        """Show why there is no episode."""
        self.session.set_status("")
        self._show_faults([reason])
        self._score.content = ""
        self._clear_plots()
        if self._scene is not None:
            self._scene.root.remove()
        self._scene = self._source = None

    def _write_time(self) -> str:
        if self._position is None or self._source is None:
            return ""
        return f"{self._position * self._source.episode.period:.4g}"

    def _apply_time(self, text: str) -> None:
        self._start = parse_time(text)

    def _go_to_time(self) -> None:
        if self._source is not None:
            self.player.go_to(round(self._time.value / self._source.episode.period))

    def _update_plots(self) -> None:
        if self._source is not None:
            for chart, data in zip(
                self._charts, curves(self._source.episode, self._step), strict=False
            ):
                chart.data = data

    def _clear_plots(self) -> None:
        for chart in self._charts:
            chart.remove()
        self._charts = []

    def _show_faults(self, texts: Iterable[str]) -> None:
        redact = self.session.files.redact
        self._fault.content = "".join(markup.error(redact(text)) for text in texts)


TRAINED_ON, ARMS = "trained on", "arms with a plate"
MAX_CHOICES = 500  # robots that a dropdown offers; others can be named by words

Robots = list[tuple[str, str]]  # names and URIs


class RobotPicker:
    """Controls that pick a robot: from a list to search, or by words of the command."""

    def __init__(self, session: Session, current: Callable[[], str], trained_on: Robots) -> None:
        """Add the controls; ``current`` returns the URI of the robot that is shown first."""
        gui, self._files = session.client.gui, session.files
        self._current, self._trained_on = current, trained_on
        own = [TRAINED_ON] if trained_on else []
        sources = (*own, *robot_sources(current(), session.files))
        self._source = gui.add_dropdown("from", sources)
        self.robot = gui.add_dropdown("robot", ("",), hint="type to search")
        hint = "such as arm=ur5 ee=plane, or the folder of a bundle"
        self._words = gui.add_text("or words", "", hint=hint)
        self._uris: dict[str, str] = {}  # URIs of the robots in the dropdown, by label
        session.on_change(self._source, self._list_robots)
        self._list_robots()

    def _robots(self) -> Robots:
        """Return the robots of the chosen source."""
        if self._source.value == TRAINED_ON:
            return self._trained_on
        if self._source.value == ARMS:
            arms = self._files.library.names("arm")
            plates = [(arm, f"{WORDS}arm={arm} ee=plane") for arm in arms]
            return [*plates, ("planar-cube", f"{WORDS}base=planar ee=cube")]
        rows = source_rows(self._source.value, self._files)
        return [(f"{row.role}: {row.name}" if row.role else row.name, row.uri) for row in rows]

    def _list_robots(self) -> None:
        """Fill the dropdown of robots from the chosen source, each with a label of its own."""
        current, robots = self._current(), self._robots()[:MAX_CHOICES]
        if current not in (uri for _, uri in robots):
            robots = [(current, current), *robots]
        self._uris = {}
        for name, uri in robots:
            while name in self._uris:
                name += "'"
            self._uris[name] = uri
        self.robot.options = tuple(self._uris)
        set_value(self.robot, next(name for name, uri in self._uris.items() if uri == current))

    def picked_uri(self) -> str:
        """Return the URI of the robot that the user named or picked, and clear the words."""
        text = self._words.value.strip()
        if not text:
            return self._uris[self.robot.value]
        set_value(self._words, "")
        return WORDS + text if "=" in text and ":" not in text else text


def robot_sources(uri: str, files: FileAccess) -> list[str]:
    """Return the splits and folders to pick robots from; those that have a robot are first."""
    folder = parent_folder(uri)
    beside = folder if folder and is_set_folder(files.path(folder)) else ""
    names = (member_split(uri), beside, ARMS, *robot_folders(files.roots[0]), *split_names())
    return list(dict.fromkeys(filter(None, names)))


def default_policy(task: str, *, obstacles: bool) -> str:
    """Return the shipped policy that does a task with any robot, or else the first baseline."""
    try:
        return zero_shot_policy(task, "position", obstacles=obstacles).name
    except TaskError:
        return baselines_for(task)[0]


def has_obstacles(task: str) -> bool:
    """Return whether a task can have obstacles."""
    config: TaskConfig = TASKS[task].config_type()
    return config.obstacles > 0


def complete_address(session: Session) -> Robots:
    """Return the robots of the checkpoint's training; an address without task gets its task."""
    policy = session.address.state.get("policy", "")
    if not policy or is_named(policy):
        return []
    find_robots = rollout.simulation("training_robots")
    task, obstacles, trained_on = session.simulator.call(find_robots, policy, session.files)
    if not session.address.subject:
        address = replace(session.address, subjects=(task,))
        session.address = address.with_state(obstacles="yes" if obstacles else "")
    return [*trained_on]


def _policies(files: FileAccess, task: str, policy: str) -> tuple[str, ...]:
    """Return the task's baselines and shipped policies, the folder's checkpoints and the policy."""
    return tuple(dict.fromkeys((*policies_for(task), *rollout.list_checkpoints(files), policy)))


def parse_time(text: str) -> float:
    """Return the time at which an address shows an episode [s]."""
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


MAX_FAILURES = 30  # largest number of failed episodes that the page of demonstrations lists


def show_demos(session: Session) -> None:
    """Build the page: the choice of an episode above its playback."""
    if not session.address.subject:
        show_index(session)
        return
    folder, gui, files = session.address.subject, session.client.gui, session.files
    header = markup.breadcrumbs((uri_name(folder), None))
    session.open_panel(PANEL_WIDTH, header, "reading")
    robots, episodes = session.simulator.call(rollout.simulation("list_episodes"), folder, files)
    names, firsts = [name for name, _ in robots], dict[str, int]()
    for index, (body, _) in enumerate(episodes):
        name, key = robots[body]
        firsts.setdefault(name if names.count(name) == 1 else f"{name} {key}", index)
    robot = gui.add_dropdown("first of", tuple(firsts), hint="type to search")
    number = gui.add_number("episode", 0, min=0, max=len(episodes) - 1, step=1)
    failures = [index for index, (_, success) in enumerate(episodes) if not success]
    addresses = (Address("demos", (folder,), {"episode": str(index)}) for index in failures)
    links = [markup.link(each, each.state["episode"]) for each in addresses][:MAX_FAILURES]
    listed = f": {', '.join(links)}" + ", ..." * (len(failures) > MAX_FAILURES) if links else ""
    gui.add_html(markup.framed(f"{len(failures)} of {len(episodes)} episodes failed{listed}"))
    page = PlayPage(session)
    facts = gui.add_html("")
    bind(session, "episode", number)

    def play() -> None:
        index = number.value

        def read() -> rollout.EpisodeSource:
            episode = session.simulator.call(
                rollout.simulation("recorded_episode"), folder, index, files
            )
            facts.content = markup.framed(describe_episode(episode))
            return rollout.EpisodeSource(episode, episode.num_steps)

        session.title = f"{uri_name(folder)} {index}"
        page.load(read)

    def jump() -> None:
        set_value(number, firsts[robot.value])
        play()

    session.on_change(robot, jump, "play")
    session.on_change(number, play, "play")
    session.apply_state()
    play()
    page.add_download()


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


PLOT_INTERVAL = 0.25  # time between two updates of the curves [s]
COLOURS = (
    *("#1c7ed6", "#f76707", "#2f9e44", "#ae3ec9", "#e03131"),
    *("#0ca678", "#f59f00", "#7048e8", "#868e96"),
)
"""Colours of the robots, in their order."""
_HEIGHT = 150  # height of a chart [pixels]
_NOW = "#868e96"  # colour of the line at the current time


def add_charts(gui: viser.GuiApi, episode: Episode, *, dark: bool) -> list[viser.GuiUplotHandle]:
    """Add the charts of distance to success, score and, if recorded, reward below each other."""
    names = [track.robot.name for track in episode.tracks]
    labels = (f"m from {TASKS[episode.task].target}", "score so far", "reward")
    plain = uplot.Series_Points(show=False)
    series = [
        uplot.Series(label="time (s)"),
        *(
            uplot.Series(label=name, stroke=colour, width=2, points=plain)
            for name, colour in zip(names, itertools.cycle(COLOURS), strict=False)
        ),
        uplot.Series(label="shown", stroke=_NOW, width=1, points=plain),  # the current time
    ]
    return [
        gui.add_uplot(
            data,
            tuple(series),
            axes=(_axis("time (s)", dark=dark), _axis(label, dark=dark)),
            scales={"x": uplot.Scale(time=False)},
            legend=uplot.Legend(show=label == "score so far" and len(names) > 1),
            height=_HEIGHT,
        )
        for label, data in zip(labels, curves(episode, 0), strict=False)
    ]


def curves(episode: Episode, step: int) -> list[tuple[Array, ...]]:
    """Return the data of the charts of distance, score and, if recorded, reward.

    uPlot has no vertical lines; that at the step is a curve with three values there. Robots whose
    episode ended earlier keep their last value: uPlot draws no curve with NaN.
    """
    num_steps = max(episode.num_steps, 1)
    time = np.arange(1, num_steps + 1) * episode.period
    distances, totals, rewards = [], [], []
    for track in episode.tracks:
        n = min(len(track.score), len(track.distance), num_steps)
        sums = zip(np.cumsum(track.score[:n]).tolist(), track.score[:n], strict=True)
        score = TASKS[episode.task].episode_score
        values = [score(total, last, i) for i, (total, last) in enumerate(sums, 1)]
        distances.append(_padded(track.distance[:n], num_steps))
        totals.append(_padded(values, num_steps))
        rewards += [_padded(track.reward, num_steps)] if track.reward else []
    now = min(max(step, 1), num_steps) - 1
    rows = np.insert(np.arange(num_steps), now, (now, now))

    def with_line(values: list[Array]) -> tuple[Array, ...]:
        line = np.where(np.arange(len(rows)) == now + 1, np.max(values), np.min(values))
        return (*(curve[rows] for curve in (time, *values)), line)

    return [with_line(values) for values in (distances, totals, rewards) if values]


def _padded(values: list[float], length: int) -> Array:
    """Return values, the last one repeated up to a length; zeros if there are none."""
    return np.pad(np.array(values or [0.0]), (0, length - max(len(values), 1)), mode="edge")


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
