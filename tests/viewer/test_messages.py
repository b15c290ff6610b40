"""Invalid websocket messages change nothing and leave no traceback."""

import msgspec
import pytest

from helpers.viser_client import CAMERA, PlainClient
from morphgen.viewer.app.server import message_fault


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"\xc1",
        b"\x91" * 100_000,
        msgspec.msgpack.encode([1, 2]),
        msgspec.msgpack.encode({"no": "type"}),
        {"type": "NoSuchMessage"},
        {"type": "ShareUrlRequest"},
        {"type": "RunJavascriptMessage", "source": "alert()"},
        {"type": "GuiUpdateMessage", "uuid": 3, "updates": {}},
        {
            "type": "ScenePointerMessage",
            "event_type": "rect-select",
            "modifier": None,
            "ray_origin": None,
            "ray_direction": None,
            "screen_pos": [[0.5, 0.5]],
        },
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {}, "more": 1},
        {"type": "GuiUpdateMessage", "uuid": "x"},
        {**CAMERA, "wxyz": [1.0, 0.0]},
        {**CAMERA, "wxyz": [0.0, 0.0, 0.0, 0.0]},
        {**CAMERA, "position": [float("nan"), 0.0, 0.0]},
        {**CAMERA, "image_width": "wide"},
    ],
    ids=lambda message: repr(message)[:50],
)
def test_malformed_message_closes_only_its_connection(shared_viewer, capfd, message):
    on = shared_viewer
    with PlainClient(on.port) as client, PlainClient(on.port) as other:
        client.shows("Grammars")
        client.send(message)
        code, reason = client.until_closed()
        assert (code, bool(reason)) == (1008, True)
        other.shows("Grammars")
    assert capfd.readouterr() == ("", "")


def test_a_text_message_closes_its_connection(shared_viewer):
    with PlainClient(shared_viewer.port) as client:
        client.shows("Grammars")  # a closed connection has no page to open
        client.websocket.send("text")
        assert client.until_closed() == (1008, "expected a binary message")


def test_valid_messages_are_accepted():
    assert message_fault(msgspec.msgpack.encode(CAMERA)) == ""


@pytest.mark.parametrize(
    ("event", "points", "fault"),
    [
        ("rect-select", [[0.1, 0.1], [0.5, 0.5]], ""),
        ("click", [[0.5, 0.5]], "expected a rectangle with two points"),
    ],
)
def test_the_scene_takes_rectangles_and_no_clicks(event, points, fault):
    rays = {"ray_origin": [0.0, 0.0, 0.0], "ray_direction": [1.0, 0.0, 0.0], "modifier": None}
    message = {"type": "ScenePointerMessage", "event_type": event, "screen_pos": points, **rays}
    assert message_fault(msgspec.msgpack.encode(message)) == fault


@pytest.mark.parametrize(
    ("kind", "label", "value", "why"),
    [
        ("Text", "Search", 3, "expected a text"),
        ("Text", "Search", "x" * 200_001, "expected a text"),
        ("Dropdown", "Sort by", "/etc/passwd", "not one of the choices"),
        ("Dropdown", "Sort by", ["name"], "not one of the choices"),
        ("ButtonGroup", "Page", "beyond", "not one of the choices"),
        ("UploadButton", "Open a URDF, an MJCF or a zip", "x", "takes no value such as"),
    ],
)
def test_invalid_control_values_are_rejected(shared_viewer, capfd, kind, label, value, why):
    with PlainClient(shared_viewer.port) as client:
        client.change(client.control(kind, label), value)
        client.shows("That did not work")
        client.shows(why)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "updates", [{}, {"update_cb": []}, {"value": "x", "sync_cb": None}, {"_impl": 1}]
)
def test_messages_can_change_only_control_values(shared_viewer, capfd, updates):
    with PlainClient(shared_viewer.port) as client:
        search = client.control("Text", "Search")
        client.send({"type": "GuiUpdateMessage", "uuid": search, "updates": updates})
        client.shows("the value of a control, and nothing else of it")
        client.change(search, "ur5")
        client.until(lambda: "search=ur5" in client.text)
    assert capfd.readouterr().err == ""


def test_slider_accepts_only_numbers_in_its_range(shared_viewer, capfd):
    with PlainClient(shared_viewer.port, "?robot=robots/some-arm") as client:
        shoulder = client.control("Slider", "shoulder")
        for value in (float("nan"), float("inf"), "far", None, True, [1]):
            client.change(shoulder, value)
            client.shows(f"expected a number, not {value!r}")
        client.change(shoulder, 1e300)
        client.until(lambda: "q=2,0.5,0.01,0.02" in client.text)
    assert capfd.readouterr().err == ""
