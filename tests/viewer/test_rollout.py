"""Rollouts of a policy, their player, and the processes that simulate."""

import os
import pickle
import threading
import time
from concurrent.futures import CancelledError, Future
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.pages import wait_until
from helpers.robots import arm
from helpers.runs import QUIET, small_config
from helpers.viser_client import PlainClient
from helpers.worker_functions import die_later, power, sleep_from
from morphgen.errors import MorphgenError, SimulationError, TaskError
from morphgen.rl.baselines import baselines_for
from morphgen.rl.inference import make_env_and_controller, play, read_controller
from morphgen.rl.runs.training import train
from morphgen.viewer import rollout, simulation
from morphgen.viewer.app.address import AddressError, parse_address
from morphgen.viewer.app.workers import SharedResults, WorkerDied, Workers
from morphgen.viewer.pages.play import SIMULATOR_NAMES, curves, default_policy, parse_time
from morphgen.viewer.robot_files import scene_server
from morphgen.viewer.rollout import Player, RemoteRollout, RolloutConfig, score_until
from morphgen.viewer.scene import rollout as drawing
from morphgen.viewer.simulation import Rollout

CUBE, ARM = "words:base=planar ee=cube", "robots/some-arm"


def simulated(config, files):
    """Return the whole episode of a rollout."""
    rollout = Rollout(config, files)
    while rollout.advance():
        pass
    rollout.close()
    return rollout.episode


@pytest.fixture(scope="module")
def episode(files, module_cache):
    """An episode of two reach robots: one composed, one from a bundle."""
    return simulated(RolloutConfig("reach", (CUBE, ARM), "jacobian", 3), files)


@pytest.mark.slow
def test_episode_equals_that_of_morphgen_play(episode):
    spec = read_controller("jacobian", "reach")
    env, controller = make_env_and_controller(spec, "planar-cube", 3, sim="mujoco")
    results = []
    list(play(env, controller, 1, 3, results.append))
    env.close()
    track = episode.tracks[0]
    (result,) = results
    assert track.num_steps == 300
    assert track.distance[-1] == pytest.approx(result.distance)
    assert score_until(track, "reach", 300) == pytest.approx(result.score)
    assert track.success[-1] == result.success


def test_a_rollout_of_the_process_of_simulations_is_the_same(episode, files, module_cache):
    def submit(work, *arguments):
        future = Future()
        future.set_result(pickle.loads(pickle.dumps(work(*arguments))))
        return future

    def call(work, *arguments):
        return submit(work, *arguments).result()

    process = SimpleNamespace(submit=submit, result=Future.result, call=call)
    config = RolloutConfig("reach", (CUBE, "robots/none", ARM), "jacobian", 3)
    remote = RemoteRollout(config, files, process)
    assert (list(remote.faults), remote.max_steps) == (["robots/none"], 300)
    assert remote.episode.num_steps == 0
    while remote.advance():
        pass
    assert not remote.advance()
    for one, other in zip(remote.episode.tracks, episode.tracks, strict=True):
        assert np.array_equal(one.q, other.q)
        assert np.array_equal(one.poses["goal"], other.poses["goal"])
        assert (one.score, one.success) == (other.score, other.success)
    assert len(simulation._rollouts) == 1
    remote.close()
    assert simulation._rollouts == {}
    with pytest.raises(SimulationError, match="has died; start it again"):
        simulation.advance(remote._key)


def test_score_counts_the_steps_so_far(episode):
    track = episode.tracks[0]
    assert score_until(track, "reach", 0) is None
    assert score_until(track, "reach", 2) == pytest.approx(sum(track.score[:2]) / 2)
    assert score_until(track, "push", 2) == track.score[1]


def test_a_policy_gets_the_observations_it_was_trained_with(folder, files, module_cache):
    config = small_config(total_timesteps=32)
    config = replace(config, policy=replace(config.policy, tool_position=True))
    train(folder / "run", config, execution=QUIET)
    rollout = Rollout(RolloutConfig("reach", (CUBE,), "run"), files)
    assert rollout.faults == {}
    assert rollout.advance()
    rollout.close()


