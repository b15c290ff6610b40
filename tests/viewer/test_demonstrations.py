"""The page of demonstrations: recorded episodes are those of rollouts; the page plays any."""

import re
import shutil
from types import SimpleNamespace
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest

import morphgen
from helpers.pages import choose, field
from morphgen.errors import FormatError, SimulationError
from morphgen.grammar.library import default_library
from morphgen.rl.demonstrations.reader import at_links
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.app import start_address
from morphgen.viewer.pages.play import curves
from morphgen.viewer.robot_uri import FileAccess, UriError
from morphgen.viewer.rollout import RolloutConfig, score_until
from morphgen.viewer.simulation import Rollout, list_episodes, recorded_episode

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

TASKS = ("reach", "drawer")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A folder with an episode of an arm at each task, with noise."""
    root = tmp_path_factory.mktemp("recorded")
    morphgen.record("arm=arm3 ee=stick", tasks=TASKS, episodes=1, noise=0.1, out=root / "demos")
    return root


@pytest.fixture
def files(root, monkeypatch):
    monkeypatch.chdir(root)
    return FileAccess(default_library().folders, (root.resolve(),), root / "none")


@pytest.mark.parametrize("index", [0, 1])
def test_a_recorded_episode_is_the_rollout_of_its_actions(index, files):
    recorded = recorded_episode("demos/", index, files)
    (track,) = recorded.tracks
    rollout = Rollout(RolloutConfig(TASKS[index], (track.uri,), "zero", recorded.seed), files)
    demos = morphgen.demos("demos")
    actions = (demos[i]["executed_action"][None] for i in demos.episodes[index].frames)
    rollout._robots[0].controller = SimpleNamespace(
        act=lambda batch: at_links(batch, next(actions))
    )
    while rollout.episode.num_steps < recorded.num_steps:
        rollout.advance()
    rollout.close()
    (simulated,) = rollout.episode.tracks
    n = recorded.num_steps
    assert (track.markers, track.ground) == (simulated.markers, simulated.ground)
    assert np.array_equal(track.q[:n], simulated.q[:n])
    assert np.array_equal(track.q[n], track.q[n - 1])  # the last state is not recorded
    assert track.poses.keys() == simulated.poses.keys()
    for name, poses in track.poses.items():
        assert np.array_equal(poses[:n], simulated.poses[name][:n])
    assert (track.object is None) == (simulated.object is None) == (TASKS[index] == "reach")
    assert track.distance == pytest.approx(simulated.distance, abs=1e-7)
    assert track.score == pytest.approx(simulated.score, abs=1e-3)
    assert track.success == simulated.success
    assert score_until(track, recorded.task, n) == pytest.approx(demos.episodes[index].score)
    assert [len(data) for data in curves(recorded, n)] == [3, 3, 3]  # with one of rewards


def test_the_folder_opens_the_page(files):
    robots, episodes = list_episodes("demos", files)
    assert [name for name, _ in robots] == ["arm3-stick"]
    assert [body for body, _ in episodes] == [0, 0]
    assert start_address(("demos/",), files) == Address("demos", ("demos/",))


def test_a_bad_folder_or_number_is_one_clear_error(files, root):
    for index in (-1, 2):
        with pytest.raises(UriError, match=f"no episode {index}; expected a number from 0 to 1$"):
            recorded_episode("demos", index, files)
    shutil.copytree(root / "demos", root / "begun")
    (root / "begun" / "meta" / "info.json").unlink()
    (root / "other" / "meta").mkdir(parents=True)
    (root / "other" / "meta" / "info.json").write_text("{}")
    for name, why in (("begun", "not finished"), ("other", "recording.json")):
        with pytest.raises(FormatError, match=why):
            start_address((name,), files)
        with pytest.raises(FormatError, match=why):
            list_episodes(name, files)


def test_states_that_are_not_finite_are_refused(files, root):
    shutil.copytree(root / "demos", root / "damaged")
    (path,) = (root / "damaged" / "data").glob("*/*.parquet")
    table = pq.read_table(path)
    state = np.array(table["observation.state"].to_pylist(), np.float32)
    state[3, 0] = np.nan
    values = pa.FixedSizeListArray.from_arrays(pa.array(state.reshape(-1)), state.shape[1])
    number = table.column_names.index("observation.state")
    pq.write_table(table.set_column(number, "observation.state", values), path)
    with pytest.raises(SimulationError, match="damaged: the states of episode 0 are not finite"):
        recorded_episode("damaged", 0, files)


def wait_for_state(page, **state):
    """Wait until the address has a state, and nothing else."""
    page.wait_for_url(lambda url: dict(parse_qsl(urlsplit(url).query)) == state)


@pytest.mark.slow
def test_any_episode_is_played(see, viewer, folder):
    drawn = {"drawn": "prims:1,planar_arm:1", "policy": "random"}
    morphgen.record(**drawn, tasks=["reach"], episodes=2, out=folder / "demos")
    on = viewer("demos/")
    page = see(on=on)
    wait_for_state(page, demos="demos/")
    page.get_by_text("4 of 4 episodes failed: 0, 1, 2, 3").wait_for()
    choose(page, "first of", "planar_arm-000000")
    state = {"demos": "demos/", "episode": "2"}
    wait_for_state(page, **state)
    page.get_by_text(re.compile(r"^6\.00 s; simulated: 6\.00 s")).wait_for()
    field(page, "time (s)").last.fill("2")
    wait_for_state(page, **state, t="2")
    page.get_by_role("link", name="planar_arm-000000").click()
    page.get_by_text("no self-collision").wait_for()
    page.go_back()
    page.get_by_text(re.compile(r"^2\.00 s; simulated: 6\.00 s")).wait_for()
    assert page.failures == []
    narrow = see("?demos=demos&episode=99", on=on, width=420)
    narrow.get_by_text("demos has no episode 99; expected a number from 0 to 3").wait_for()
    field(narrow, "episode").first.fill("1")
    wait_for_state(narrow, demos="demos", episode="1")
    narrow.get_by_text(re.compile(r"^6\.00 s; simulated: 6\.00 s")).wait_for()
    assert narrow.failures == []
    index = see("?demos=", on=on)
    index.get_by_role("link", name="demos", exact=True).click()
    wait_for_state(index, demos="demos")
