"""The web page and its frame, commands, and many clients."""

import base64
import contextlib
import html
import http.client
import io
import json
import re
import shlex
import threading
import weakref
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import imageio.v2 as imageio
import msgspec
import numpy as np
import pytest
import zstandard
from PIL import Image

import morphgen.viewer
from helpers.pages import nodes, wait_until
from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.cli import build_parser
from morphgen.formats.bundle import write_bundle
from morphgen.model.kinematics import joint_limits
from morphgen.tasks import renderer
from morphgen.viewer import robot_files
from morphgen.viewer.app.address import MAX_CHOSEN, Address, parse_address
from morphgen.viewer.app.frame import shown_address, tray_html
from morphgen.viewer.robot_files import joint_sweep, joint_titles, robot_page

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
    assert {"/robot/1/visual0", "/ground", "/light"} <= names
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


def test_a_turntable_is_a_video_of_one_turn(monkeypatch, tmp_path):
    monkeypatch.setattr(renderer, "SIZE", (64, 48))
    monkeypatch.setattr(robot_files, "NUM_FRAMES", 8)
    path = tmp_path / "turn.gif"
    path.write_bytes(robot_files.turntable(arm(), ".gif"))
    frames = imageio.mimread(path)
    assert len(frames) == 8
    assert frames[0].shape[:2] == (48, 64)


@pytest.mark.slow
def test_a_page_opens_without_a_network(chromium, page, tmp_path):
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
    wait_until(lambda: orange_pixels(opened) >= 100)  # the colour of the robot
    time_field = opened.locator("input").first
    opened.wait_for_function("parseFloat(document.querySelector('input').value) > 1.5")
    opened.keyboard.press("Space")  # pauses; software GL draws slowly
    opened.wait_for_timeout(1000)
    paused = time_field.input_value()
    assert time_field.input_value() == paused
    context.close()
    assert failures == []
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []


A, B = "words:arm=ur5 ee=plane", "robots/prims/prims-000001"


def test_the_tray_offers_what_its_robots_can_do():
    assert tray_html([]) == ""
    one = tray_html([B])
    assert "1 chosen" in one
    assert "?compare=" not in one
    assert "?play=reach&amp;robot=robots/prims/prims-000001" in one
    assert "?compare=" in tray_html([A, B])
    many = tray_html([f"robots/r{i}" for i in range(12)])
    assert "?compare=" not in many
    assert "?play=" not in many
    assert "?chosen=robots/r0&amp;chosen=robots/r1" in many


def test_the_address_of_every_page_keeps_the_chosen_robots():
    shown = shown_address(Address("library"), [A, B])
    assert parse_address(shown.query).chosen == (A, B)
    chosen = parse_address(f"?chosen={A}&chosen={B}&train=1")
    assert chosen == Address("chosen", (A, B), {"train": "1"})
    assert shown_address(chosen, [B]).query == f"?chosen={B}&train=1"


class Script:
    """Sends what the script of a page sends."""

    def __init__(self, client, port):
        self.client, self.port = client, port
        (source,) = client.until(lambda: [s for s in client.sources if "?.connect(" in s][-1:])
        self.token = json.JSONDecoder().raw_decode(source.split("(", 1)[1])[0]

    def send(self, action, value, visit=0, token=None, *, dark=False, width=1400):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        state = f"visit={visit}&dark={'yes' if dark else ''}&width={width}"
        path = f"/morphgen/{token or self.token}?{action}={quote(value)}&{state}"
        connection.request("GET", path)
        return connection.getresponse().status


def test_a_script_opens_another_page_in_place(viewer):
    on = viewer()
    with PlainClient(on.port, "?population=") as client:
        script = Script(client, on.port)
        client.shows("Splits")
        (first,) = on.sessions.values()
        assert script.send("open", f"?robot={A}", visit=1) == 200
        client.control("Checkbox", "x-ray")
        client.until(lambda: (1, "?robot=words:arm=ur5%20ee=plane") in client.addresses)
        (second,) = on.sessions.values()
        assert first.closed.is_set()
        assert second.events is first.events
        wait_until(lambda: "/robot/1/visual0" in nodes(on))
        assert script.send("open", "?robot=nowhere", visit=2) == 200
        client.shows("no such file or folder")
        assert set(nodes(on)) <= {"/light"}


def test_a_script_chooses_robots(viewer):
    on = viewer()
    with PlainClient(on.port, f"?population=&chosen={A}") as client:
        script = Script(client, on.port)
        client.shows("1 chosen")
        assert script.send("choose", B) == 200
        client.shows("2 chosen")
        shown = f"?population=&chosen={quote(A, safe='/=:')}&chosen={B}"
        client.until(lambda: shown in dict(client.addresses).values())
        script.send("open", "?gallery=", visit=1)
        client.until(lambda: any(n == 1 and query.endswith(B) for n, query in client.addresses))
        script.send("drop", A)
        script.send("download", "")
        client.shows("robots.zip")
        script.send("clear", "")
        client.until(lambda: client.addresses[-1] == (1, "?gallery="))
        script.send("choose", "x" * MAX_CHOSEN)
        client.shows("choose fewer")
        script.send("explode", "")
        client.shows("unknown action; expected choose, drop")