@pytest.mark.parametrize(
    ("config", "why"),
    [
        (RolloutConfig("reach", (), "zero"), "no robot is named"),
        (RolloutConfig("reach", ("robots/none",), "zero"), "no such file"),
        (
            RolloutConfig("reach", (ARM,), "scripted"),
            "is for push or .* not for reach",
        ),
        (RolloutConfig("push", (ARM,), "ik"), "is for reach, not for push"),
        (RolloutConfig("reach", (ARM,), "zeros"), "did you mean 'zero'"),
        (RolloutConfig("reach", (ARM,), "../x.pt"), "outside of the folders"),
        (RolloutConfig("reach", (ARM,), "x.pt"), "no such file"),
        (
            RolloutConfig("reach", (ARM,), f"{ARM}/robot.urdf"),
            "is not a checkpoint",
        ),
    ],
)
def test_an_invalid_rollout_is_rejected(files, module_cache, config, why):
    with pytest.raises(MorphgenError, match=why):
        Rollout(config, files)


@pytest.mark.parametrize("simulator", SIMULATOR_NAMES)
def test_a_rollout_is_restored_from_its_address(shared_viewer, simulator):
    query = f"?play=push&robot={CUBE}&robot=robots/some-arm&policy=random&seed=7&obstacles=yes"
    query += "" if simulator == "mujoco" else f"&sim={simulator}"
    shown = parse_address(query).query
    with PlainClient(shared_viewer.port, query) as client:
        client.until(lambda: client.addresses and client.addresses[-1][1] == shown)


@pytest.mark.parametrize(
    ("task", "obstacles", "policy"),
    [
        ("reach", False, "zero-shot"),
        ("reach", True, "zero-shot-obstacles"),
        ("push", False, "zero-shot-push"),
        ("door", False, "zero-shot-door"),
        ("push", True, baselines_for("push")[0]),
    ],
)
def test_a_rollout_opens_with_the_shipped_policy_of_its_task(task, obstacles, policy):
    assert default_policy(task, obstacles=obstacles) == policy


@pytest.mark.parametrize(
    ("query", "offered"),
    [("play=push", True), ("play=dial", False), ("play=dial&obstacles=yes", True)],
)
def test_obstacles_are_offered_for_tasks_that_have_some(shared_viewer, query, offered):
    with PlainClient(shared_viewer.port, f"?{query}&robot={CUBE}&policy=zero") as client:
        checkbox = client.control("Checkbox", "obstacles")
        client.until(lambda: client.addresses)
        client.until(lambda: client.is_visible(checkbox) is offered)
        if "obstacles" in query:
            client.shows("has no obstacles; expected one without")
            client.change(checkbox, False)
            client.until(lambda: not client.is_visible(checkbox))


@pytest.mark.parametrize(
    ("query", "reasons"),
    [
        ("?play=rech", ["did you mean"]),
        ("?play=robots/prims/index.jsonl", ["no task"]),
        (
            f"?play=reach&robot={CUBE}&policy=random&sim=bullet&t=soon&seed=" + "9" * 5000,
            [
                f"seed={'9' * 40} was left out; expected a number",
                "sim=bullet was left out; expected mujoco",
                "t=soon is no time; expected seconds, 0 or more",
            ],
        ),
    ],
)
def test_an_invalid_address_of_a_rollout_is_explained(shared_viewer, query, reasons):
    with PlainClient(shared_viewer.port, query) as client:
        for reason in reasons:
            client.shows(reason)


def test_snapshot_is_independent_of_the_episode(episode):
    kept = rollout.snapshot(episode)
    for track in kept.tracks:
        track.q.append(track.q[-1])
    assert [track.num_steps for track in episode.tracks] == [300, 300]


def test_robots_do_not_overlap(episode):
    areas = [drawing.track_area(track) for track in (*episode.tracks, episode.tracks[0])]
    spots = np.array(drawing.grid_positions(areas))
    low, high = (np.array(corners) + spots for corners in zip(*areas, strict=True))
    for i, k in combinations(range(len(areas)), 2):
        apart = np.maximum(low[i] - high[k], low[k] - high[i])
        assert apart[:2].max() >= drawing.GAP - 1e-9


def test_a_web_page_plays_the_episode(episode):
    tracks = [replace(track, q=track.q[:21], score=track.score[:20]) for track in episode.tracks]
    beginning = replace(episode, tracks=tracks)
    page = drawing.episode_page(beginning, True)
    assert b"__VISER_EMBED_DATA__" in page
    assert b"darkMode:true" in page
    assert beginning.tracks[0].robot.name.encode() in page


@pytest.fixture(scope="module")
def opened_drawer(files, module_cache):
    """An episode in which an arm moves a drawer."""
    return simulated(RolloutConfig("drawer", ("words:arm=arm3 ee=stick",), "scripted", 0), files)


