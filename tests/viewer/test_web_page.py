"""Web pages and turntables of robots."""

import base64
import io
import re
import time
from dataclasses import replace

import imageio.v2 as imageio
import msgspec
import numpy as np
import pytest
import zstandard
from PIL import Image
from scipy.ndimage import median_filter

from helpers.robots import arm
from morphgen.grammar.compose import compose
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_request
from morphgen.model.kinematics import joint_limits
from morphgen.tasks.render.renderer import Renderer, RenderState
from morphgen.tasks.sim.base import Scene
from morphgen.viewer import film
from morphgen.viewer.app.web_page import joint_sweep, joint_titles, robot_page

ADDRESS = re.compile(rb"""(?:src|href)=["'](?!data:)[^"']+["']""")


def recorded_messages(page):
    """Return the messages of the scene that a web page holds."""
    data = base64.b64decode(re.search(rb'__VISER_EMBED_DATA__="([^"]+)"', page).group(1))
    payload = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    length = int.from_bytes(payload[:8], "little")
    return [m for _, m in msgspec.msgpack.decode(payload[8 : 8 + length])["messages"]]


def orange_pixels(page):
    """Return the number of pixels of a browser's page that are orange."""
    pixels = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
    red, green, blue = pixels.transpose(2, 0, 1)
    return int(((red > green + 40) & (green > blue + 20)).sum())


@pytest.fixture(scope="module")
def page():
    return robot_page(replace(arm(), name="an <arm>"))


def test_a_page_has_the_robot_the_stage_and_the_camera(page):
    messages = recorded_messages(page)
    names = {message.get("name") for message in messages}
    assert {"/robot/1/visual0", "/ground", "/scale", "/light"} <= names
    kinds = {message["type"] for message in messages}
    assert {"EnvironmentMapMessage", "SetCameraPositionMessage"} <= kinds
    assert b"<title>an &lt;arm&gt;</title>" in page


def test_a_page_loads_nothing_else(page):
    assert ADDRESS.findall(page) == []


def test_a_page_plays_each_joint_through_its_range(page):
    robot = arm()
    titles = joint_titles(robot)
    assert titles[0] == "joint 1 of 4, shoulder: -115 to 115 deg"
    messages = recorded_messages(page)
    labels = [m["updates"]["text"] for m in messages if m["type"] == "SceneNodeUpdateMessage"]
    assert labels == titles
    moves = [m["name"] for m in messages if m["type"] == "SetOrientationMessage"]
    assert moves.count("/robot/0") <= 1  # the root stays
    assert max(map(moves.count, moves)) > 40


@pytest.mark.parametrize("column", [0, 1])
def test_a_joint_moves_from_home_to_both_limits_and_back(column):
    robot = arm()
    home, (low, high) = np.array(robot.home), joint_limits(robot)[column]
    q = joint_sweep(robot, column, 200)
    assert q.shape == (200, robot.dof)
    assert np.delete(q, column, axis=1) == pytest.approx(np.tile(np.delete(home, column), (200, 1)))
    assert q[-1] == pytest.approx(home)
    values = q[:, column]
    assert values.min() == pytest.approx(low, abs=0.03 * (high - low))
    assert values.max() == pytest.approx(high, abs=0.03 * (high - low))
    assert values.argmin() < values.argmax()


def test_the_ground_has_no_dark_dots_at_the_sides_of_a_picture():
    derivation = parse_request(["base=gantry", "ee=cube"], default_library())
    robot = compose(derivation, default_library(), "gantry")
    home = np.array([robot.home])
    renderer = Renderer(Scene(robot), (), home, film._ring(robot), (480, 360))
    frame = renderer.frame(RenderState(home[0]), 75).astype(int).sum(axis=2)
    renderer.close()
    darker = median_filter(frame, 5) - frame
    assert (darker[:, :40] <= 40).all()
    assert (darker[:, -40:] <= 40).all()


def test_a_turntable_is_a_video_of_one_turn(monkeypatch, tmp_path):
    monkeypatch.setattr(film, "SIZE", (64, 48))
    monkeypatch.setattr(film, "NUM_FRAMES", 8)
    path = tmp_path / "turn.gif"
    path.write_bytes(film.turntable(arm(), ".gif"))
    frames = imageio.mimread(path)
    assert len(frames) == 8
    assert frames[0].shape[:2] == (48, 64)


@pytest.mark.slow
def test_a_page_opens_without_a_network(chromium, page, tmp_path, picture):
    path = tmp_path / "robot.html"
    path.write_bytes(page)
    context = chromium.new_context(viewport={"width": 1024, "height": 700}, offline=True)
    context.set_default_timeout(120_000)
    opened = context.new_page()
    failures, requests = [], []
    opened.on("pageerror", lambda error: failures.append(str(error)))
    opened.on("request", lambda request: requests.append(request.url))
    opened.goto(path.as_uri())
    opened.locator("canvas").first.wait_for()
    until = time.monotonic() + 100
    while orange_pixels(opened) < 100 and time.monotonic() < until:  # the colour of the robot
        opened.wait_for_timeout(1000)
    assert orange_pixels(opened) >= 100
    time_field = opened.locator("input").first
    opened.wait_for_function("parseFloat(document.querySelector('input').value) > 1.5")
    opened.keyboard.press("Space")  # pauses; software GL draws slowly
    opened.wait_for_timeout(1000)
    paused = time_field.input_value()
    picture(opened, "web-page")
    assert time_field.input_value() == paused
    context.close()
    assert failures == []
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []
