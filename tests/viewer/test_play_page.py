"""The play page in a browser."""

import re
import threading
import time

import pytest

from helpers.pages import choose, field, press
from helpers.runs import QUIET, small_config, small_source
from morphgen.rl.runs.training import train
from morphgen.viewer.episode import read_episode, score_until

pytestmark = pytest.mark.slow

CUBE = "words:base=planar ee=cube"


def wait_for_end(page, seconds="6.00"):
    page.get_by_text(re.compile(rf"^{seconds} s; simulated: {seconds} s")).wait_for()


def players():
    """Return the player threads of all browsers."""
    return [each for each in threading.enumerate() if each.name == "morphgen-player"]


def download(page, button):
    with page.expect_download() as found:
        page.get_by_role("button", name=button).click()
    return found.value


def test_reach_episode_can_be_scrubbed_and_stepped(see, viewer, picture):
    on = viewer()
    page = see(f"?play=reach&robot={CUBE}&policy=ik&seed=3", on=on)
    wait_for_end(page)
    page.get_by_text("success", exact=True).wait_for()
    picture(page, "play-reach")
    field(page, "time (s)").last.fill("2")
    page.get_by_text("2.00 s; simulated: 6.00 s").wait_for()
    press(page, "step")
    page.get_by_text("2.02 s; simulated: 6.00 s").wait_for()
    press(page, "back")
    press(page, "back")
    page.get_by_text("1.98 s; simulated: 6.00 s").wait_for()
    assert page.failures == []


@pytest.mark.parametrize("task", ["drawer", "door", "dial"])
def test_object_is_moved(see, picture, task):
    page = see(f"?play={task}&robot=words:arm=arm3 ee=stick&policy=scripted")
    page.get_by_text("success", exact=True).wait_for()
    picture(page, f"play-{task}")
    assert page.failures == []


def test_url_is_shown_and_new_episodes_have_other_seeds(see, viewer):
    page = see(f"?play=reach&robot={CUBE}&policy=random")
    page.wait_for_url(re.compile(r"policy=random$"))
    page.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    press(page, "New episode")
    page.wait_for_url(re.compile(r"seed=1"))
    assert field(page, "seed").last.input_value() == "1"
    choose(page, "policy", "ik")
    page.wait_for_url(re.compile(r"policy=ik&seed=1"))
    wait_for_end(page)
    page.get_by_text("success", exact=True).wait_for()


def test_episode_is_saved_opened_and_exported_as_video(see, viewer, folder, picture, tmp_path):
    on = viewer()
    page = see(f"?play=reach&robot={CUBE}&robot=words:base=gantry ee=cube&policy=ik&seed=1", on=on)
    wait_for_end(page)
    saved = download(page, "Save episode")
    assert saved.suggested_filename == "reach-planar-cube-1.npz"
    saved.save_as(folder / "episode.npz")
    episode = read_episode(folder / "episode.npz", on.files)
    assert [len(track.q) for track in episode.tracks] == [301, 301]
    assert all(score_until(track, "reach", 300) > 100 for track in episode.tracks)
    film = download(page, "Film (.mp4)").path().read_bytes()
    assert film[4:8] == b"ftyp"
    page.goto(f"http://127.0.0.1:{on.port}/?play=episode.npz")
    wait_for_end(page)
    assert page.get_by_text("success", exact=True).count() == 2
    picture(page, "play-recorded")
    assert page.failures == []


def test_robots_are_replaced_added_and_removed(see, viewer, picture):
    page = see("?play=reach&robot=robots/prims/prims-000001&policy=ik")
    page.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    choose(page, "robot", "prims-000002")
    page.wait_for_url(re.compile(r"robot=robots/prims/prims-000002&policy=ik"))
    field(page, "or words").last.fill("base=planar ee=cube")
    press(page, "add")
    page.wait_for_url(re.compile(r"prims-000002&robot=words:base=planar%20ee=cube"))
    page.get_by_role("cell", name="planar-cube").wait_for()
    press(page, "only")
    page.wait_for_url(re.compile(r"play=reach&robot=robots/prims/prims-000002&policy"))


def test_robot_that_cannot_do_the_task_shows_the_reason(see, viewer):
    page = see(f"?play=push&robot={CUBE}")
    page.get_by_text(re.compile("robot 'planar-cube' can hardly push")).wait_for()
    choose(page, "task", "reach")
    page.wait_for_url(re.compile(r"play=reach.*policy=zero-shot$"))
    wait_for_end(page)
    assert page.get_by_text("can hardly push").count() == 0


def test_checkpoint_starts_with_its_training_robot(see, viewer, folder, tmp_path):
    train(folder / "runs" / "small", small_config(small_source()), execution=QUIET)
    on = viewer("runs/small")
    page = see(on=on)
    page.wait_for_url(re.compile(r"play=reach&robot=derivation:.*policy=runs/small$"))
    page.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    page.get_by_role("cell", name=re.compile("^planar-cube")).wait_for()
    page.get_by_text("obstacles", exact=True).click()
    page.get_by_text(re.compile("the checkpoint is for other observations: obstacles 0")).wait_for()


def test_player_ends_when_its_browser_leaves_the_page(see, viewer, capfd):
    on = viewer()
    page = see(f"?play=reach&robot={CUBE}&policy=random", on=on)
    page.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    other = see(f"?robot={CUBE}", on=on)
    other.get_by_text("no self-collision").wait_for()
    (player,) = players()
    other.get_by_role("link", name="reach", exact=True).click()
    other.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    assert len(players()) == 2
    page.goto(f"http://127.0.0.1:{on.port}/?robot={CUBE}")
    page.get_by_text("no self-collision").wait_for()
    player.join(30)
    assert not player.is_alive()
    other.close()
    until = time.monotonic() + 30
    while players() and time.monotonic() < until:
        time.sleep(0.1)
    assert players() == []
    assert "Traceback" not in capfd.readouterr().err


def test_the_time_of_a_paused_episode_is_in_the_address(see):
    page = see(f"?play=reach&robot={CUBE}&policy=jacobian&t=1.5")
    page.get_by_text("1.50 s; simulated: 1.50 s").wait_for()
    press(page, "step")
    page.wait_for_url(re.compile(r"&t=1\.52$"))
    page.reload()
    page.get_by_text("1.52 s; simulated: 1.60 s").wait_for()
    press(page, "play")
    page.wait_for_url(re.compile(r"policy=jacobian$"))
    wait_for_end(page)
    field(page, "time (s)").last.fill("2")
    page.wait_for_url(re.compile(r"&t=2$"))
    assert page.failures == []