def test_an_articulated_object_moves(opened_drawer):
    (track,) = opened_drawer.tracks
    assert track.success[-1]
    assert track.block_size is None
    assert [marker.name for marker in track.markers] == ["goal"]
    ends = []
    with scene_server() as server:
        drawn = drawing.add_episode(server.scene, opened_drawer)
        for step in (0, track.num_steps):
            drawing.show_step(drawn, step)
            ends.append(drawn.tracks[0].object.T_root_link[1, 0, 3])
    poses = np.array(track.poses["block"], dtype=np.float64)
    moved = track.object.placed_joint.positions(poses[[0, -1]])
    assert ends == pytest.approx(moved, abs=1e-5)
    assert abs(moved[1] - moved[0]) > 0.12


WAIT = 30


class Counting:
    """An episode with a fixed number of slow steps."""

    max_steps = 100

    def __init__(self, steps=100, pause=0.0, fault=None):
        self.episode = SimpleNamespace(num_steps=0, period=0.02)
        self.closed = False
        self._steps, self._pause, self._fault = steps, pause, fault

    def advance(self):
        time.sleep(self._pause)
        if self._fault is not None:
            raise self._fault
        more = self.episode.num_steps < self._steps
        self.episode.num_steps += more
        return more

    def close(self):
        self.closed = True


class Display:
    """Records what a player shows."""

    def __init__(self):
        self.steps, self.faults, self.threads, self.positions = [], [], set(), []
        self.changed = threading.Condition()

    def show_start(self, source):
        self._record(self.steps, "start")

    def show_step(self, step):
        self.threads.add(threading.current_thread())
        self._record(self.steps, step)

    def show_stopped(self):
        self._record(self.steps, "stopped")

    def show_position(self, step):
        self._record(self.positions, step)

    def show_failure(self, why):
        self._record(self.faults, why)

    def _record(self, values, value):
        with self.changed:
            values.append(value)
            self.changed.notify_all()

    def wait_for(self, condition):
        with self.changed:
            assert self.changed.wait_for(condition, WAIT), (self.steps, self.faults)

    def wait_for_steps(self, *steps):
        """Wait until the last steps are these."""
        self.wait_for(lambda: self.steps[-len(steps) :] == [*steps])


@pytest.fixture
def display():
    return Display()


def require_ended(player):
    player._thread.join(WAIT)
    assert not player._thread.is_alive()


@pytest.fixture
def player(display):
    made = Player(display)
    yield made
    made.stop()
    require_ended(made)


def test_an_episode_plays_to_its_end_and_restarts(player, display):
    source = Counting(steps=25)
    player.load(lambda: source)
    display.wait_for_steps("stopped")
    assert display.steps[:2] == ["start", 0]
    numbers = display.steps[1:-1]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == source.episode.num_steps == 25
    display.steps.clear()
    player.play()
    display.wait_for_steps("stopped")
    assert display.steps[0] < 25
    assert display.threads == {player._thread}


def test_playback_is_paused_stepped_and_scrubbed(player, display):
    source = Counting()
    player.load(lambda: source, start=0.0)
    for _ in range(3):
        player.go_by(1)
    display.wait_for(lambda: 3 in display.steps)
    assert source.episode.num_steps == 3
    player.go_by(-2)
    display.wait_for_steps(1, "stopped")
    player.go_to(50)
    display.wait_for_steps(3, "stopped")
    assert source.episode.num_steps == 3
    player.go_by(-9)
    display.wait_for_steps(0, "stopped")


def test_an_episode_is_loaded_at_a_time_and_simulated_until_then(player, display):
    source = Counting()
    player.load(lambda: source, start=0.5)
    display.wait_for_steps(25, "stopped")
    assert source.episode.num_steps == 25
    assert display.positions == [25]
    player.play()
    display.wait_for(lambda: 27 in display.steps)
    player.pause()
    display.wait_for(lambda: display.positions[-1:] != [None])
    assert display.positions[:2] == [25, None]
    assert display.positions[2] >= 27


@pytest.mark.slow
def test_slow_steps_are_shown_as_they_arrive(player, display):
    source = Counting(steps=8, pause=0.1)
    player.load(lambda: source)
    display.wait_for_steps("stopped")
    assert len(display.steps) >= 6


def test_another_episode_frees_the_previous_one(player, display):
    sources = [Counting(), Counting()]
    for source in sources:
        player.load(lambda source=source: source, start=0.0)
        display.wait_for(lambda: "start" in display.steps)
        display.steps.clear()
    assert [source.closed for source in sources] == [True, False]
    player.stop()
    require_ended(player)
    assert sources[1].closed