def test_a_narrow_window_has_its_cards_above_the_panel(shared_viewer):
    with PlainClient(shared_viewer.port, "?split=") as client:
        script = Script(client, shared_viewer.port)
        assert script.send("open", "?gallery=robots/prims", visit=1, width=420) == 200
        (html, *_) = client.until(lambda: [s for s in client.sources if "?.cards(" in s])
        assert html.count('class=\\"card\\"') == 24


def test_only_the_script_of_a_page_can_change_it(viewer):
    on = viewer()
    with PlainClient(on.port, "?population=") as client:
        script = Script(client, on.port)
        assert script.send("open", "?split=", token="x" * 32) == 404
        assert script.send("choose", A, token="../library") == 404
    client.websocket.close()
    with PlainClient(on.port, "?population=") as other:
        other.shows("Splits")
        assert script.send("open", "?split=") == 404


@pytest.mark.parametrize(
    ("query", "text"),
    [
        ("?gallery=", "robots/prims"),
        ("?population=", "population=extrapolation/arms/reach"),
        ("?split=", "split=extrapolation/arms/reach"),
        ("?compare=", "Compare two to four robots"),
    ],
)
def test_pages_without_a_subject_list_what_there_is(shared_viewer, query, text):
    with PlainClient(shared_viewer.port, query) as client:
        client.shows(text)


def test_chosen_robots_become_the_sides_of_a_split(shared_viewer):
    uris = [f"robots/prims/prims-00000{i}" for i in range(3)]
    query = "?" + "&".join(f"chosen={uri}" for uri in uris) + "&train=1"
    with PlainClient(shared_viewer.port, query) as client:
        client.shows("train (1)")
        client.shows("test (2)")


def test_a_page_opens_the_tabs_of_its_address(shared_viewer):
    with PlainClient(shared_viewer.port, "?gallery=robots/prims&tab=A,B") as client:
        client.shows('?.openTabs(["A", "B"])')
        assert client.addresses[-1] == (0, "?gallery=robots/prims&tab=A,B")


def test_the_dark_theme_is_remembered(viewer):
    on = viewer()
    with PlainClient(on.port, "?population=", dark=True) as client:
        script = Script(client, on.port)
        client.shows(">light</a>")  # the way back
        (theme, *_) = [m for m in client.messages if m["type"] == "ThemeConfigurationMessage"]
        assert theme["dark_mode"] is True
        client.messages.clear()
        script.send("open", "?split=", visit=1, dark=True)
        client.shows(">light</a>")
        script.send("open", "?split=", visit=2)
        client.shows(">dark</a>")


PROSE = ("itself",)
"""Words that stand after the name of the package where no command is meant."""


def commands(client):
    """Return the commands in the copy boxes of a page."""
    boxes = re.findall(r"<pre>(.*?)</pre>", client.text, re.DOTALL)
    lines = [line for box in boxes for line in html.unescape(box).splitlines()]
    return [line for line in lines if line.startswith("morphgen ")]


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("?robot=robots/some-arm", "morphgen show robots/some-arm"),
        ("?robot=robots/it's me", "morphgen show 'robots/it'\"'\"'s me'"),
        ("?robot=words:arm=ur5 ee=plane", "morphgen compose arm=ur5 ee=plane"),
        ("?compose=arm=ur5 ee=plane", "morphgen compose base=fixed arm=ur5 ee=plane"),
        ("?compose=chain", "morphgen compose chain"),
        ("?compose=my/own.grammar", "morphgen compose my/own.grammar"),
        ("?compose=chain&seed=3&number=2", "morphgen sample chain -n 3 --seed 3"),
    ],
)
def test_commands_of_a_page_are_valid(shared_viewer, folder, query, expected):
    write_bundle(arm(), folder / "robots" / "it's me", picture=False)
    (folder / "my").mkdir(exist_ok=True)
    (folder / "my" / "own.grammar").write_text("include chain\n")
    with PlainClient(shared_viewer.port, query) as client:
        client.until(lambda: commands(client))
        (command,) = set(commands(client))
    assert command == expected
    args, words = build_parser().parse_known_args(shlex.split(command)[1:])
    assert hasattr(args, "run")
    assert words == [] or hasattr(args, "words")


def test_every_command_in_the_viewers_texts_exists():
    known = build_parser()._subparsers._group_actions[0].choices
    for path in Path(morphgen.viewer.__file__).parent.rglob("*.py"):
        for verb in re.findall(r"[`\"'( ]morphgen ([a-z]+)", path.read_text(encoding="utf-8")):
            assert verb in {*known, *PROSE}, f"{path.name}: morphgen {verb}"


def robot_name(i):
    return f"prims-{i % 30:06d}"


@pytest.mark.slow
def test_thirty_clients_see_their_own_pages_and_leave_nothing(viewer, capfd):
    on = viewer()
    with contextlib.ExitStack() as stack:
        queries = [f"?robot=robots/prims/{robot_name(i)}" for i in range(30)]
        clients = [stack.enter_context(PlainClient(on.port, query)) for query in queries]
        for i, client in enumerate(clients):
            client.shows(f"<h3>{robot_name(i)}</h3>")
            client.shows("no self-collision")
            assert f"<h3>{robot_name(i + 1)}</h3>" not in client.text
        sessions = [weakref.ref(session) for session in on.sessions.values()]
        assert len(sessions) == 30
    wait_until(lambda: not on.sessions)
    wait_until(lambda: not any(t.name.startswith("morphgen-") for t in threading.enumerate()))
    wait_until(lambda: all(session() is None for session in sessions))
    assert "Traceback" not in capfd.readouterr().err