def test_a_failure_is_shown_and_the_next_episode_can_play(player, display):
    def fail():
        raise TaskError("no such body")

    player.load(fail)
    display.wait_for(lambda: display.faults == ["no such body"])
    player.play()
    player.go_by(1)
    player.load(lambda: Counting(fault=TaskError("unstable")))
    display.wait_for(lambda: display.faults == ["no such body", "unstable"])
    player.load(Counting, start=0.0)
    display.wait_for_steps("start", 0, 0, "stopped")


def test_a_player_stops_while_it_loads(display):
    begun, source = threading.Event(), Counting()

    def slow():
        begun.set()
        time.sleep(0.3)
        return source

    player = Player(display)
    player.load(slow)
    assert begun.wait(WAIT)
    player.stop()
    require_ended(player)
    assert source.closed


def test_times_of_addresses():
    assert parse_time("1.5") == 1.5
    for text in ("-1", "soon", "nan", "inf"):
        with pytest.raises(AddressError, match=f"t={text} is no time; expected seconds, 0 or more"):
            parse_time(text)


def track(num_steps):
    """A robot whose distance falls from 1 m."""
    values = [1 - 0.1 * i for i in range(num_steps)]
    series = {"score": values, "distance": values, "success": [False] * num_steps}
    return rollout.Track(arm(), "x", None, q=[np.zeros(4)] * (num_steps + 1), **series)


def played_episode(*num_steps):
    tracks = [track(n) for n in num_steps]
    return rollout.Episode("reach", "zero", 0, False, "mujoco", 0.02, tracks)


def test_curves_have_distance_score_and_a_line_at_the_step():
    distances, totals = curves(played_episode(5, 3), 2)
    assert distances[0] == pytest.approx([0.02, 0.04, 0.04, 0.04, 0.06, 0.08, 0.1])
    assert distances[1] == pytest.approx([1, 0.9, 0.9, 0.9, 0.8, 0.7, 0.6])
    assert distances[2] == pytest.approx([1, 0.9, 0.9, 0.9, 0.8, 0.8, 0.8])  # it ended earlier
    assert distances[3] == pytest.approx([0.6, 0.6, 1, 0.6, 0.6, 0.6, 0.6])
    expected = [score_until(track(5), "reach", i) for i in (1, 2, 2, 2, 3, 4, 5)]
    assert totals[1] == pytest.approx(expected)
    assert len(totals) == 4


def test_curves_are_finite_before_the_first_step():
    for data in curves(played_episode(0, 0), 0):
        assert all(np.isfinite(line).all() for line in data)
        assert {len(line) for line in data} == {3}


@pytest.fixture
def workers():
    made = Workers(1)
    yield made
    made.close()


def test_dead_worker_is_reported_once_and_replaced(workers):
    value, first = workers.result(workers.submit(power, 2, 3))
    assert value == 9
    dying, waiting = workers.submit(die_later, 0.3), workers.submit(power, 2, 4)
    for future in (dying, waiting):
        with pytest.raises(WorkerDied, match="others were started: try again"):
            workers.result(future)
    value, second = workers.result(workers.submit(power, 2, 5))
    assert value == 25
    assert second not in (first, os.getpid())


def test_closing_workers_interrupts_their_work_and_ends_their_processes(tmp_path):
    workers = Workers(1)
    _, process = workers.result(workers.submit(power, 2, 3))
    started = tmp_path / "started"
    running, waiting = workers.submit(sleep_from, started), workers.submit(power, 2, 3)
    wait_until(started.exists)
    workers.close()
    for future in (running, waiting):
        with pytest.raises(CancelledError):
            future.result(timeout=60)
    wait_until(lambda: not Path(f"/proc/{process}").exists())


def test_workers_are_idle_only_without_calls(workers, tmp_path):
    assert not workers.is_used
    assert workers.idle_time > 0
    started = tmp_path / "started"
    running = workers.submit(sleep_from, started)
    wait_until(started.exists)
    assert workers.is_used
    assert workers.idle_time == 0
    workers.close()
    with pytest.raises(CancelledError):
        running.result(timeout=60)
    wait_until(lambda: workers.idle_time > 0)


def test_a_result_is_made_once_and_the_least_recently_used_is_dropped():
    shared, made = SharedResults(max_results=2), []

    def get(key):
        return shared.get(key, lambda: made.append(key) or key.upper())

    assert [get(key) for key in "aabacab"] == list("AABACAB")
    assert made == ["a", "b", "c", "b"]
    assert (get("a"), get("c")) == ("A", "C")
    assert made[4:] == ["c"]
